"""Reports: one page that needs nothing else, shows what the files hold, leaves out what is missing,
and refuses what is broken."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import block_mesh, changed, write_block_robot
from matplotlib.text import Text

from femsense.app import commands
from femsense.core.errors import InputError
from femsense.io.robot_toml import load_robot
from femsense.loop.files import read_loop, saved_loop
from femsense.report import words, write_report
from femsense.report.bodies import VIEWS, Key, best_view, body_height, frame_body, new_panels, skin
from femsense.report.compare import load_error
from femsense.report.drawing import new_axes, nice
from femsense.report.loop.chapter import recovered
from femsense.report.loop.effects import is_beyond, smallest_words
from femsense.report.loop.residual_at_rest import mean_residual
from femsense.report.loop.residual_in_frames import frame_residuals
from femsense.report.run.document import KnownLoad
from femsense.report.run.forces import forces_figure
from femsense.sensing.run_files import read_contacts, read_frames

MARKERS = {"tip": [0.1, 0.015, 0.03], "middle": [0.05, 0.015, 0.03], "stalk": [0.1, 0.015, 0.05]}
SENTENCE = "The model lacks gravity (vector_m_s2 [0.1, 0.02, -9.7] m/s²); held-out error 2.04 mm before, 0.17 mm after."
VOID = {"meta", "img", "br", "hr", "link", "input"}


# Folders as the commands leave them


def loop_document(**overrides: Any) -> dict[str, Any]:
    """Return a plausible loop.json; overrides as in `helpers.changed`."""
    rng = np.random.default_rng(7)
    rows = [(recording, frame, name) for recording in (0, 1) for frame in range(8, 20) for name in MARKERS]
    sag = np.array([[0.0, 0.0, -2.5e-3 * MARKERS[name][0] / 0.1] for _, _, name in rows])
    noise = rng.normal(scale=1e-4, size=(len(rows), 3))
    gravity = {"value": [0.1, 0.02, -9.7], "std": [0.3, 0.25, 0.12], "unit": "m/s²"}
    friction = {"value": 0.21, "std": 0.015, "unit": "1"}
    document: dict[str, Any] = {
        "format": "femsense-loop-1",
        "verdict": "effects",
        "sentence": SENTENCE,
        "noise_m": 1.732e-4,
        "before": {"train_rms_m": 1.9e-3, "validation_rms_m": 2.04e-3, "validation_ci_m": [1.85e-3, 2.21e-3]},
        "after": {"train_rms_m": 1.7e-4, "validation_rms_m": 1.73e-4, "validation_ci_m": [1.6e-4, 1.85e-4]},
        "effects": [
            {
                "name": "gravity",
                "parameters": {"vector_m_s2": gravity},
                "validation_rms_before_m": 2.04e-3,
                "validation_rms_after_m": 3.1e-4,
            },
            {
                "name": "cable_friction",
                "parameters": {"coefficient": friction, "law": {"value": "capstan", "std": None, "unit": "1"}},
                "validation_rms_before_m": 3.1e-4,
                "validation_rms_after_m": 1.73e-4,
            },
            {
                "name": "cable_gain",
                "parameters": {
                    "scale": {"value": {"top": 1.031, "side": 0.985}, "std": {"top": 0.004, "side": None}, "unit": "1"}
                },
            },
        ],
        "candidates": [
            {
                "name": "gravity",
                "seed": {},
                "dchi2": 5321.4,
                "dbic": 5290.1,
                "retained_share": 0.83,
                "dbic_at_end": None,
                "refits": [
                    {
                        "name": "gravity",
                        "dchi2": 5390.0,
                        "dbic": 5360.0,
                        "validation_rms_m": 3.1e-4,
                        "cv_gain": 42.0,
                        "cv_std": 8.0,
                        "verdict": "named",
                    }
                ],
                "verdict": "named",
            },
            {
                "name": "payload",
                "seed": {"point_m": [0.1, 0, 0]},
                "dchi2": 4100.0,
                "dbic": 4070.2,
                "retained_share": 0.4,
                "dbic_at_end": 1.0,
                "refits": [],
                "verdict": "passes",
            },
            {
                "name": "poisson",
                "seed": {},
                "dchi2": 1.5e-5,
                "dbic": -7.4,
                "retained_share": 0.05,
                "dbic_at_end": -8.0,
                "refits": [],
                "verdict": "not testable: 97 % of it is absorbed by calibration",
            },
        ],
        "confounded": [
            {"pair": ["gravity", "payload"], "dbic_gap": 3.2},
            {"pair": ["cable_gain", "cable_stretch"], "absorbed_share": 0.972},
        ],
        "next_experiment": "turn the base by 90° between frames, camera fixed",
        "not_testable": [{"name": "poisson", "absorbed_share": 0.97, "retained_share": 0.24}],
        "detectable": {
            "poisson": {"smallest": {"poisson_ratio": 0.031}, "kind": "change", "unit": "1"},
            "soft_region": {"smallest": {"scale": 1.2214}, "kind": "factor", "unit": "1"},
            "cable_stretch": {"smallest": {"stiffness_n_m": 1e4}, "kind": "softer_than", "unit": "N/m"},
            "marker_offset": {
                "smallest": {f"offset_m[{name}][{i}]": 1e-4 * (i + 1) for name in MARKERS for i in range(3)},
                "kind": "change",
                "unit": "m",
            },
            "base_compliance": {"smallest": {"stiffness_n_m": None}, "kind": "softer_than", "unit": "N/m"},
        },
        "left": {
            "rms_m": 1.7e-4,
            "marker_rms_m": {"tip": 2.1e-4, "middle": 1.2e-4, "stalk": None},
            "where": {"marker": "tip", "position_m": MARKERS["tip"], "mean_residual_m": [1e-5, -2e-5, 6e-5]},
            "worst_frame": {"frame": 17, "rms_m": 2.9e-4},
            "goes_with": [{"covariate": "unloading", "rank_correlation": -0.41, "p_value": 0.03, "p_holm": 0.15}],
            "structure": {"lag_one": 0.05, "p_value": 0.31},
        },
        "data": {
            "recordings": ["somewhere/first", None],
            "split": ["2 of 6 sweeps", "1 of 4 sweeps"],
            "frames_fitted": [[0, 1, 2, 3, 7], [0, 1]],
            "frames_held_out": [list(range(8, 20)), list(range(8, 20))],
            "outliers": [{"frame": 4, "marker": "tip"}, {"frame": 9, "marker": "stalk"}],
            "noise_components_m": {"white": 8e-5, "marker": 6e-5},
            "noise_source": "restricted maximum likelihood, with repeats",
            "effective_observations": 252.0,
            "nuisance_after": {"stiffness": {"scale": {"value": 1.113, "std": 0.012, "unit": "1"}}},
            "placement_std_m": 3e-4,
            "mesh_error_m": 5e-5,
            "seed": 0,
        },
        "residuals": {
            "recording": [row[0] for row in rows],
            "frame": [row[1] for row in rows],
            "marker": [row[2] for row in rows],
            "before_m": (sag + noise).tolist(),
            "after_m": noise.tolist(),
        },
        "inputs": {
            "robot": {"name": "block", "path": "somewhere/block", "sha256": "0"},
            "recordings": [{"path": "somewhere/first", "sha256": "abcd" * 16}],
        },
        "versions": {"femsense": "0.1.0", "numpy": "2.0"},
    }
    document["detectable"] |= {
        "hyperelastic": {"smallest": {}, "would_be_seen": True},
        "discretisation": {"smallest": {}, "would_be_seen": False},
    }
    document["evidence"] = evidence_document()
    return changed(document, overrides)


def evidence_document() -> dict[str, Any]:
    """Return plausible figures in numbers for a loop.json."""
    rng = np.random.default_rng(11)
    count = 24
    push = np.concatenate([np.linspace(0, 2, 4), np.linspace(2, 0, 4)] * 3)
    way = np.array([0, 0, 0, 0, 1, 1, 1, 1] * 3, dtype=bool)
    score = 1e-3 * push * np.where(way, -0.5, 1.0) + 1e-5 * rng.normal(size=count)
    mesh = block_mesh((4, 2, 2))
    surface = skin(mesh.nodes, mesh.tets)
    corners, triangles = np.unique(surface.triangles, return_inverse=True)
    placements = np.array(list(MARKERS.values()))
    residual = np.outer([1.0, 0.5, 1.0], [0.0, 0.0, -2e-3])
    shots = [
        {
            "title": title,
            "recording": 0,
            "frame": i,
            "marker": list(MARKERS),
            "measured_m": (placements + residual).tolist(),
            "before_m": residual.tolist(),
            "after_m": (0.1 * residual).tolist(),
            "nodes_m": mesh.nodes[corners].tolist(),
        }
        for i, title in enumerate(("rest", "mid", "max"))
    ]
    tip = 0.01 * push
    covariate = {"covariate": "unloading", "rank_correlation": -0.82, "p_value": 1e-6, "p_holm": 9e-6}
    tests = {"neighbours": 0.002, "pattern": 0.004, "sweep": 0.5}
    triple = [1e-3, 2e-3, -1e-3]
    moved = {"nuisance": triple, "after": [1e-4, 0.0, 0.0]}
    spread = {"before": [1e-5] * 3, "nuisance": [2e-5] * 3, "after": [2e-5] * 3}
    return {
        "frames": {
            "recording": [0] * 16 + [1] * 8,
            "frame": list(range(16)) + list(range(8)),
            "time_s": [0.5 * i for i in range(count)],
            "sweep": ["one"] * 8 + ["two"] * 8 + ["three"] * 8,
            "held_out": [False] * 8 + [True] * 16,
            "actuation": push.tolist(),
            "unloading": way.tolist(),
            "load_n": [0.0] * count,
            "before_rms_m": (2e-3 + np.abs(score)).tolist(),
            "after_rms_m": [2e-4] * 23 + [None],
            "score_before_m": score.tolist(),
            "score_after_m": (0.1 * score).tolist(),
        },
        "score": {
            "share": 0.81,
            "pattern": {},
            "goes_with_before": [covariate, {**covariate, "covariate": "time", "rank_correlation": 0.11}],
            "goes_with_after": [{**covariate, "rank_correlation": -0.2}],
            "covariate": "unloading",
            "covariate_values": way.astype(float).tolist(),
        },
        "tip": {
            "marker": "tip",
            "direction": [0.0, 0.0, 1.0],
            "recording": [0] * 16 + [1] * 8,
            "frame": list(range(16)) + list(range(8)),
            "measured_m": tip.tolist(),
            "before_m": (tip + 2e-3).tolist(),
            "after_m": (tip + 1e-4).tolist(),
        },
        "pictures": {
            "triangles": triangles.reshape(-1, 3).tolist(),
            "frames": shots,
            "cameras": [{"axis": [0.0, 0.6, -0.8], "position_m": [0.05, -0.3, 0.4]}],
        },
        "ranking": {
            "gravity": {
                "parameters": [
                    {"label": f"vector_m_s2[{i}]", "value": 0.0, "std": 0.1, "ends": [-12.0, 12.0], "unit": "m/s²"}
                    for i in range(3)
                ],
                "first_share": 0.97,
            },
            "payload": {
                "parameters": [{"label": "force_n[0]", "value": 0.12, "std": 0.01, "ends": [-20.0, 20.0], "unit": "N"}],
                "first_share": 0.03,
            },
            "poisson": {
                "parameters": [{"label": "poisson_ratio", "value": None, "std": None, "ends": [0.05, 0.499], "unit": "1"}],
                "first_share": None,
            },
        },
        "confounding": {
            "names": ["gravity", "payload", "cable_gain"],
            "share": [[1.0, 0.97, 0.2], [0.9, 1.0, 0.1], [0.2, None, 1.0]],
        },
        "calibration": {
            "poses": [
                {"recording": r, "camera": 0, "turn_rad": moved, "shift_m": moved, "turn_std_rad": spread, "shift_std_m": spread}
                for r in (0, 1)
            ],
            "initial_inputs": [
                {
                    "recording": 0,
                    "cable": "top",
                    "unit": "N",
                    "values": {"before": [0.31, 0.02], "nuisance": [0.4, 0.03], "after": [0.3, None]},
                }
            ],
            "parameters": [
                {
                    "label": "stiffness: scale",
                    "unit": "1",
                    "declared": 1.0,
                    "values": {"nuisance": [0.8, 0.01], "after": [1.01, 0.012]},
                }
            ],
        },
        "tests": {
            "before": {
                "structure": {"lag_one": 0.7, "p_value": 0.002, "tests": tests, "significant": True},
                "lack_of_fit": {"f": 31.2, "p_value": 1e-9, "df_lack": 40, "df_pure": 12, "pure_error_m": 2e-4},
                "train_rms_m": 1.9e-3,
            },
            "after": {
                "structure": {"lag_one": 0.05, "p_value": 0.31, "tests": {"neighbours": 0.31}, "significant": False},
                "lack_of_fit": None,
                "train_rms_m": 1.7e-4,
            },
        },
        "power": {
            "poisson": [{"label": "poisson_ratio", "kind": "change", "size": 0.031, "unit": "1"}],
            "soft_region": [
                {"label": "scale", "kind": "factor", "size": 1.221, "unit": "1"},
                {"label": "radius_m", "kind": "change", "size": 2e-3, "unit": "m"},
            ],
            "cable_stretch": [{"label": "stiffness_n_m", "kind": "softer_than", "size": 1e4, "unit": "N/m"}],
            "base_compliance": [{"label": "stiffness_n_m", "kind": "softer_than", "size": None, "unit": "N/m"}],
            "hyperelastic": [{"label": "", "kind": "whole", "size": 0.2, "unit": "1"}],
            "discretisation": [{"label": "", "kind": "whole", "size": 3.0, "unit": "1"}],
        },
        "excluded": [{"touched, load not declared": [4, 5, 6], "no markers": [9]}, {}],
        "repeats": 2,
        "forces": {
            "loads": [
                {
                    "recording": 0,
                    "frame": 9,
                    "held_out": True,
                    "declared_n": 0.5,
                    "before_n": 0.41,
                    "before_std_n": 0.01,
                    "after_n": 0.49,
                    "after_std_n": 0.01,
                },
                {
                    "recording": 0,
                    "frame": 11,
                    "held_out": True,
                    "declared_n": 1.0,
                    "before_n": 0.80,
                    "before_std_n": 0.02,
                    "after_n": 1.01,
                    "after_std_n": 0.02,
                },
            ]
        },
        "equivalent_forces": {
            "recording": 0,
            "frame": 7,
            "points_m": placements.tolist(),
            "forces_n": (20 * residual).tolist(),
            "total_n": [0.0, 0.0, -0.1],
            "explained_share": 0.93,
        },
    }


COMPLIANCE = {
    "compliance": {
        "frames": [{"title": "rest", "frame": 0, "ratio": [0.9, 0.92, None], "phantom_before_n": 0.031, "phantom_after_n": 0.002}]
    }
}


def write_loop_folder(folder: Path, *, robot: bool = True, **overrides: Any) -> Path:
    """Write OUT of femsense improve and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    if robot:
        write_block_robot(folder)
    (folder / "loop.json").write_text(json.dumps(loop_document(**overrides)), encoding="utf-8")
    return folder


CONTACT_HEADER = "frame,time_s,contact,x_m,y_m,z_m,nx,ny,nz,fx_n,fy_n,fz_n,force_n,std_n,source"
CONTACT_HEADER += ",track,x_std_m,y_std_m,z_std_m,radius_m,fx_std_n,fy_std_n,fz_std_n"
FRAME_HEADER = "frame,time_s,status,contacts,matched,rms_before_m,rms_after_m,ms,tension_top_n,tension_side_n"


def write_run_folder(
    folder: Path, *, frames: int = 30, scale: float = 1.0, reason: str = "no equilibrium: stuck", **overrides: Any
) -> Path:
    """Write RUN of femsense estimate and return it: two contacts, one of them in two parts; frames 3 and 4 without a result."""
    folder.mkdir(parents=True, exist_ok=True)
    mesh = block_mesh((6, 2, 2))
    contacts, lines, nodes = [CONTACT_HEADER], [FRAME_HEADER], []
    for k in range(frames):
        lost = k in (3, 4)
        force = scale * (0.2 + 0.5 * np.sin(0.3 * k) ** 2)
        touched = [] if lost else [0] if k < 8 else [0, 1] if k < 20 or k == 25 else []
        for c in touched:
            size, std = force / (c + 1), "" if k in (12, 25) else 0.05 * scale
            contacts.append(
                f"{k},{0.1 * k},{c},{0.09 - 0.04 * c},0.015,0.03,0,0,1,0.02,0,{-size},{size},{std},"
                f"cloud,{c},1e-3,1e-3,1e-3,5e-3,0.02,0.02,0.05"
            )
        lines.append(
            f'{k},{0.1 * k},"{reason if lost else "ok"}",{len(touched)},{0 if lost else 12},'
            + (",,,," if lost else f"{2e-3 + 1e-5 * k},{4e-4 + 5e-6 * k},{15 + k % 3},{0.1 * k},{0.5}")
        )
        bend = np.zeros_like(mesh.nodes)
        bend[:, 2] = -0.8 * force / scale * mesh.nodes[:, 0] ** 2 / 0.1
        nodes.append(mesh.nodes + bend)
    (folder / "contacts.csv").write_text("\n".join(contacts) + "\n", encoding="utf-8")
    (folder / "frames.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    np.savez_compressed(
        folder / "states.npz",
        time_s=0.1 * np.arange(frames),
        nodes_m=np.array(nodes, np.float32),
        tets=mesh.tets.astype(np.int32),
        rest_nodes_m=mesh.nodes,
    )
    document = {
        "format": "femsense-run-1",
        "robot": "block",
        "frames": frames,
        "frames_ok": frames - 2,
        "contacts": len(contacts) - 1,
        "known_loads": [
            {"frame": 7, "declared_n": 0.5, "sensed_n": 0.48, "error_percent": -4.0},
            {"frame": 9, "declared_n": 1.0, "sensed_n": 1.02, "error_percent": 2.0},
        ],
        "inputs": {"robot": {"name": "block", "path": "somewhere/block"}, "recording": {"path": "somewhere/pushes"}},
        "versions": {"femsense": "0.1.0"},
        "timing": {"seconds": 1.5, "ms_per_frame_median": 16.0},
    }
    (folder / "run.json").write_text(json.dumps(changed(document, overrides)), encoding="utf-8")
    return folder


def write_calibration_file(file: Path, **overrides: Any) -> Path:
    """Write what femsense calibrate writes and return its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    T = [[1.0, 0.0, 0.0, 0.05], [0.0, -1.0, 0.0, -0.3], [0.0, 0.0, -1.0, 0.4], [0.0, 0.0, 0.0, 1.0]]
    document = {
        "format": "femsense-calibration-1",
        "status": "converged",
        "T_robot_camera": T,
        "cable_tension_n": {"top": 0.311, "side": 0.2},
        "cable_displacement_m": {"top": 1.25e-3, "side": 4e-4},
        "rms_m": 4.2e-4,
        "marker_rms_m": {"tip": 6.1e-4, "middle": 2.3e-4, "stalk": 3.3e-4},
        "history": [{"iteration": i, "rms_m": 4.2e-4 + 8e-3 * 0.1**i} for i in range(5)],
        "std": {
            "T_robot_camera": [[1e-3] * 3 + [2.5e-4]] * 3 + [[0.0] * 4],
            "cable_tension_n": {"top": 0.02, "side": None},
            "cable_displacement_m": {"top": 8e-5, "side": None},
        },
        "pose_covariance": (1e-6 * np.eye(6)).tolist(),
        "placements_m": {},
        "frames": [0, 1, 2, 5],
        "cameras": [{"name": "front", "T_robot_camera": T}],
    }
    file.write_text(json.dumps(changed(document, overrides)), encoding="utf-8")
    return file.parent


# Reading a page


class Page(HTMLParser):
    """The text, the tags and the tables of a page; fails where tags do not match."""

    def __init__(self, source: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.pieces: list[str] = []
        self.feed(source)
        self.close()
        assert self.open == [], f"not closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.pieces.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.pieces).split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def report(folder: Path) -> Page:
    """Return the page of a folder after checking what holds for each."""
    path = write_report(folder)
    source = path.read_text(encoding="utf-8")
    assert len(source) < 3_000_000
    page = Page(source)
    for _, attributes in page.tags:
        for name in ("src", "href"):
            assert (attributes.get(name) or "#").startswith(("#", "data:image/")), attributes
    assert not re.search(r"url\(|@import|<script|<link", source)
    for picture in page.all("img"):
        assert picture["alt"]
        check_picture(picture["src"] or "")
    assert all(header.get("scope") in ("col", "row") for header in page.all("th"))
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids)) and all(link["href"] in {f"#{name}" for name in ids} for link in page.all("a"))
    assert re.search(r"\b(nan|None|inf)\b", page.text) is None
    assert len(page.all("h1")) == 1 and page.all("meta")[1]["name"] == "viewport"
    return page


def expect(page: Page, *pieces: str) -> None:
    """Check that the text of a page holds each of some pieces."""
    assert [piece for piece in pieces if piece not in page.text] == [], page.text


def check_picture(source: str) -> None:
    """Check that a picture is an SVG without anything from outside and without numbers that are none, or a PNG."""
    data = base64.b64decode(source.partition(",")[2], validate=True)
    if source.startswith("data:image/png"):
        assert data.startswith(b"\x89PNG")
        return
    svg = data.decode()
    assert svg.startswith("<svg") and svg.rstrip().endswith("</svg>") and "nan" not in re.sub(r'"data:[^"]*"', "", svg)
    assert all(target.startswith(("#", "data:image/png")) for target in re.findall(r'href="([^"]*)"', svg))


# Loops


def test_a_loop_shows_its_sentence_and_its_ten_items_with_their_numbers(tmp_path: Path) -> None:
    page = report(write_loop_folder(tmp_path / "out"))
    assert page.text.startswith("block femsense report block " + SENTENCE)
    expect(
        page,
        "2.04 mm 95 % interval 1.85 … 2.21 mm",
        "0.173 mm 95 % interval 0.160 … 0.185 mm",
        "Recovered 100 %",
        "1.90 mm before, 0.170 mm after",
        "1. Residual on the robot",
        "the black one is the direction of the camera",
        "Single frames of the fitted data",
        "2. What the residual goes with",
        "The pattern holds 81 % of the squared residual before",
        "goes best with: unloading (rank correlation −0.82)",
        "by sweep (3 sweeps)",
        "Marker tip along (0, 0, 1.0); the model misses it there by 2.00 mm rms before and 0.100 mm after",
        "unloading −0.82 9.0 × 10⁻⁶ −0.20",
        "time 0.11 9.0 × 10⁻⁶ –",
        "3. Error on held-out data",
        "72 measurements of 3 markers",
        "the error fell in 24 of 24 held-out frames",
        "The error fell in 2 of 2 held-out sweeps",
        "4. Effects",
        "vector_m_s2 (0.10 ± 0.30, 0.02 ± 0.25, −9.70 ± 0.12) m/s² 2.04 mm 0.310 mm",
        "coefficient 0.210 ± 0.015 0.310 mm 0.173 mm",
        "law capstan",
        "scale top 1.0310 ± 0.0040 – –",
        "scale side 0.985",
        "−9.70 ± 0.12) m/s² in [−12, 12] m/s² 5321 5290 42.0 ± 8.0 83 % 97 % named: part of the improved model",
        "force_n[0] 0.120 ± 0.010 N in [−20, 20] N 4100 4070 – 40 % 3 % alternative: passes all tests too",
        "poisson_ratio in [0.050, 0.50] 0 −7.40 – 5 % – not testable: 97 % of it is absorbed by calibration",
        "5. What these data cannot say",
        "gravity and payload: their evidence differs by a ΔBIC of 3.2 only",
        "97.2 % of the second is absorbed by calibration",
        "poisson: 97 % of it is absorbed by calibration",
        "Next experiment: turn the base by 90°",
        "How much of the trace of the effect on the left is collinear with that of the effect below",
        "6. What calibration had taken up",
        "Camera turned, recording 2 – 0 (0.0573 ± 0.0011, 0.1146 ± 0.0011, −0.0573 ± 0.0011) °",
        "Camera shifted, recording 1 – 0 (1.000 ± 0.020,",
        "Initial input of top – 0.310 ± 0.020 N 0.400 ± 0.030 N 0.300 N",
        "stiffness: scale 1.00 – 0.800 ± 0.010 1.010 ± 0.012",
        "7. Tests, and what is left",
        "the residuals of neighbouring states are correlated p = 0.0020 p = 0.31",
        "Any structure (1 %, Holm) yes no",
        "F = 31, p = 1.0 × 10⁻⁹ (40, 12 degrees of freedom; repeats differ by 0.200 mm) not testable",
        "most at marker tip, mean (0.0100, −0.0200, 0.0600) mm",
        "most in frame 17, 0.290 mm",
        "none seen beyond noise (correlation of neighbouring states 0.050, smallest p = 0.31)",
        "unloading −0.41 0.030 0.15",
        "8. Smallest effects that would have been seen",
        "the right Poisson ratio not testable soft_region",
        "scale a change of 22 %",
        "radius_m a change of 2.0 mm",
        "softer than 10000 N/m",
        "a change of 0.10 mm … 0.30 mm (9 parameters)",
        "stiffness_n_m cannot be seen",
        "or softening with stretch would have been seen",
        "too small to be seen here: its whole change would have to be 3.00 times as large",
        "9. Data",
        "Split, recording 1 (first) 2 of 6 sweeps",
        "0–3, 7 (5)",
        "touched, load not declared: 4–6 (3)",
        "no markers: 9 (1)",
        "Frames left out, 2 none",
        "Outliers left out tip in frame 4, stalk in frame 9",
        "reached again the same way) 2",
        "each measurement by itself 0.080 mm",
        "restricted maximum likelihood, with repeats",
        "Error of the mesh, at the markers 0.050 mm",
        "Fitted along: stiffness scale 1.113 ± 0.012",
        "Seed 0",
        "femsense 0.1.0, numpy 2.0",
        "Recording 1 first abcdabcdabcdabcd",
        "10. What it means for forces",
        "in held-out frames",
        "0.14 N (19.0 %) with the declared robot, calibrated; 10 mN (1.5 %) with the improved one".replace("10 mN", "0.010 N"),
        "9 0.500 N 0.410 ± 0.010 N −18 % 0.490 ± 0.010 N −2.0 %",
        "11 1.00 N 0.800 ± 0.020 N −20 % 1.010 ± 0.020 N +1.0 %",
    )
    assert len(page.all("img")) == 10


def test_without_loads_the_compliance_says_what_forces_do(tmp_path: Path) -> None:
    page = report(write_loop_folder(tmp_path, evidence__forces=COMPLIANCE))
    expect(
        page,
        "sensed as 0.910 times the force that the declared robot senses (median over places and frames; 0.900 to 0.920)",
        "rest (0) 0.900 … 0.920 0.031 N 0.0020 N",
    )


def test_what_no_effect_explains_is_shown_where_it_acts(tmp_path: Path) -> None:
    left = {
        "rms_m": 9e-4,
        "where": {"marker": "tip", "mean_residual_m": [0.0, 0.0, 1e-3], "direction": [0.0, 0.6, 0.8], "direction_share": 0.91},
        "worst_frame": {"frame": 17, "rms_m": 2e-3},
        "worst_frames": [{"frame": 17, "rms_m": 2e-3}, {"frame": 18, "rms_m": 1e-3}],
        "half_in_frames": 0.08,
        "explained_share": 0.32,
        "goes_with": [{"covariate": "known load", "rank_correlation": 0.7, "p_value": 1e-4, "p_holm": 1e-3}],
        "structure": {"lag_one": 0.6, "p_value": 0.002, "significant": True},
    }
    page = report(write_loop_folder(tmp_path, verdict="unexplained", effects=[], left=left))
    expect(
        page,
        "91 % of it there lies along (0, 0.60, 0.80)",
        "most in frame 17, 2.00 mm rms, then in 18.",
        "8 % of the frames hold half",
        "the residual is not mere noise",
        "known load 0.70 0.00010 0.0010",
        "Not evidence: the smallest forces on the surface",
        "they explain 93 % of it",
        "Together they make (0, 0, −100) mN.",
    )
    assert len(page.all("img")) == 10 and "took away" not in page.text
    expect(
        report(write_loop_folder(tmp_path / "some", left=left)),
        "The effects took away 32 % of the squared residual beyond the noise.",
    )
    calm = report(write_loop_folder(tmp_path / "calm", verdict="none", effects=[]))
    assert "Not evidence" not in calm.text


def test_a_loop_of_an_earlier_version_says_what_it_lacks(tmp_path: Path) -> None:
    page = report(write_loop_folder(tmp_path, evidence=None))
    expect(page, "Run femsense improve again for the whole report.", "1. Residual on the robot", "4. Effects", "9. Data")
    assert "earlier femsense" not in report(write_loop_folder(tmp_path / "new")).text


def test_each_part_of_the_evidence_stands_alone(tmp_path: Path) -> None:
    bare: dict[str, Any] = {"residuals": None, "left": None, "candidates": None}
    empty = report(write_loop_folder(tmp_path / "empty", robot=False, evidence={}, **bare)).text
    said = {
        part: report(write_loop_folder(tmp_path / part, robot=False, evidence={part: content}, **bare)).text != empty
        for part, content in evidence_document().items()
    }
    assert {part for part, says in said.items() if not says} <= {"tip", "ranking", "equivalent_forces"}  # these go with others


def test_the_same_folder_gives_the_same_page(tmp_path: Path) -> None:
    folder = write_run_folder(write_loop_folder(tmp_path / "a" / "loop").parent / "run").parent
    first = write_report(folder, tmp_path / "first.html").read_bytes()
    assert write_report(folder, tmp_path / "second.html").read_bytes() == first
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "first.html", "second.html"]


@pytest.mark.parametrize(
    ("verdict", "sentence"),
    [
        ("effects", "The data name what the model lacks."),
        ("none", "The model explains the data to their noise."),
        ("unexplained", "A residual remains that no effect explains."),
    ],
)
def test_a_loop_of_the_verdict_alone_shows_just_that(tmp_path: Path, verdict: str, sentence: str) -> None:
    (tmp_path / "loop.json").write_text(json.dumps({"format": "femsense-loop-1", "verdict": verdict}), encoding="utf-8")
    page = report(tmp_path)
    assert sentence in page.text
    assert not page.all("img") and not page.all("table") and not page.all("h3")


def test_nothing_known_is_a_dash(tmp_path: Path) -> None:
    rms = {"train_rms_m": 1e-3, "validation_rms_m": None, "validation_ci_m": [None, float("nan")]}
    page = report(
        write_loop_folder(
            tmp_path,
            before=rms,
            effects__0__validation_rms_before_m=float("nan"),
            effects__1__parameters__coefficient__value=None,
        )
    )
    assert "Held-out error, before – 95 % interval –" in page.text
    assert "coefficient – " in page.text and "m/s² – 0.310 mm" in page.text
    assert "Recovered" not in page.text


def test_residuals_that_are_not_known_do_not_count(tmp_path: Path) -> None:
    page = report(
        write_loop_folder(tmp_path, residuals__before_m__0=[None, 0.0, 0.0], residuals__after_m__1=[0.0, float("nan"), 0.0])
    )
    assert "70 measurements of 3 markers" in page.text and len(page.all("img")) == 10


def test_without_the_robot_there_is_no_picture_of_it(tmp_path: Path) -> None:
    page = report(write_loop_folder(tmp_path, robot=False))
    assert "Small dots are single frames" not in page.text and len(page.all("img")) == 8


@pytest.mark.parametrize(
    "missing",
    [
        "effects",
        "candidates",
        "confounded",
        "not_testable",
        "detectable",
        "left",
        "data",
        "residuals",
        "noise_m",
        "before",
        "next_experiment",
        "versions",
        "inputs",
    ],
)
def test_each_missing_part_is_left_out(tmp_path: Path, missing: str) -> None:
    page = report(write_loop_folder(tmp_path / "loop", robot=False, **{missing: None}))
    titles = {
        "effects": "Effects in the order",
        "candidates": "Every effect that was tried",
        "detectable": "Smallest effects",
        "left": "What the size of the residual",
        "residuals": "measurements of 3 markers",
    }
    assert SENTENCE in page.text
    assert titles.get(missing, "nowhere") not in page.text
    assert all(title in page.text for key, title in titles.items() if key != missing)


def test_names_are_escaped(tmp_path: Path) -> None:
    evil = '<b>"x"&amp;$y$'
    loop = write_loop_folder(
        tmp_path / "evil",
        robot=False,
        inputs__robot__name=evil,
        sentence=f"it lacks {evil}",
        left__marker_rms_m={evil: 1e-3},
        effects__0__name=evil,
        left__where__marker=evil,
        next_experiment=evil,
        data__noise_source=evil,
        candidates__0__verdict=evil,
        detectable={evil: {"smallest": {evil: 1.0}, "unit": evil}},
        confounded__0__pair=[evil, evil],
        not_testable__0__name=evil,
        versions={evil: evil},
    )
    run = write_run_folder(tmp_path / "run", robot=evil, reason=evil.replace('"', '""'))
    write_calibration_file(
        run / "calibration.json", status=evil, cable_tension_n={evil: 1.0}, marker_rms_m={evil: 1e-3}, cameras__0__name=evil
    )
    page = report(loop.parent)
    assert "b" not in {tag for tag, _ in page.tags}
    assert page.text.count(evil) > 12


# Runs and calibrations


def test_a_run_shows_forces_contacts_frames_and_known_loads(tmp_path: Path) -> None:
    page = report(write_run_folder(tmp_path / "run"))
    expect(
        page,
        "2 contacts in 30 frames, 2 of them without a result; largest force 0.697 ± 0.050 N in frame 5.",
        "28 of 30",
        "in 19 frames",
        "0.455 mm 2.11 mm without them",
        "16.0 ms",
        "12 1.20 0 0.298 0.020, 0, −0.30 90.0, 15.0, 30.0 cloud",
        "Which with a result 28 0–2, 5–29 none: no equilibrium: stuck 2 3–4",
        "7 0.500 0.480 −4.0",
        "9 1.00 1.02 +2.0",
        "The median size of the error is 20 mN (3.0 %).",
        "Computing time of each frame; median 16.0 ms, 15.0 to 17.0 ms.",
        "Recording pushes",
        "Frame 5, with the strongest force: contact 0 0.697 ± 0.050 N.",
    )
    assert len(page.all("img")) == 5


def test_a_frame_that_is_not_ok_is_counted_and_gives_no_largest_force(tmp_path: Path) -> None:
    folder = write_run_folder(tmp_path / "run", frames_ok=27)
    table = (folder / "frames.csv").read_text(encoding="utf-8")
    (folder / "frames.csv").write_text(table.replace('\n5,0.5,"ok"', '\n5,0.5,"not explained"'), encoding="utf-8")
    headline = "2 contacts in 30 frames, 2 of them without a result, 1 of them not to be trusted; largest force"
    page = report(folder)
    assert headline in page.text and f"{headline} 0.697" not in page.text


def test_small_forces_are_in_millinewton(tmp_path: Path) -> None:
    page = report(write_run_folder(tmp_path, scale=0.01))
    assert "largest force 6.97 ± 0.50 mN" in page.text and "Force [mN]" in page.text


@pytest.mark.parametrize(("missing", "pictures"), [("contacts.csv", 3), ("frames.csv", 1), ("states.npz", 4)])
def test_a_run_without_one_of_its_files_shows_the_others(tmp_path: Path, missing: str, pictures: int) -> None:
    (write_run_folder(tmp_path) / missing).unlink()
    assert len(report(tmp_path).all("img")) == pictures


def test_a_run_without_contacts(tmp_path: Path) -> None:
    (write_run_folder(tmp_path, contacts=0, known_loads=[]) / "contacts.csv").write_text(CONTACT_HEADER + "\n", encoding="utf-8")
    page = report(tmp_path)
    assert "0 contacts in 30 frames, 2 of them without a result." in page.text
    assert "Contact forces" not in page.text and "Known loads" not in page.text


@pytest.mark.parametrize(("force", "pictures"), [("0,0,0,0,", 4), (",,,,", 3)], ids=["zero", "unknown"])
def test_a_force_that_is_nothing(tmp_path: Path, force: str, pictures: int) -> None:
    (write_run_folder(tmp_path, frames=2) / "contacts.csv").write_text(
        f"{CONTACT_HEADER}\n0,0,0,0,0,0,0,0,1,{force},given,0,1e-3,1e-3,1e-3,5e-3,0.02,0.02,0.05\n", encoding="utf-8"
    )
    assert len(report(tmp_path).all("img")) == pictures


def test_a_run_in_which_every_frame_failed(tmp_path: Path) -> None:
    write_run_folder(tmp_path, contacts=0, frames=2, frames_ok=0)
    (tmp_path / "contacts.csv").write_text(CONTACT_HEADER + "\n", encoding="utf-8")
    (tmp_path / "frames.csv").write_text(f"{FRAME_HEADER}\n0,0,no cloud,0,0,,,,,\n1,1,no cloud,0,0,,,,,\n", encoding="utf-8")
    page = report(tmp_path)
    assert "none: no cloud 2 0–1" in page.text and not page.all("img")


def test_rows_that_noise_may_make_are_not_listed_as_contacts_but_counted(tmp_path: Path) -> None:
    write_run_folder(tmp_path, frames=3)
    rows = "".join(
        f"{k},{0.1 * k},0,0,0,0,0,0,1,0,0,{size},{size},0.1,given,0,,,,,,,{std}\n"
        for k, (size, std) in enumerate(((0.0, ""), (0.2, 0.07), (1.5, "")))
    )
    (tmp_path / "contacts.csv").write_text(f"{CONTACT_HEADER}\n{rows}", encoding="utf-8")
    text = report(tmp_path).text
    assert "1.50 ± 0.10" in text and "0.20 ± 0.10" not in text
    assert "Of less than 3 standard deviations, and so none: 2 rows more of contacts.csv." in text
    assert text.count("1 contact in 3 frames") == 1


def test_a_long_run_stays_small(tmp_path: Path) -> None:
    page = report(write_run_folder(tmp_path, frames=5000))
    assert "5000 frames" in page.text
    rows = "".join(
        f"{k},{0.1 * k},{k % 12},0,0,0,0,0,1,0,0,1,{1 + k % 12},0.1,cloud,{k % 12},1e-3,1e-3,1e-3,5e-3,0.02,0.02,0.05\n"
        for k in range(5000)
    )
    (tmp_path / "contacts.csv").write_text(f"{CONTACT_HEADER}\n{rows}", encoding="utf-8")
    page = report(tmp_path)
    assert "The first 150 of 5000; all of them are in contacts.csv." in page.text and "The 8 strongest of 12." in page.text


def test_a_calibration_shows_pose_inputs_markers_and_history(tmp_path: Path) -> None:
    page = report(write_calibration_file(tmp_path / "calibration.json"))
    expect(
        page,
        "Calibration: converged; the markers lie 0.420 mm (rms) from the model.",
        "front (50.00 ± 0.25, −300.00 ± 0.25, 400.00 ± 0.25) mm",
        "(180.000 ± 0.057, 0.000 ± 0.057, 0.000 ± 0.057) °",
        "(0, 0, −1.00)",
        "top 0.311 ± 0.020 N 1.250 ± 0.080 mm",
        "side 0.200 N (not determined by the data)",
        "0–2, 5",
    )
    assert len(page.all("img")) == 2
    other = write_calibration_file(tmp_path / "other" / "monday.json")
    assert "Pose of the camera" in report(other).text


def test_a_calibration_without_markers(tmp_path: Path) -> None:
    page = report(
        write_calibration_file(tmp_path / "calibration.json", rms_m=None, marker_rms_m={}, history=[], status="pose from clouds")
    )
    assert "Calibration: pose from clouds." in page.text and not page.all("img")


# Folders of several


def test_a_folder_of_several_has_a_chapter_for_each(tmp_path: Path) -> None:
    write_run_folder(
        tmp_path / "declared", known_loads=[{"frame": 1, "declared_n": 1.0, "sensed_n": 0.8, "error_percent": -20.0}]
    )
    write_calibration_file(tmp_path / "declared" / "calibration.json")
    write_loop_folder(tmp_path / "loop")
    write_run_folder(tmp_path / "run")
    (tmp_path / "demo.json").write_text(
        json.dumps(
            {
                "declared": {
                    "force_error_n": 0.21,
                    "force_error_share": 0.3,
                    "place_error_m": 4e-3,
                    "contacts_found": 3,
                    "contacts_true": 5,
                    "contacts_false": 1,
                },
                "improved": {
                    "force_error_n": 0.05,
                    "force_error_share": None,
                    "place_error_m": 1e-3,
                    "contacts_found": 5,
                    "contacts_true": 5,
                    "contacts_false": 0,
                },
            }
        ),
        encoding="utf-8",
    )
    page = report(tmp_path)
    links = ["What the model lacks (loop)", "What it changes", "Forces (declared)", "Calibration (declared)", "Forces (run)"]
    assert page.text.startswith("block femsense report block " + SENTENCE + " " + " ".join(links))
    expect(
        page,
        "Error of force, median 0.210 N 0.0500 N",
        "30.0 % –",
        "3 of 5 5 of 5",
        "declared block 28 of 30 32 0.20 N (20.0 %) 16.0 ms",
        "run block 28 of 30 32 20 mN (3.0 %)",
    )


# What is refused


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda folder: None, "an empty folder"),
        (lambda folder: write_block_robot(folder), "a robot"),
        (lambda folder: (folder / "recording.toml").write_text(""), "a recording"),
        (lambda folder: (folder / "holiday.txt").write_text(""), "holiday.txt"),
    ],
    ids=["empty", "robot", "recording", "foreign"],
)
def test_a_foreign_folder_is_named(tmp_path: Path, make: Any, expected: str) -> None:
    make(tmp_path)
    with pytest.raises(InputError, match="nothing to report on") as error:
        write_report(tmp_path)
    assert error.value.found == expected and not (tmp_path / "report.html").exists()


def test_a_path_that_is_no_folder_and_a_file_that_is_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder") as error:
        write_report(tmp_path / "nowhere")
    assert error.value.found == "nothing"
    folder = write_calibration_file(tmp_path / "calibration.json")
    with pytest.raises(InputError, match="not a folder") as error:
        write_report(folder / "calibration.json")
    assert error.value.hint == f"femsense report {folder}"
    with pytest.raises(InputError, match="a folder exists where the file should be written"):
        write_report(folder, tmp_path)


@pytest.mark.parametrize(
    ("overrides", "place"),
    [
        ({"effects": 5}, "effects"),
        ({"effects__0__name": None}, "effects[0].name"),
        ({"noise_m": "little"}, "noise_m"),
        ({"residuals__before_m__0": [1.0, 2.0]}, "residuals.before_m[0]"),
        ({"residuals__marker": ["tip"]}, "residuals"),
        ({"confounded__0__pair": ["gravity"]}, "confounded[0].pair[1]"),
        ({"evidence": 5}, "evidence"),
        ({"evidence__frames__sweep": ["one"]}, "evidence.frames"),
        ({"evidence__forces__loads__0__frame": "nine"}, "evidence.forces.loads[0].frame"),
        ({"evidence__pictures__frames__0__before_m__0": [1.0]}, "evidence.pictures.frames[0].before_m[0]"),
        ({"format": "femsense-loop-9"}, "format"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_broken_loop_names_the_key(tmp_path: Path, overrides: dict[str, Any], place: str) -> None:
    write_loop_folder(tmp_path, **overrides)
    with pytest.raises(InputError) as error:
        write_report(tmp_path)
    assert error.value.where == f"{tmp_path / 'loop.json'}: {place}"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("run.json", "{"),
        ("run.json", "[]"),
        ("run.json", '{"format": "x"}'),
        ("contacts.csv", "frame\n0\n"),
        ("frames.csv", ""),
        ("states.npz", "x"),
        ("calibration.json", "{}"),
        ("demo.json", "7"),
    ],
)
def test_a_broken_file_is_named(tmp_path: Path, name: str, text: str) -> None:
    (write_run_folder(tmp_path) / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=name):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


# Words and small sums


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "–"),
        (True, "–"),
        (0.0, "0"),
        (0.123456, "0.123"),
        (-12.345, "−12.3"),
        (1234.5, "1234"),
        (1.5e7, "1.50 × 10⁷"),
        (-2e-6, "−2.00 × 10⁻⁶"),
    ],
)
def test_numbers(value: Any, text: str) -> None:
    assert words.number(value) == text


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (1.25e-3, 8e-5, "m", "1.250 ± 0.080 mm"),
        (320e3, 12e3, "Pa", "320 ± 12 kPa"),
        (0.21, None, "1", "0.210"),
        (None, 1.0, "N", "–"),
        (5000.0, 300.0, "N/m", "5000 ± 300 N/m"),
        ([1e-3, None, -2e-3], [1e-4, 1e-4, None], "m", "(1.00 ± 0.10, –, −2.00) mm"),
        ("capstan", None, "1", "capstan"),
        (1e-9, 1e-10, "s", "1.00 × 10⁻⁹ ± 1.0 × 10⁻¹⁰ s"),
        (0.3, 0.0, "N", "0.300 N"),
        (4.18394e14, 1.28e25, "N/m", "4.18 × 10¹⁴ ± 1.3 × 10²⁵ N/m"),
        (-2e-15, 2e-3, "1", "0.0000 ± 0.0020"),
    ],
)
def test_values_with_deviations(value: Any, std: Any, unit: str, text: str) -> None:
    assert words.parameter(value, std, unit).replace("\u00a0", " ") == text


def test_nearly_the_whole_is_not_rounded_up_to_it() -> None:
    shares = [words.nearly(v).replace("\u00a0", " ") for v in (0.9, 0.989, 0.9996, 1.0, None)]
    assert shares == ["90 %", "99 %", "more than 99 %", "more than 99 %", "–"]
    assert words.nearly(0.9996, 1).replace("\u00a0", " ") == "more than 99.9 %"


def test_rounding_is_no_evidence() -> None:
    assert [words.statistic(v) for v in (3.41e-12, -9e-12, 0.0057, -8.7, None)] == ["0", "0", "0.00570", "−8.70", "–"]


def test_what_was_recovered_counts_squares_above_the_noise() -> None:
    assert recovered(5e-3, 3e-3, 0.0) == pytest.approx(16 / 25)
    assert recovered(5e-3, 4e-3, 4e-3) == 1.0 and recovered(5e-3, 6e-3, 1e-3) == 0.0
    assert recovered(1e-3, 9e-4, 9.9e-4) is None and recovered(None, 1e-3, 1e-4) is None


@pytest.mark.parametrize(
    ("size", "kind", "unit", "text"),
    [
        (1.11, "factor", "1", "a change of 11 %"),
        (2.7, "factor", "1", "a factor of 2.7"),
        (1e3, "softer_than", "N/m", "softer than 1000 N/m"),
        (2e-3, "change", "m", "a change of 2.0 mm"),
        (None, "change", "m", "cannot be seen"),
    ],
)
def test_smallest_sizes_in_words(size: float | None, kind: str, unit: str, text: str) -> None:
    assert smallest_words(size, kind, unit).replace("\u00a0", " ") == text


@pytest.mark.parametrize(
    ("size", "kind", "ends", "beyond"),
    [
        (1.3, "change", [0.05, 0.4995], True),
        (0.22, "change", [0.05, 0.4995], False),
        (11.0, "factor", [0.5, 5.0], True),
        (3.7, "factor", [0.1, 5.0], False),
        (0.1, "softer_than", [0.2, None], True),
        (0.9, "softer_than", [0.2, None], False),
        (9.0, "change", [], False),
        (9.0, "change", [0.0, None], False),
    ],
)
def test_a_change_beyond_what_is_plausible(size: float, kind: str, ends: list[float | None], beyond: bool) -> None:
    assert is_beyond(size, kind, ends) == beyond


def test_sizes_that_are_not_plausible_cannot_be_seen(tmp_path: Path) -> None:
    seen = {"smallest": {"poisson_ratio": 0.031}, "would_be_seen": False}
    many = {"smallest": {f"offset_m[{i}]": 1e-3 * (i + 1) for i in range(7)}, "unit": "m", "would_be_seen": False}
    page = report(
        write_loop_folder(tmp_path, not_testable=[], detectable={"poisson": seen, "marker_offset": many}, evidence__power={})
    )
    expect(
        page,
        "poisson_ratio too small to be seen here: it would take a change of 0.031",
        "too small to be seen here (a change of 1.0 mm … 7.0 mm (7 parameters))",
    )
    plausible = {"poisson": {"smallest": {"poisson_ratio": 0.6}}}
    page = report(write_loop_folder(tmp_path / "range", not_testable=[], detectable=plausible, evidence__power={}))
    expect(page, "poisson_ratio too small to be seen here: it would take a change of 0.60")


def test_verdicts_have_the_names_of_the_columns(tmp_path: Path) -> None:
    page = report(write_loop_folder(tmp_path, candidates__1__verdict="too little evidence (dBIC -8.1)"))
    expect(page, "excluded: too little evidence (ΔBIC −8.1)")


# What is written in pictures


def boxes(figure: Any) -> list[Any]:
    """Return where the texts of a figure stand, each with its place [pixel]; checks that they lie in the figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    texts = [t for axes in figure.axes for t in axes.get_children() if isinstance(t, Text) and t.get_text().strip()]
    found = [(t.get_text(), t.get_window_extent(renderer)) for t in texts]
    for text, box in found:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1 and figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1, text
    return found


def check_apart(figure: Any) -> None:
    """Check that no two texts of a figure are printed over each other."""
    found = boxes(figure)
    assert [(a, b) for i, (a, one) in enumerate(found) for b, other in found[:i] if one.overlaps(other)] == []


@pytest.mark.parametrize("high", [(20.0, 200.0), (100.0, 100.0), (200.0, 20.0)])
@pytest.mark.parametrize("cameras", [0, 1, 2])
@pytest.mark.parametrize("panels", [False, True])
def test_keys_below_a_body_stand_apart(high: tuple[float, float], cameras: int, panels: bool) -> None:
    low, corner = np.zeros(2), np.array(high)
    if panels:
        figure, grid = new_panels(2, 3, width=9.4, height=2 * body_height(low, corner, width=9.4 / 3, most=4.7))
    else:
        figure, axes = new_axes(height=body_height(low, corner))
        grid = [[axes]]
    ways = [np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])][:cameras]
    for axes in (axes for line in grid for axes in line):
        frame_body(axes, VIEWS[0], low, corner, key=Key(20.0, "0.5 mm residual", "red"), cameras=ways)
        axes.set_title("before, max (frame 127)\n12.34 mm", fontsize=9.5, fontweight="bold")
    check_apart(figure)


def test_pictures_of_residuals_have_one_scale_and_texts_apart(tmp_path: Path) -> None:
    folder = write_loop_folder(tmp_path)
    loop, robot = saved_loop(read_loop(folder)), load_robot(folder, effects=False)
    rest = skin(robot.body.mesh.nodes, robot.body.mesh.tets)
    assert loop.evidence is not None and loop.residuals is not None
    cameras = loop.evidence.pictures.camera_axes
    mean, frames = mean_residual(loop, loop.residuals.known(), robot, rest), frame_residuals(loop.evidence.pictures, rest)
    assert mean is not None and frames is not None
    bodies = [*mean.figures(cameras), frames.figure(cameras)]
    assert [len(figure.axes) for figure in bodies] == [1, 1, 6]
    for figure in bodies:
        check_apart(figure)
        sizes = np.array([axes.get_position().size for axes in figure.axes])
        np.testing.assert_allclose(sizes, sizes[[0]].repeat(len(sizes), axis=0), rtol=0.01)
    one, two = (figure.axes[0].get_position().size for figure in bodies[:2])
    np.testing.assert_allclose(one, two, rtol=0.01)


def test_the_error_at_known_loads_is_the_median_of_its_size() -> None:
    loads = [KnownLoad(frame=i, declared_n=1.0, sensed_n=s, error_percent=None) for i, s in enumerate((0.5, 1.1, 1.2))]
    assert load_error(loads).replace("\u00a0", " ") == "0.20 N (20.0 %)"
    assert load_error([KnownLoad(frame=0, declared_n=0.0, sensed_n=1.0), KnownLoad(frame=1)]) == "–"


def test_round_lengths_and_views() -> None:
    assert [nice(v) for v in (1.0, 1.9, 2.0, 4.99, 7.0, 0.03)] == pytest.approx([1, 1, 2, 2, 5, 0.02])
    for view in VIEWS:
        np.testing.assert_allclose(view.towards @ np.cross(view.right, view.up), 1.0)
        assert [np.eye(3)["xyz".index(a)].tolist() for a in view.axes] == [view.right.tolist(), view.up.tolist()]
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    assert best_view(cube, np.array([[1.0, 0, 1]])).axes == ("x", "z")
    assert best_view(cube, np.array([[0, 1.0, 1]])).axes == ("y", "z")
    assert best_view(cube, np.array([[1.0, 1, 0]])).axes == ("x", "y")


def test_the_skin_is_seen_from_outside() -> None:
    mesh = block_mesh((2, 1, 1))
    surface = skin(mesh.nodes, mesh.tets)
    corners = surface.nodes[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.einsum("tc,tc->", normals, corners.mean(axis=1) - mesh.nodes.mean(axis=0)) > 0
    assert len(surface.triangles) == 2 * (2 + 4 * 2)


# Loading beside other work


def test_what_draws_pages_is_loaded_beside_other_work_and_may_be_missing() -> None:
    asked: list[str] = []

    def missing(name: str) -> None:
        asked.append(name)
        raise ImportError(name)

    commands.load_pages(missing)
    assert asked == ["femsense.report"]


def test_a_force_is_hollow_where_its_frame_is_not_ok(tmp_path: Path) -> None:
    write_run_folder(tmp_path)
    frames, contacts = read_frames(tmp_path / "frames.csv"), read_contacts(tmp_path / "contacts.csv")

    def hollow(doubtful: int) -> list[float]:
        doubted = [replace(frame, status="not explained") if frame.frame == doubtful else frame for frame in frames]
        (axes,) = forces_figure(contacts, doubted).axes
        lines = [line for line in axes.lines if line.get_markerfacecolor() == "white"]
        return sorted({float(x) for line in lines for x in line.get_xdata()})

    assert hollow(10) == pytest.approx([1.0]) and hollow(28) == []
