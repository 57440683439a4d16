"""The trunk of StanfordASL/trunk-stack: a hanging vacuum hose, six motors with two tendons each,
and the same run with 100 g at its tip.

The hose is taken as an equivalent tube; motor angles become the displacements of two tendons that face each other,
one drawn and one paid out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from femsense import Robot, solve_equilibrium
from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.io.files import write_csv, write_toml
from femsense.io.meshing.robot_from_line import line_into

R_ROBOT_MOCAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""The world has y up; the robot hangs along −z."""
BASE_MOCAP_M = np.array([0.101, 0.0, 0.105])
"""Where the trunk begins, above the discs at rest: nobody says it, so that the pose is fitted."""
DISCS_MM = (104.6, 196.9, 313.0)
"""Lengths along the trunk of the discs, from the first frame."""
RATE_HZ = 100.0
WEIGHT_N = 0.1 * 9.81
MOTORS = {"u1": (1, 45.0), "u2": (2, 107.0), "u3": (0, 180.0), "u4": (2, 197.0), "u5": (0, 248.0), "u6": (1, -45.0)}
"""Disc at which the tendons of a motor end, and the direction [°, x to y] to which it bends:
from a linear map of angles to discs."""
PULLEY_M, DISTANCE_MM = 0.040, 25.0
"""Radius of a pulley and distance of the tendons from the axis. Neither is known.
Their ratio is such that the equivalent tube bends nearly as far as the trunk does (10 mm leave 0.2 of it);
`cable_gain` finds the rest of each motor's own."""
MODULUS_PA, DENSITY = 200e3, 500.0
RADIUS_MM, BORE_MM = 30.0, 20.0


def description() -> dict[str, object]:
    """Return the text of `femsense mesh`: a tube with twelve channels."""
    tendons = []
    for name, (disc, angle) in MOTORS.items():
        for side, turn in (("a", 0.0), ("b", 180.0)):
            tendons.append(
                {
                    "name": name + side,
                    "distance_mm": DISTANCE_MM,
                    "angle_deg": -(angle + turn),
                    "end_mm": DISCS_MM[disc],
                    "points": 10 + 6 * disc,
                }
            )
    return {
        "format": "femsense-line-1",
        "name": "trunk",
        "rings": 2,
        "material": {"young_modulus_pa": MODULUS_PA, "poisson_ratio": 0.3, "density_kg_m3": DENSITY},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "sections": [{"at_mm": [0.0, 0.0, -s], "radius_mm": RADIUS_MM, "bore_mm": BORE_MM} for s in (0.0, DISCS_MM[-1] + 5.0)],
        "tendons": tendons,
        "markers": [{"name": f"disc{i}", "along_mm": s} for i, s in enumerate(DISCS_MM, 1)],
    }


def make_robot(folder: Path, *, most_tets: int = 700) -> Path:
    """Write the robot."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    text = folder.with_suffix(".toml")
    write_toml(text, description())
    line_into(folder, text, most_tets=most_tets)
    return folder


@dataclass(frozen=True)
class Run:
    """A run of the motors."""

    angles: FloatArray
    """Measured motor angles [rad], shape (n, 6)."""
    discs: FloatArray
    """[m], motion-capture frame, shape (n, 3, 3)."""


def read_run(data: Path, *, loaded: bool) -> Run:
    """Return the run with nothing, or with 100 g, at the tip."""
    rows = np.loadtxt(data / f"observations_controlled_1{'_100g' if loaded else ''}.csv.gz", delimiter=",", skiprows=1)
    return Run(np.radians(rows[:, 10:]), rows[:, 1:10].reshape(-1, 3, 3))


def still_frames(runs: list[Run], count: int) -> IntArray:
    """Return frames at which the discs hardly move in all runs, spread over the angles, in order."""
    slow = np.ones(len(runs[0].discs), dtype=bool)
    for run in runs:
        slow &= _slow(run)
    candidates = np.flatnonzero(slow)
    angles = runs[0].angles[candidates]
    chosen, distance = [0], np.full(len(candidates), np.inf)
    while len(chosen) < count:  # each next one is the farthest from those that are there
        distance = np.minimum(distance, np.linalg.norm(angles - angles[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.sort(candidates[chosen])


def _slow(run: Run, *, share: float = 0.08) -> BoolArray:
    speed = np.linalg.norm(np.gradient(run.discs[:, 2], axis=0), axis=1) * RATE_HZ
    smooth = np.convolve(speed, np.ones(11) / 11, mode="same")
    return np.asarray(smooth <= np.quantile(smooth, share))


def write_recording(folder: Path, run: Run, frames: IntArray, *, pose: FloatArray | None = None) -> Path:
    """Write frames of a run: displacements of the tendons, discs in the motion-capture frame."""
    document: dict[str, object] = {
        "format": "femsense-recording-1",
        "actuation": "displacement",
        "actuation_zero": "absolute",
        "session": "trunk",
    }
    document |= {} if pose is None else {"T_robot_camera": pose.tolist()}
    folder.mkdir(parents=True, exist_ok=True)
    write_toml(folder / "recording.toml", document)
    names = [name + side for name in MOTORS for side in "ab"]
    rows, markers = [], []
    for i, k in enumerate(frames):
        drawn = PULLEY_M * run.angles[k]
        both = np.stack([drawn, -drawn], axis=1).ravel()
        rows.append([i, k / RATE_HZ, *both.tolist(), f"s{i // 4}"])
        markers += [[i, f"disc{j}", *point.tolist()] for j, point in enumerate(run.discs[k], 1)]
    write_csv(folder / "frames.csv", ["frame", "time_s", *(f"cable_{n}" for n in names), "sweep"], rows)
    write_csv(folder / "markers.csv", ["frame", "marker", "x_m", "y_m", "z_m"], markers)
    return folder


def first_pose() -> FloatArray:
    """Return T_robot_camera as far as the axes and the first frame say it, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_ROBOT_MOCAP, -R_ROBOT_MOCAP @ BASE_MOCAP_M
    return T


def later(run: Run) -> Run:
    """Return a run half a second later: a twin in which nothing was hung on."""
    return Run(np.roll(run.angles, -50, axis=0), np.roll(run.discs, -50, axis=0))


def shifts_between(
    robot: Robot, first: Run, second: Run, frames: IntArray, *, step: float = 0.1
) -> tuple[FloatArray, FloatArray]:
    """Return how the discs of each frame answer to a force at the tip [m/N], shape (f, disc, axis, 3), and by how much they differ
    between two runs beyond what the model makes of their inputs [m], shape (f, disc, axis).

    What is common to both runs, errors of the model and of the pose too, drops out.
    """
    tip = np.flatnonzero(robot.body.mesh.nodes[:, 2] < robot.body.mesh.nodes[:, 2].min() + 1e-6)
    responses, differences = [], []
    for k in frames:
        states = [solve_equilibrium(robot.body, shortening=drawn(robot, run.angles[k])) for run in (first, second)]
        at_rest = robot.markers.positions(states[1].positions)
        columns = []
        for axis in range(3):
            forces = np.zeros_like(robot.body.mesh.nodes)
            forces[tip, axis] = step / len(tip)
            pushed = solve_equilibrium(
                robot.body, shortening=drawn(robot, second.angles[k]), nodal_forces=forces, start=states[1]
            )
            columns.append((robot.markers.positions(pushed.positions) - at_rest) / step)
        measured = (second.discs[k] - first.discs[k]) @ R_ROBOT_MOCAP.T
        differences.append(measured - (at_rest - robot.markers.positions(states[0].positions)))
        responses.append(np.stack(columns, axis=2))
    return np.array(responses), np.array(differences)


def force_of(responses: FloatArray, differences: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the force at the tip [N] that explains shifts of some discs along some axes (see `shifts_between`) by least squares,
    the std of its mean over frames, and over frames, each (3,)."""
    count = len(responses)
    J, d = responses.reshape(count, -1, 3), differences.reshape(count, -1)
    blocks = np.array_split(np.arange(count), 8)

    def fit(some: IntArray) -> FloatArray:
        return np.asarray(np.linalg.lstsq(J[some].reshape(-1, 3), d[some].ravel(), rcond=None)[0])

    left_out = np.array([fit(np.setdiff1d(np.arange(count), block)) for block in blocks])
    std = np.sqrt(len(blocks) - 1.0) * left_out.std(axis=0)  # jackknife
    each = np.array([fit(np.array([i])) for i in range(count)])
    return fit(np.arange(count)), std, each.std(axis=0)


def drawn(robot: Robot, angles: FloatArray) -> dict[str, float]:
    """Return the displacement of each tendon [m] for motor angles [rad], shape (6,)."""
    return {name + side: sign * PULLEY_M * a for name, a in zip(MOTORS, angles) for side, sign in (("a", 1.0), ("b", -1.0))}


def make(folder: Path, data: Path, *, count: int = 48) -> tuple[Path, dict[str, Path]]:
    """Write the robot and recordings: without and with the weight, and without it half a second later; of each frames to fit and frames that are held out."""
    runs = {"none": read_run(data, loaded=False), "load": read_run(data, loaded=True)}
    frames = still_frames(list(runs.values()), count)
    runs["later"] = later(runs["none"])
    parts = {"": frames[::2], "-held": frames[1::2]}
    made = {
        name + end: write_recording(folder / (name + end), run, some) for name, run in runs.items() for end, some in parts.items()
    }
    return make_robot(folder / "robot"), made
