"""The tentacle of tud-phi/soromox: a hanging silicone cone with two tendons, 18 static runs in two sessions, OptiTrack."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.io.files import write_csv, write_toml
from femsense.io.meshing.robot_from_line import line_into

DRUM_M = 0.0325
"""Torque over tension: the radius of the drums [m]."""
LENGTH_MM = (305.0, 360.0)
R_ROBOT_MOCAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
BASE_M = np.array([0.03, 0.0, -0.013])
"""The marker beside the clamp, robot frame."""
MARKERS = ("base", "p1", "p2", "p3", "tip")
NOISE_M = 0.0002
SESSION_A = {f"m{m}_u{u}" for m in (1, 2) for u in ("01", "015", "02", "025")}
MODULUS_PA, POISSON, PRIOR_DENSITY, FIT_DENSITY = 505e3, 0.45, 1500.0, 1100.0
"""The authors' prior, and the density that is plausible for a silicone."""
POINTS = 60


@dataclass(frozen=True)
class Pose:
    """One static run."""

    name: str
    tensions: FloatArray
    """[N], shape (2,)."""
    parts: FloatArray
    """Means of parts of the run [m], motion-capture frame, shape (parts, 5, 3)."""

    @property
    def session(self) -> str:
        return "A" if self.name in SESSION_A else "B"


def description(density: float = FIT_DENSITY, *, points: int | None = POINTS) -> dict[str, object]:
    """Return the text of `femsense mesh`: a cone with two channels (docs/guides/bodies.md).

    The authors' 30° and 150° are counted from the robot's y to its x, for a body that hangs along −z; ours from x,
    about the line.
    """
    radii = zip((0.0, *LENGTH_MM), (15.41, 6.42, 4.80))
    tendon = {"distance_mm": [11.4, 11.4 - 0.0295 * LENGTH_MM[0]], "end_mm": LENGTH_MM[0], "max_tension_n": 8.0}
    tendon |= {} if points is None else {"points": points}
    beside = [("p1", 129.1, 25.0, 0.0), ("p2", 219.5, 21.0, 180.0), ("p3", 280.0, 20.0, 0.0), ("tip", 368.0, 0.0, 0.0)]
    return {
        "format": "femsense-line-1",
        "name": "tentacle",
        "material": {"young_modulus_pa": MODULUS_PA, "poisson_ratio": POISSON, "density_kg_m3": density},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "sections": [{"at_mm": [0.0, 0.0, -s], "radius_mm": r} for s, r in radii],
        "tendons": [{"name": f"m{i}", "angle_deg": a} | tendon for i, a in ((1, -60.0), (2, 60.0))],
        "markers": [{"name": "base", "along_mm": 13.0, "distance_mm": 30.0}]
        + [{"name": n, "along_mm": s, "distance_mm": d, "angle_deg": a} for n, s, d, a in beside],
    }


def make_robot(folder: Path, density: float = FIT_DENSITY, *, points: int | None = POINTS, most_tets: int = 1600) -> Path:
    """Write the robot; the base marker stays with the clamp."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    text = folder.with_suffix(".toml")
    write_toml(text, description(density, points=points))
    line_into(folder, text, most_tets=most_tets)
    with (folder / "robot.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[effects]]\nname = "clamped_marker"\nmarkers = ["base"]\nshare = 0.0\n')
    return folder


def read_runs(data: Path, *, parts: int = 1) -> list[Pose]:
    """Return the runs with their markers in order, as means over parts of each run."""
    with (data / "marker_order.csv").open() as file:
        order = {row["run"]: [int(row[p]) for p in ("pb", "p1", "p2", "p3", "p4")] for row in csv.DictReader(file)}
    runs = []
    for name, columns in order.items():
        rows = np.loadtxt(data / f"{name}.csv", delimiter=",")[:, 2:].reshape(-1, 5, 3)[:, columns]
        means = np.array([part.mean(axis=0) for part in np.array_split(rows, parts)])
        runs.append(Pose(name, _torques(name) / DRUM_M, means))
    return runs


def _torques(name: str) -> FloatArray:
    """Return the torques [N m] of a run: m1_u015 is 0.15 at motor 1, m12_u00050010 is 0.05 at 1 and 0.10 at 2."""
    motors, digits = name.split("_u")
    if motors == "m12":
        both = {"001": (0.1, 0.1), "002": (0.2, 0.2), "002001": (0.2, 0.1), "00050010": (0.05, 0.1)}
        return np.array(both[digits])
    torque = float(f"0.{digits[1:]}")
    return np.array([torque, 0.0] if motors == "m1" else [0.0, torque])


def declared_pose(runs: Sequence[Pose]) -> FloatArray:
    """Return T_robot_camera from the base marker of a session and the axes of the authors, shape (4, 4)."""
    base = np.mean([run.parts[:, 0].mean(axis=0) for run in runs], axis=0)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_ROBOT_MOCAP, BASE_M - R_ROBOT_MOCAP @ base
    return T


def write_recording(
    folder: Path, runs: Sequence[Pose], *, pose: bool = False, zero: str = "absolute", noise: bool = True
) -> Path:
    """Write runs of one session as a recording: a frame each, or one a part; each run is a sweep."""
    sessions = {run.session for run in runs}
    document: dict[str, object] = {"format": "femsense-recording-1", "actuation": "tension", "actuation_zero": zero}
    document |= {"session": sessions.pop()} if len(sessions) == 1 else {}
    document |= {"T_robot_camera": declared_pose(runs).tolist()} if pose else {}
    document |= {"marker_noise_m": NOISE_M} if noise else {}
    folder.mkdir(parents=True, exist_ok=True)
    write_toml(folder / "recording.toml", document)
    frames, markers = [], []
    for i, run in enumerate(runs):
        for j, means in enumerate(run.parts):
            frame = i * len(run.parts) + j
            frames.append([frame, 4.0 * i + 1.0 * j, *run.tensions.tolist(), run.name])
            markers += [[frame, name, *point.tolist()] for name, point in zip(MARKERS, means)]
    write_csv(folder / "frames.csv", ["frame", "time_s", "cable_m1", "cable_m2", "sweep"], frames)
    write_csv(folder / "markers.csv", ["frame", "marker", "x_m", "y_m", "z_m"], markers)
    return folder


@dataclass(frozen=True)
class Way:
    """A way of asking."""

    name: str
    density: float = FIT_DENSITY
    parts: int = 1
    pose: bool = False
    zero: str = "absolute"
    held_out: bool = True
    """The two-tendon runs are for validation; else they are fitted too, and whole runs are left out in turn."""
    noise: bool = False
    """recording.toml declares what a marker repeats to."""
    options: tuple[str, ...] = ()
    """Of `femsense improve`."""


WAYS = (
    Way("density 1500 as the authors' prior, pose free", density=PRIOR_DENSITY),
    Way("density 1100, pose free"),
    Way("the same, three repeats a state", parts=3),
    Way("the same, pose declared", pose=True),
    Way("the same, zeros of the tensions unknown", zero="unknown"),
    Way("the same, all runs at once", held_out=False),
    Way("the same, noise of the markers declared", noise=True),
    Way(
        "all runs at once, gains and zeros alone",
        held_out=False,
        options=("--effects", "cable_gain", "cable_offset", "stiffness"),
    ),
    Way("density 1500, no payload offered", density=PRIOR_DENSITY, options=("--without", "payload", "tip_mass")),
)


def make(folder: Path, data: Path, way: Way) -> tuple[Path, list[Path], list[Path]]:
    """Write robot and recordings of one way of asking; return the robot, what is fitted and what is held out."""
    runs = read_runs(data, parts=way.parts)
    robot = make_robot(folder / "robot", way.density)
    single = [run for run in runs if not run.tensions.all()]
    parts = {"A": [r for r in single if r.session == "A"], "B": [r for r in single if r.session == "B"]}
    both = [run for run in runs if run.tensions.all()]
    if not way.held_out:
        parts["B"] = parts["B"] + both
    how = {"pose": way.pose, "zero": way.zero, "noise": way.noise}
    train = [write_recording(folder / name, some, **how) for name, some in parts.items()]
    held = [write_recording(folder / "both", both, **how)] if way.held_out else []
    return robot, train, held
