"""The contents of a run folder for viewers: states, contacts, inputs, the skinned mesh."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh, surface_triangles
from femsense.io.tables import read_csv
from femsense.xr.glb_reader import read_glb
from femsense.xr.gltf import ExportReport
from femsense.xr.landmarks import landmarks_of_run, robot_table, run_document
from femsense.xr.surface_stress import SurfaceStress, nodal_strain, surface_stress
from femsense.xr.user_skin import BUDGET, GLTF, UserSkin, export_surface, read_skin

FORMAT = "femsense-contacts-1"
KEYS = ("frame", "time_s", "contact")
"""Columns of numbers of the tables of a run without an empty cell …"""
NUMBERS = (
    *("x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n", "force_n", "std_n"),
    *("x_std_m", "y_std_m", "z_std_m", "fx_std_n", "fy_std_n", "fz_std_n", "radius_m", "track", "rms_after_m"),
)
"""… and with some."""
TEXTS = ("status", "source")
CONTACT_COLUMNS = (*KEYS, *NUMBERS[:8], "source")
_Row = dict[str, Any]
"""A row of a table: column → number (None: not known) or text."""


def export_run(
    folder: str | Path, path: str | Path, *, bones: int | None = None, color_rgb: Any = None, skin: UserSkin | None = None
) -> ExportReport:
    """Write the skinned, animated mesh of a run folder (see `gltf.export_states`),
    or a surface of the user's own instead of the body's.

    Raises InputError where `states.npz` is missing, unreadable or lacks a part.
    """
    run = run_folder(folder)
    states = load_states(run)
    body = states.get("rest_nodes_m"), states["tets"], states["time_s"], states["nodes_m"]
    return export_surface(*body, path, skin=skin, bones=bones, color_rgb=color_rgb, name=name_of_run(run))


def skin_for_run(folder: str | Path, file: str | Path, *, unit: str | None = None, budget: int = BUDGET) -> UserSkin:
    """Return a surface of the user's own in the frame of a run's robot: `T_robot_mesh` of its robot.toml applies to all but glTF.

    Arguments and errors as `user_skin.read_skin`.
    """
    declared = robot_table(run_folder(folder)).get("mesh", {}).get("T_robot_mesh")
    glTF = Path(file).suffix.lower() in GLTF
    return read_skin(file, unit=unit, T_robot_skin=None if glTF else declared, budget=budget)


def contacts_of_run(folder: str | Path) -> dict[str, Any]:
    """Return the data that the page shows in addition to the mesh, ready for JSON; robot frame, SI.

    Returns:
        `format`, `name`, `frame` ("robot"), and `frames`: for each state its time from the first [s], the frame's
        number, status, residual and inputs if `frames.csv` has them, and the contacts of `contacts.csv`. `inputs` lists
        the inputs, with units and ranges: "declared" by robot.toml, or else "reached" in the run;
        `markers` and `cameras` are points shared with the real robot; `field` names the content of `stress_of_run`.

    Raises:
        InputError: a column is missing, or a value is not a number.
    """
    run = run_folder(folder)
    times = np.atleast_1d(np.asarray(load_states(run)["time_s"], dtype=np.float64))
    frames: list[dict[str, Any]] = [
        {"time_s": float(t - times[0]), "frame": None, "status": None, "rms_after_m": None, "inputs": None, "contacts": []}
        for t in times
    ]
    told = _rows(run / "frames.csv", ("frame", "time_s"))
    columns = [name for name in (told[0] if told else ()) if _is_input(name)]
    for row in told:
        state = frames[_nearest(times, row["time_s"])]
        state.update(frame=int(row["frame"]), status=row.get("status") or None, rms_after_m=row.get("rms_after_m"))
        state["inputs"] = [row[column] for column in columns] or None
    for row in _rows(run / "contacts.csv", CONTACT_COLUMNS):
        state = frames[_nearest(times, row["time_s"])]
        state["frame"] = int(row["frame"]) if state["frame"] is None else state["frame"]
        state["contacts"].append(_contact(row))
    robot = robot_table(run)
    inputs = [_input(column, told, robot) for column in columns]
    known = landmarks_of_run(run)
    return {
        "format": FORMAT,
        "name": name_of_run(run),
        "frame": "robot",
        "inputs": inputs,
        "frames": frames,
        "markers": [{"name": one.name, "position": one.position_m.tolist()} for one in known.markers],
        "cameras": [{"name": one.name, "position": one.position_m.tolist()} for one in known.cameras],
        "field": {"name": "stress", "unit": "Pa"} if _stiffness(run) else {"name": "strain", "unit": "%"},
    }


def stress_of_run(folder: str | Path, glb: bytes) -> SurfaceStress:
    """Return the stress at the vertices of a run's mesh; strain [%] where no material is known.

    A vertex has the stress of the node of the body's surface that is nearest to it at rest.
    """
    from scipy.spatial import cKDTree

    run = run_folder(folder)
    states = load_states(run)
    rest = np.asarray(states.get("rest_nodes_m", states["nodes_m"][0]), dtype=float)
    mesh = TetMesh(rest, states["tets"])
    used = np.unique(surface_triangles(mesh))
    nearest = used[cKDTree(rest[used]).query(read_glb(glb).skin.rest)[1]]
    return surface_stress(nodal_strain(rest, mesh.tets, states["nodes_m"])[:, nearest], _stiffness(run) or 100.0)


def _stiffness(run: Path) -> float | None:
    """Return 3 μ of the robot's material [Pa], or None if it is unknown."""
    material = robot_table(run).get("material", {})
    try:
        return 1.5 * float(material["young_modulus_pa"]) / (1.0 + float(material["poisson_ratio"]))
    except (KeyError, TypeError, ValueError):
        return None


def has_current_glb(run: Path) -> bool:
    """Return whether the mesh of a run is there, and no older than its states."""
    glb, states = run / "robot.glb", run / "states.npz"
    return glb.is_file() and states.is_file() and glb.stat().st_mtime >= states.stat().st_mtime


def current_glb(run: Path, scratch: Path) -> Path:
    """Return the mesh of the run, created if it is missing or older than the states."""
    glb = run / "robot.glb"
    if has_current_glb(run):
        return glb
    target = glb if os.access(run, os.W_OK) else scratch / "robot.glb"
    export_run(run, target)
    return target


def _contact(row: _Row) -> dict[str, Any]:
    return {
        "contact": int(row["contact"]),
        "point_m": _vector(row, "x_m", "y_m", "z_m"),
        "force_vector_n": _vector(row, "fx_n", "fy_n", "fz_n"),
        "force_n": row["force_n"],
        "std_n": row["std_n"],
        "source": row["source"],
        "track": int(row.get("track") or 0),
        "point_std_m": _vector(row, "x_std_m", "y_std_m", "z_std_m"),
        "force_std_n": _vector(row, "fx_std_n", "fy_std_n", "fz_std_n"),
        "radius_m": row.get("radius_m"),
    }


def _vector(row: _Row, *names: str) -> list[float] | None:
    values: list[Any] = [row.get(name) for name in names]
    return None if None in values else values


INPUT_COLUMNS = (("tension_", "_n", "N", "cables", "tension_n"), ("pressure_", "_pa", "Pa", "chambers", "pressure_pa"))
"""Inputs in frames.csv: prefix and suffix of the column, unit; and key and suffix of the limits in robot.toml."""


def _is_input(column: str) -> bool:
    return any(column.startswith(before) and column.endswith(after) for before, after, *_ in INPUT_COLUMNS)


def _input(column: str, rows: list[_Row], robot: dict[str, Any]) -> dict[str, Any]:
    """Return name, unit and range of an input: declared by robot.toml, or from 0 to the largest value of the run if nothing is declared or
    the run exceeds it."""
    before, after, unit, table, limit = next(kind for kind in INPUT_COLUMNS if column.startswith(kind[0]))
    values = [row[column] for row in rows if row[column] is not None]
    name = column[len(before) : -len(after)]
    low, high = min(0.0, *values, 0.0), max(0.0, *values, 0.0)
    declared: dict[str, Any] = next((row for row in robot.get(table, ()) if row.get("name") == name), {})
    most = float(declared.get(f"max_{limit}", np.inf))
    if high <= most < np.inf:
        return {
            "name": name,
            "unit": unit,
            "low": min(low, float(declared.get(f"min_{limit}", 0.0))),
            "high": most,
            "range": "declared",
        }
    return {"name": name, "unit": unit, "low": low, "high": high, "range": "reached"}


def _rows(path: Path, columns: Sequence[str]) -> list[_Row]:
    """Return the rows of a CSV file, without columns that nothing here shows; none if there is no file. Raises InputError."""
    if not path.is_file():
        return []
    table = read_csv(path, required=columns, prefixes=("",))
    found: dict[str, Sequence[Any]] = {name: table.text(name) for name in table.columns if name in TEXTS}
    for name in table.columns:
        if name in KEYS:
            found[name] = table.numbers((name,))[:, 0].tolist()
        elif name in NUMBERS or _is_input(name):
            values = table.numbers((name,), empty_is_nan=True)[:, 0]
            found[name] = [None if np.isnan(value) else value for value in values.tolist()]
    return [dict(zip(found, row)) for row in zip(*found.values())]


def _nearest(times: FloatArray, time: float) -> int:
    return int(np.abs(times - time).argmin())


def run_folder(folder: str | Path) -> Path:
    """Return the folder of a run. Raises InputError if it has no states."""
    run = Path(folder)
    if not (run / "states.npz").is_file():
        raise InputError(
            "not a run: no states.npz",
            where=run,
            expected="a folder that femsense estimate wrote",
            hint="femsense estimate … -o RUN",
        )
    return run


def load_states(run: Path) -> dict[str, Any]:
    """Return the arrays of states.npz: times, nodes, tetrahedra, nodes at rest. Raises InputError."""
    path = run / "states.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            states = {key: file[key] for key in file.files if key in ("time_s", "nodes_m", "tets", "rest_nodes_m")}
    except Exception as error:  # whatever the archive reader meets in a broken file
        raise InputError("not readable", where=path, found=error, expected="arrays time_s, nodes_m, tets") from None
    missing = [key for key in ("time_s", "nodes_m", "tets") if key not in states]
    if missing:
        raise InputError("arrays are missing", where=path, found=", ".join(states), expected=", ".join(missing))
    return states


def name_of_run(run: Path) -> str:
    """Return the robot's name from run.json, else the folder's."""
    robot = run_document(run).get("robot")
    name = robot.get("name") if isinstance(robot, dict) else robot
    return Path(name).name if isinstance(name, str) and name else run.resolve().name
