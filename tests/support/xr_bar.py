"""A bar that bends and twists in a known way."""

from __future__ import annotations

import csv
from itertools import permutations
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from femsense.fem.mesh import TetMesh, oriented, surface_triangles
from femsense.xr.run_contents import export_run

SIZE = np.array([0.03, 0.03, 0.2])


START = 2.0


def bar_mesh(cells: tuple[int, int, int] = (3, 3, 20)) -> TetMesh:
    """An upright bar of SIZE [m], six tetrahedra a cell."""
    counts = [c + 1 for c in cells]
    axes = np.meshgrid(*[np.linspace(0.0, s, n) for s, n in zip(SIZE, counts)], indexing="ij")
    nodes = np.stack(axes, axis=-1).reshape(-1, 3) - [SIZE[0] / 2, SIZE[1] / 2, 0.0]
    number = np.arange(len(nodes)).reshape(counts)
    i, j, k = (np.arange(c) for c in cells)
    tets = []
    for order in permutations(range(3)):
        corner = np.zeros(3, dtype=int)
        path = [number[np.ix_(i, j, k)].ravel()]
        for axis in order:
            corner[axis] = 1
            path.append(number[np.ix_(i + corner[0], j + corner[1], k + corner[2])].ravel())
        tets.append(np.stack(path, axis=1))
    return oriented(TetMesh(nodes, np.vstack(tets)))


def bent(nodes: np.ndarray, bend: float, sway: float, twist: float) -> np.ndarray:
    """Carry cross-sections along a curve whose curvature and twist [1/m] vary with height."""
    height = np.linspace(0.0, SIZE[2], 201)
    step = height[1]
    R, middle = np.eye(3), np.zeros(3)
    turned, along = [], []
    for h in height / SIZE[2]:
        turned.append(R)
        along.append(middle)
        middle = middle + step * R[:, 2]
        R = R @ Rotation.from_rotvec(step * np.array([bend * (1.0 - 0.5 * h), sway * np.sin(3.0 * h), twist])).as_matrix()
    at = np.clip(np.rint(nodes[:, 2] / step).astype(int), 0, 200)
    flat = nodes * [1.0, 1.0, 0.0]
    return np.array(along)[at] + np.einsum("nij,nj->ni", np.array(turned)[at], flat)


def bar_states(nodes: np.ndarray, frames: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Times [s], shape (F,), and nodes [m], shape (F, n, 3), of one slow dance; the first frame is at rest."""
    phase = np.linspace(0.0, 1.0, frames)
    wave = np.sin(2.0 * np.pi * phase)
    states = [bent(nodes, 11.0 * w, 6.0 * np.sin(4.0 * np.pi * p), 5.0 * np.sin(3.0 * np.pi * p)) for w, p in zip(wave, phase)]
    return START + 2.0 * phase, np.array(states)


def bar_surface(frames: int = 24, cells: tuple[int, int, int] = (3, 3, 20)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices at rest (V, 3), states (F, V, 3) and triangles (t, 3) of the bar's surface."""
    mesh = bar_mesh(cells)
    used, triangles = np.unique(surface_triangles(mesh), return_inverse=True)
    _, states = bar_states(mesh.nodes, frames)
    return mesh.nodes[used], states[:, used], triangles.reshape(-1, 3)


def write_run_with_mesh(folder: Path, *, bones: int = 6) -> Path:
    """Write a run folder of the bar with a mesh of few bones: the search for the best number of bones takes seconds."""
    run = write_run(folder)
    export_run(run, run / "robot.glb", bones=bones)
    return run


def write_run(folder: Path, *, contacts: bool = True, frames: int = 24) -> Path:
    """Write a run folder of the bar, with one contact that grows and goes."""
    mesh = bar_mesh()
    times, states = bar_states(mesh.nodes, frames)
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / "states.npz", time_s=times, nodes_m=states.astype(np.float32), tets=mesh.tets, rest_nodes_m=mesh.nodes)
    if not contacts:
        return folder
    touched = int(((mesh.nodes - [0.015, 0.0, 0.15]) ** 2).sum(axis=1).argmin())
    columns = [
        "frame",
        "time_s",
        "contact",
        "x_m",
        "y_m",
        "z_m",
        "nx",
        "ny",
        "nz",
        "fx_n",
        "fy_n",
        "fz_n",
        "force_n",
        "std_n",
        "source",
    ]
    with (folder / "contacts.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(columns)
        for k in range(3, frames - 3):
            size = 2.0 * np.sin(np.pi * k / frames)
            table.writerow([10 + k, times[k], 1, *states[k, touched], 1, 0, 0, -size, 0, 0, size, 0.1, "cloud"])
    return folder
