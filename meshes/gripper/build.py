"""Build the gripper: two notched fingers that hang from a palm, with a cable in each.

    python meshes/gripper/build.py              # gripper.vtu and robot.toml
    python meshes/gripper/build.py --picture    # gripper.png too

The palm is clamped at its top. Each cable runs down the inner side of a finger, through its ribs,
and is tied to the last one: pulled, it closes the finger. The body is built of blocks,
so that the script makes the same mesh each time.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from femsense import TetMesh, block_mesh
from femsense.core.arrays import BoolArray, FloatArray

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from workshop import SILICONE, Portrait, build, micrometres  # noqa: E402

HALF, BACK, THICK = 32.0, 7.0, 16.0
"""Half the palm's length, thickness of a finger where it is notched and where it is not [mm]."""
PALM, SEGMENT, NOTCH, SEGMENTS = 14.0, 13.0, 4.0, 6
"""Height of the palm, of a segment (notch and rib) and of its notch, number of segments [mm]."""
WIDTH = 18.0
CABLE = 11.5
"""Distance of the cables from the outer side of the finger [mm]."""
LENGTH = PALM + SEGMENTS * SEGMENT
SIDES = {"left": -1.0, "right": 1.0}
PORTRAIT = Portrait(
    [-0.10, -0.42, 0.06], [0.0, 0.0, -0.045], ({}, {"left": 0.4, "right": 0.4}, {"right": 1.0}), fx=2200.0, size_px=(720, 640)
)


def body_mesh() -> TetMesh:
    """Return the tetrahedra of the gripper [m]."""
    outer = [HALF, HALF - BACK / 2, HALF - BACK, HALF - (BACK + THICK) / 2, HALF - THICK]
    across = sorted([*(-x for x in outer), 0.0, *outer])
    down = [0.0, PALM / 2, PALM]
    for segment in range(SEGMENTS):
        top = PALM + segment * SEGMENT
        down += [top + NOTCH, top + (NOTCH + SEGMENT) / 2, top + SEGMENT]
    return block_mesh([across, [-WIDTH / 2, 0.0, WIDTH / 2], [-z for z in reversed(down)]], keep=is_silicone, place=in_metres)


def in_metres(points: FloatArray) -> FloatArray:
    """Return points [mm] in metres."""
    return points * 1e-3


def is_silicone(centre: FloatArray) -> BoolArray:
    """Return whether cells with these centres [mm], shape (c, 3), belong to the palm,
    or to a finger and not to one of its notches."""
    depth, inset = -centre[:, 2], HALF - np.abs(centre[:, 0])
    along = (depth - PALM) % SEGMENT
    return np.asarray((depth < PALM) | (inset < BACK) | ((inset < THICK) & (along > NOTCH)))


def on_finger(side: float, depth: float, inset: float, across: float = 0.0) -> list[float]:
    """Return a place [m] at a depth [mm] below the clamp, an inset [mm] from the outer side, and across [−1, 1]."""
    return micrometres(1e-3 * np.array([side * (HALF - inset), across * WIDTH / 2, -depth]))


def ribs() -> list[float]:
    """Return the depths of the middles of the ribs [mm]."""
    return [PALM + segment * SEGMENT + (NOTCH + SEGMENT) / 2 for segment in range(SEGMENTS)]


def robot_document() -> dict[str, Any]:
    """Return the tables of robot.toml."""
    places = {"palm-front": micrometres([0.0, -1e-3 * WIDTH / 2, -1e-3 * PALM / 2])}
    for name, side in SIDES.items():
        for number, depth in enumerate(ribs(), start=1):
            if number % 2 == 0:
                places[f"{name}-front-{number}"] = on_finger(side, depth, THICK / 2, -1.0)
                places[f"{name}-outer-{number}"] = on_finger(side, depth, 0.0)
        places[f"{name}-tip"] = on_finger(side, LENGTH, THICK / 2)
    return {
        "format": "femsense-robot-1",
        "name": "gripper",
        "mesh": {"file": "gripper.vtu", "unit": "m", "element": "tet10"},
        "material": {"young_modulus_pa": 800e3, **SILICONE},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": [[-0.033, -0.010, -0.001], [0.033, 0.010, 0.001]]}],
        "cables": [cable_table(name, side) for name, side in SIDES.items()],
        "markers": [{"name": name, "position_m": place} for name, place in places.items()],
        "features": {"count": 51},
        "appearance": {"color_rgb": [0.56, 0.34, 0.74]},
    }


def cable_table(name: str, side: float) -> dict[str, object]:
    """Return the cable of a finger; above the palm it turns towards the middle."""
    depths = [*reversed(ribs()), PALM / 2]
    return {
        "name": name,
        "path_m": [on_finger(side, depth, CABLE) for depth in depths],
        "pull_point_m": on_finger(side, -10.0, CABLE),
        "exit_direction": [-side, 0.0, 0.0],
        "max_tension_n": 1.0,
    }


if __name__ == "__main__":
    build(HERE, body_mesh, robot_document, PORTRAIT)
