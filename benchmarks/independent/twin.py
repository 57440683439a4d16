"""The script by which `femsense simulate` makes the same scene as an independent case, and its truth as the grader reads it."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from .camera import BASELINE_M, FOCAL, HEIGHT, SUBPIXEL, WIDTH
from .cases import AFTER, FREE, TOUCHED, Case
from .make import AWAY_M, MARKER_STD_M, RATE_S
from .solid import Array

ALBEDO, COSINE = 0.6, 0.7
"""What the robot sends back of the light, and how it is seen on the whole: there both programs have the same noise of a time-of-flight camera."""
AMOUNT = {"stereo": (0.002, 0.0), "tof": (0.0003, 0.0008)}
TABLE_RGB = (0.62, 0.60, 0.57)
KINDS = {"ball", "rod"}
"""What both programs have: a plate is round there and a box here."""


def script_of(case: Case, folder: Path, *, by_length: bool = False) -> dict[str, Any]:
    """Return the script of the scene of a case that lies in a folder: tensions, camera, objects, and each force as it was, frame by frame.

    Where the case gives lengths of cables, the scene is that of its tensions: the end of a cable sinks deeper into a finer mesh, so that the same length
    pulls less there. `by_length`: it is that of the lengths.
    """
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    names = list(truth["initial_tension_n"])
    zero = truth["initial_tension_n"] if case.zero == "unknown" else dict.fromkeys(names, 0.0)
    inputs = {name: (np.array(truth["tension_n"])[:, i] - zero[name]).tolist() for i, name in enumerate(names)}
    if by_length:
        frames = _rows(folder / "recording" / "frames.csv")
        inputs = {name: [float(row[f"cable_{name}"]) for row in frames] for name in names}
    first = {c["contact"]: c for c in reversed(truth["contacts"])}
    return {
        "format": "femsense-script-1",
        "seed": truth["seed"],
        "actuation": "displacement" if by_length else "tension",
        "actuation_zero": case.zero,
        "initial": zero,
        "dt_s": RATE_S,
        "sweeps": [
            _sweep("free", {name: values[:FREE] for name, values in inputs.items()}),
            *(
                _sweep(_label(k), {name: values[FREE + k :][:1] for name, values in inputs.items()})
                for k in range(TOUCHED + AFTER)
            ),
        ],
        "objects": [_object(number, c, truth, case) for number, c in sorted(first.items())],
        "contacts": [c for number in sorted(first) for c in _contacts(number, truth["contacts"])],
        "truth": {"refinements": 1, "element": "tet10", "law": "neo_hookean", "substeps": 1},
        "camera": _camera(case, truth),
        "markers": {"std_m": MARKER_STD_M},
        "clouds": {"kind": "depth" if case.images else "ply"},
        "scene": {"floor_z_m": truth["ground_m"], "floor_rgb": list(TABLE_RGB), "robot_albedo": ALBEDO},
    }


def _label(k: int) -> str:
    return f"touch{k}"


def _sweep(label: str, cables: dict[str, list[float]]) -> dict[str, Any]:
    free = label == "free"
    return {"label": label, "cables": cables, "up": 0, "hold": FREE if free else 1, "down": 0, "free": free}


def _object(number: int, contact: dict[str, Any], truth: dict[str, Any], case: Case) -> dict[str, Any]:
    item = {"name": f"object{number}", "kind": contact["kind"], "radius_m": contact["object_radius_m"]}
    item |= {"stick_m": 0.09} if contact["kind"] == "ball" else {"length_m": 0.15}
    return item | {"color_rgb": truth["object_rgb"], "declared": case.tool and number == 0}


def _contacts(number: int, contacts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one contact a frame: with the force that it has there, or away from the body."""
    mine = {c["frame"] - FREE: c for c in contacts if c["contact"] == number}
    result = []
    for k in range(TOUCHED + AFTER):
        near = mine[min(mine, key=lambda other: abs(other - k))]
        size = float(np.linalg.norm(near["force"])) if k in mine else 0.0
        along = np.cross(near["normal"], near["along"]) if near["kind"] == "rod" else near["along"]
        one = {"sweep": _label(k), "object": f"object{number}", "point_m": near["rest"], "radius_m": near["patch_radius_m"]}
        result.append(one | {"direction": near["force"], "along": np.asarray(along).tolist(), "force_n": size, "away_m": AWAY_M})
    return result


def _camera(case: Case, truth: dict[str, Any]) -> dict[str, Any]:
    pose, (floor, slope) = np.array(truth["T_robot_camera"]), AMOUNT[case.camera]
    far = float(np.linalg.norm(np.mean(list(truth["markers_m"].values()), axis=0) - pose[:3, 3]))
    if case.camera == "stereo":
        noise = {"kind": "stereo", "subpixel_px": floor * FOCAL * BASELINE_M, "baseline_m": BASELINE_M, "correlated_share": 0.0}
        noise |= {"disparity_step_px": SUBPIXEL, "flying_share": 0.5 if case.hard else 0.2, "grazing_deg": 90.0}
    else:
        noise = {"kind": "time-of-flight", "amplitude_std_m": (floor + slope * far) * ALBEDO * COSINE / far**2}
        noise |= {"multipath": 0.0, "mixing_px": 0.0, "least_signal": 0.0}
    lens = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "depth_unit_m": 1e-4}
    noise["edge_dropout"] = 0.3
    return lens | {"T_robot_camera": pose.tolist(), "declare_noise": case.declared_noise, "noise": noise}


def truth_of(folder: Path, other: dict[str, Any]) -> dict[str, Any]:
    """Return the truth of a recording of the rig in the form of truth.json; what both have alike, and the bound, come from the other one."""
    contacts = []
    for row in _rows(folder / "recording" / "truth" / "contacts.csv"):
        number, frame = int(row["object"].removeprefix("object")), int(row["frame"])
        twin = next(c for c in other["contacts"] if (c["frame"], c["contact"]) == (frame, number))
        here = {"point": _vector(row, "x_m", "y_m", "z_m"), "force": _vector(row, "fx_n", "fy_n", "fz_n")}
        here |= {"normal": _vector(row, "nx", "ny", "nz"), "rest": _vector(row, "rest_x_m", "rest_y_m", "rest_z_m")}
        contacts.append(twin | here)
    markers = [[] for _ in range(other["frames"])]
    for row in _rows(folder / "recording" / "truth" / "markers.csv"):
        markers[int(row["frame"])].append(_vector(row, "x_m", "y_m", "z_m"))
    return other | {"contacts": contacts, "marker_positions_m": markers}


def apart(first: dict[str, Any], second: dict[str, Any]) -> tuple[Array, Array]:
    """Return how far the markers of two truths lie apart in free and in touched frames [m], root mean square of each frame."""
    count = len(second["marker_positions_m"])
    gap = np.array(first["marker_positions_m"][:count]) - np.array(second["marker_positions_m"])
    each = np.sqrt((gap**2).sum(axis=2).mean(axis=1))
    return each[:FREE], each[FREE : FREE + TOUCHED]


def inputs_apart(first: Path, second: Path) -> float:
    """Return by how much the inputs of two recordings differ at most [N] or [m]."""
    mine, yours = (
        [[float(v) for n, v in row.items() if n.startswith("cable_")] for row in _rows(f / "frames.csv")] for f in (first, second)
    )
    return float(np.abs(np.array(mine) - np.array(yours)).max(initial=0.0))


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _vector(row: dict[str, str], *names: str) -> list[float]:
    return [float(row[name]) for name in names]
