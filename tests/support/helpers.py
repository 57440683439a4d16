"""Small robots and recordings for tests."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import tomli_w

from femsense.fem.mesh import TetMesh
from femsense.model.recording import Recording

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
"""Real robots and recordings that stand beside the repository where there are any."""

CUBE_TETS = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
"""Six tetrahedra of a cube with corners 4 x + 2 y + z; neighbours fit together (Kuhn)."""


def block_mesh(
    cells: Sequence[int] = (4, 2, 2), size: Sequence[float] = (0.1, 0.03, 0.03), *, start: Sequence[float] = (0.0, 0.0, 0.0)
) -> TetMesh:
    """Return a box of cells (three counts) × 6 tetrahedra, size [m], with its lowest corner at start [m]."""
    counts = np.asarray(cells)
    axes = [np.linspace(0.0, length, count + 1) + low for length, count, low in zip(size, counts, start)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape(counts + 1)
    corner = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    cubes = np.stack([number[i : i + counts[0], j : j + counts[1], k : k + counts[2]].ravel() for i, j, k in corner], axis=1)
    tets = cubes[:, CUBE_TETS].reshape(-1, 4)
    x = nodes[tets]
    flip = np.linalg.det(x[:, 1:] - x[:, :1]) < 0
    tets[flip] = tets[flip][:, [0, 2, 1, 3]]
    return TetMesh(nodes, tets)


def block_surface(size: Sequence[float] = (0.1, 0.03, 0.03)) -> tuple[np.ndarray, np.ndarray]:
    """Return points (8, 3) and outward triangles (12, 3) of a box."""
    import trimesh

    box = trimesh.creation.box(extents=size)
    box.apply_translation(np.asarray(size) / 2)
    return np.array(box.vertices), np.array(box.faces)


def block_document(**overrides: Any) -> dict[str, Any]:
    """Return the tables of a block robot, 100 × 30 × 30 mm along x, clamped at x = 0, two cables, three markers.

    An override replaces what stands there; a key such as `mesh__unit` reaches into a table, and None removes a key.
    """
    document: dict[str, Any] = {
        "format": "femsense-robot-1",
        "name": "block",
        "mesh": {"file": "block.vtu", "unit": "mm", "element": "tet4"},
        "material": {"young_modulus_pa": 150e3, "poisson_ratio": 0.45, "density_kg_m3": 1070.0},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": [[-0.001, -0.001, -0.001], [0.001, 0.031, 0.031]]}],
        "cables": [
            {
                "name": "top",
                "path_m": [[0.1, 0.015, 0.03], [0.05, 0.015, 0.03]],
                "pull_point_m": [0.0, 0.015, 0.04],
                "max_tension_n": 5.0,
            },
            {
                "name": "side",
                "path_m": [[0.1, 0.03, 0.015]],
                "pull_point_m": [0.0, 0.04, 0.015],
                "exit_direction": [0.0, 0.0, -2.0],
            },
        ],
        "markers": [
            {"name": "tip", "position_m": [0.1, 0.015, 0.03]},
            {"name": "middle", "position_m": [0.05, 0.015, 0.03]},
            {"name": "stalk", "position_m": [0.1, 0.015, 0.05]},
        ],
        "features": {"count": 12},
        "appearance": {"color_rgb": [0.2, 0.4, 0.8]},
    }
    return changed(document, overrides)


def changed(document: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of tables with changes: `a__b=value` sets document["a"]["b"] (numbers index lists), None removes."""
    result = copy.deepcopy(dict(document))
    for key, value in overrides.items():
        *outer, last = (int(part) if part.isdigit() else part for part in key.split("__"))
        table: Any = result
        for part in outer:
            table = table[part] if isinstance(table, list) else table.setdefault(part, {})
        if value is None:
            del table[last]
        else:
            table[last] = value
    return result


def write_block_robot(folder: Path, *, cells: Sequence[int] = (4, 2, 2), block: TetMesh | None = None, **overrides: Any) -> Path:
    """Write a block robot (see `block_document`) into a folder and return the folder. The mesh file is in millimetres."""
    folder.mkdir(parents=True, exist_ok=True)
    body = block or block_mesh(cells)
    kind = "tetra10" if body.is_quadratic else "tetra"
    meshio.Mesh(np.asarray(body.nodes) * 1e3, [(kind, np.asarray(body.tets))]).write(folder / "block.vtu")
    (folder / "robot.toml").write_text(tomli_w.dumps(block_document(**overrides)), encoding="utf-8")
    return folder


RECORDING_FILES: dict[str, str] = {
    "recording.toml": 'format = "femsense-recording-1"\nactuation = "tension"\nactuation_zero = "absolute"\n',
    "frames.csv": "frame,time_s,cable_top,cable_side\n0,0.0,0.0,0.0\n1,0.5,1.0,0.25\n4,1.0,2.0,0.5\n",
    "markers.csv": "frame,marker,x_m,y_m,z_m\n0,tip,0.1,0.0,0.5\n0,middle,0.05,0.0,0.5\n1,tip,0.1,0.01,0.5\n4,middle,0.05,0.0,0.5\n",
}


def write_small_recording(folder: Path, **files: str | None) -> Path:
    """Write a recording of three frames (0, 1, 4) into a folder and return the folder.

    Arguments give the text of other files, such as `loads_csv="…"`; None leaves a file out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    texts: dict[str, str | None] = {**RECORDING_FILES, **{name.replace("_", "."): text for name, text in files.items()}}
    for name, text in texts.items():
        if text is not None:
            (folder / name).write_text(text, encoding="utf-8", newline="")
    return folder


def marker_grid(recording: Recording, *, view: int = 0) -> np.ndarray:
    """Return the markers as one camera saw them [m], camera frame, shape (F, markers, 3); NaN where hidden."""
    grid = np.full((recording.frame_count, len(recording.marker_names), 3), np.nan)
    mine = recording.marker_view == view
    grid[recording.marker_frame[mine], recording.marker_index[mine]] = recording.marker_xyz[mine]
    return grid
