"""The two-segment pneumatic arm of ASU-RISE-Lab: pressures in psi, rigid bodies at its base, middle and tip, on three days.

Its inside is not described. The equivalent body is a rod with four chambers a segment; the first faces the second,
and the third stands for a pair beside them (seen from which way the states bend). Columns 7 to 12 drive the segment at the base.
Between April 4 and April 5 the arm at rest became 21 and 37 mm longer: each day has its own robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from femsense.core.arrays import FloatArray
from femsense.io.files import write_csv, write_toml
from femsense.io.meshing.robot_from_line import line_into

PSI_PA = 6894.76
MIDDLES_MM = {"apr_4": (132.0, 260.0), "apr_5": (154.5, 297.0)}
"""How far the rigid bodies of middle and tip hang below that of the base, with 1 psi."""
PRESSURES = (10, 11, 12, 4, 5, 6)
"""Columns of the measured pressures: chambers 1, 2, 3 of the segment at the base, then of that at the tip."""
BODIES = {"base": 17, "mid": 24, "tip": 31}
ARM_MM = 40.0
"""A second marker of each rigid body lies so far along its x."""
HALF_TURNS = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
"""Signs of the axes of a rigid body: motion capture takes the tip for itself turned by half a turn, and back, up to ten times a second, the middle
for a while: their balls are symmetric."""
RADIUS_MM, END_MM = 25.0, 8.0
INNER_MM, OUTER_MM, SPAN_DEG = 7.0, 22.0, 76.0
"""Of a chamber: as large as four have room for, so that a body that is stiff enough not to be blown up bends as far as the arm does."""
MODULUS_PA, DENSITY = 750e3, 800.0
HOLD_S = 10.0


def description(day: str) -> dict[str, object]:
    """Return the text of `femsense mesh`: a rod with four chambers in each of two segments."""
    middle, tip = MIDDLES_MM[day]
    chambers = []
    for segment, (low, high) in (("base", (0.0, middle)), ("tip", (middle, tip))):
        for name, angle in (("1", 180.0), ("2", 0.0), ("3a", 90.0), ("3b", 270.0)):
            place = {"from_mm": low + END_MM, "to_mm": high - END_MM, "angle_deg": angle}
            shape = {"inner_mm": INNER_MM, "outer_mm": OUTER_MM, "span_deg": SPAN_DEG}
            chambers.append({"name": f"{segment}-{name}", "max_pressure_pa": 120e3} | shape | place)
    markers = []
    for name, along in (("base", 0.0), ("mid", middle), ("tip", tip)):
        markers.append({"name": name, "along_mm": along})
        markers.append({"name": f"{name}-x", "along_mm": along, "distance_mm": ARM_MM, "angle_deg": 0.0})
    return {
        "format": "femsense-line-1",
        "name": "arm",
        "material": {"young_modulus_pa": MODULUS_PA, "poisson_ratio": 0.45, "density_kg_m3": DENSITY},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "sections": [{"at_mm": [0.0, 0.0, -s], "radius_mm": RADIUS_MM} for s in (0.0, tip)],
        "chambers": chambers,
        "markers": markers,
    }


def make_robot(folder: Path, day: str, *, most_tets: int = 3000) -> Path:
    """Write the robot of a day; the base's markers stay with the clamp."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    text = folder.with_suffix(".toml")
    write_toml(text, description(day))
    line_into(folder, text, most_tets=most_tets)
    with (folder / "robot.toml").open("a", encoding="utf-8") as file:
        file.write('\n[[effects]]\nname = "clamped_marker"\nmarkers = ["base", "base-x"]\nshare = 0.0\n')
    return folder


@dataclass(frozen=True)
class State:
    """The end of a hold, or a moment in it."""

    time_s: float
    pressures: FloatArray
    """[Pa], shape (6,)."""
    markers: FloatArray
    """[m], motion-capture frame, shape (6, 3)."""
    hold: int


def read_states(data: Path, name: str, *, ends: tuple[float, ...] = (0.6, 1.0)) -> list[State]:
    """Return states of a recording at shares of each hold of ten seconds: medians of a quarter of a second."""
    rows = np.loadtxt(data / f"{name}.csv.gz", delimiter=",")
    began, states = rows[0, 0], []
    for hold in range(round((rows[-1, 0] - began) / HOLD_S)):
        for share in ends:
            at = began + HOLD_S * (hold + share) - 0.05
            window = rows[(rows[:, 0] > at - 0.25) & (rows[:, 0] <= at)]
            points = [
                np.median(p, axis=0) for first in BODIES.values() for p in (window[:, first : first + 3], along_x(window, first))
            ]
            states.append(State(at - began, PSI_PA * np.median(window[:, list(PRESSURES)], axis=0), np.array(points), hold))
    return states


def along_x(rows: FloatArray, first: int) -> FloatArray:
    """Return the second marker of a rigid body [m], shape (k, 3): along its x, without the half turns of motion capture.

    Of the four ways in which it may be turned the one is taken that is nearest to the base: none bends by a right angle.
    """
    axes, base = _axes(rows, first), _axes(rows, BODIES["base"])
    along = np.einsum("kij,kij->kj", base, axes)
    turn = HALF_TURNS[np.argmax(along @ HALF_TURNS.T, axis=1)]
    return np.asarray(rows[:, first : first + 3] + 1e-3 * ARM_MM * turn[:, :1] * axes[:, :, 0])


def _axes(rows: FloatArray, first: int) -> FloatArray:
    """Return the axes of a rigid body, the columns of (k, 3, 3)."""
    return np.asarray(Rotation.from_quat(rows[:, first + 3 : first + 7]).as_matrix())


def write_recording(folder: Path, states: list[State]) -> Path:
    """Write states: pressures of the chambers, six markers; each hold is a sweep."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {"format": "femsense-recording-1", "actuation": "tension", "actuation_zero": "absolute"}
    write_toml(folder / "recording.toml", document)
    names = [f"chamber_{segment}-{c}" for segment in ("base", "tip") for c in ("1", "2", "3a", "3b")]
    frames, markers = [], []
    for i, state in enumerate(states):
        b1, b2, b3, t1, t2, t3 = state.pressures.tolist()
        frames.append([i, state.time_s, b1, b2, b3, b3, t1, t2, t3, t3, f"hold{state.hold}"])
        labels = [f"{name}{end}" for name in BODIES for end in ("", "-x")]
        markers += [[i, label, *point.tolist()] for label, point in zip(labels, state.markers)]
    write_csv(folder / "frames.csv", ["frame", "time_s", *names, "sweep"], frames)
    write_csv(folder / "markers.csv", ["frame", "marker", "x_m", "y_m", "z_m"], markers)
    return folder


def make(folder: Path, data: Path, day: str) -> tuple[Path, list[Path], list[Path]]:
    """Write robot and recordings of a day; return the robot, what is fitted and what is held out."""
    robot = make_robot(folder / "robot", day)
    if day == "apr_4":
        return (
            robot,
            [write_recording(folder / "4_1", read_states(data, "apr_4_1"))],
            [write_recording(folder / "4_2", read_states(data, "apr_4_2"))],
        )
    states = read_states(data, "apr_5_1")
    return robot, [write_recording(folder / "first", states[:8])], [write_recording(folder / "last", states[8:])]
