"""The tendon-driven silicone tentacle of `data/tentacle`: its body as its README gives it,
and its runs as raw motion capture without names."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace

import numpy as np
from helpers import DATA, block_mesh

from femsense.core.arrays import freeze
from femsense.fem.body import make_body, tie_cable
from femsense.fem.mesh import TetMesh, embed_points, oriented, to_quadratic
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, Timeline, UnnamedRows
from femsense.model.robot import Observation, Robot, plain_actuation, spread_features

FOLDER = DATA / "tentacle"
MARKERS = {
    "base": [0.03, 0.0, -0.013],
    "1": [0.025, 0.0, -0.1291],
    "2": [-0.021, 0.0, -0.2195],
    "3": [0.02, 0.0, -0.28],
    "tip": [0.0, 0.0, -0.368],
}
SIDES = {"t1": [0.5, 0.75**0.5], "t2": [0.5, -(0.75**0.5)]}
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the motion-capture frame to the robot frame."""


@dataclass(frozen=True, eq=False, slots=True)
class Run:
    """One static pose."""

    name: str
    tension: np.ndarray
    """[N], shape (2,)."""
    points: np.ndarray
    """Rows of the raw file [m], shape (F, 5, 3)."""
    marker: np.ndarray
    """Which marker each column is, an index of MARKERS, shape (5,): the truth."""


def tentacle(*, modulus: float = 0.505e6, density: float = 1500.0, cells: tuple[int, int, int] = (24, 4, 4)) -> Robot:
    """Return the tentacle with the authors' prior: a cone along −z, clamped at the top."""
    mesh = to_quadratic(_cone(cells))
    path = np.linspace(0.3, 0.005, 12)
    cables = tuple(
        tie_cable(
            mesh,
            name,
            [[*((0.0114 - 0.0295 * s) * np.array(side)), -s] for s in path],
            [*(0.0114 * np.array(side)), 0.02],
            max_tension=20.0,
        )
        for name, side in SIDES.items()
    )
    body = make_body(
        mesh,
        young_modulus=modulus,
        poisson_ratio=0.45,
        density=density,
        clamped=mesh.nodes[:, 2] > -1e-9,
        cables=cables,
        gravity=[0.0, 0.0, -9.81],
    )
    places, share = np.array(list(MARKERS.values())), np.array([0.0, 1, 1, 1, 1])
    ties = embed_points(mesh, places)
    features = spread_features(body, 20)
    robot = Robot("tentacle", body, tuple(MARKERS), freeze(places), ties, features, None, plain_actuation(2), Observation())
    return replace(robot, marker_share=freeze(share)).with_marker_points(places)


def _cone(cells: tuple[int, int, int]) -> TetMesh:
    box = block_mesh(cells, (0.36, 2.0, 2.0), start=(0.0, -1.0, -1.0))
    s, y, z = box.nodes.T
    radius = np.where(s < 0.305, np.interp(s, [0, 0.305], [15.41e-3, 6.42e-3]), np.interp(s, [0.305, 0.36], [6.42e-3, 4.8e-3]))
    across = np.stack([y * np.sqrt(1 - 0.4 * z**2), z * np.sqrt(1 - 0.4 * y**2)], axis=1)
    area = 3.354  # of this rounded square of half width 1; a disc has π
    across *= radius[:, None] * np.sqrt(np.pi / area)
    return oriented(TetMesh(np.column_stack([across, -s]), box.tets))


def runs(*, every: int = 200) -> list[Run]:
    """Return all runs, each `every` so many frames."""
    with (FOLDER / "marker_order.csv").open() as file:
        order = {row["run"]: [int(row[c]) for c in ("pb", "p1", "p2", "p3", "p4")] for row in csv.DictReader(file)}
    with (FOLDER / "markers_static.csv").open() as file:
        tension = {row["run"]: [float(row["tension1_N"]), float(row["tension2_N"])] for row in csv.DictReader(file)}
    found = []
    for name, columns in order.items():
        raw = np.loadtxt(FOLDER / f"{name}.csv", delimiter=",")[::every, 2:17].reshape(-1, 5, 3)
        marker = np.empty(5, dtype=np.int64)
        marker[columns] = np.arange(5)
        found.append(Run(name, np.array(tension[name]), raw, marker))
    return found


def recording_of(chosen: list[Run], *, frames: int = 3, rng: np.random.Generator | None = None) -> tuple[Recording, np.ndarray]:
    """Return one recording of some runs without names, and which marker each row is; rows in the order of the files,
    or shuffled by rng."""
    rows, names, frame, inputs = [], [], [], []
    for run in chosen:
        for points in run.points[:frames]:
            order = np.arange(5) if rng is None else rng.permutation(5)
            rows.append(points[order])
            names.append(run.marker[order])
            frame.append(np.full(5, len(inputs)))
            inputs.append(run.tension)
    recording = make_recording(
        Timeline(0.1 * np.arange(len(inputs)), free=np.ones(len(inputs), dtype=bool)),
        drives=Drives(tuple(SIDES), np.array(inputs)),
        unnamed=UnnamedRows(frame=np.concatenate(frame), xyz=np.vstack(rows)),
    )
    return recording, np.concatenate(names)
