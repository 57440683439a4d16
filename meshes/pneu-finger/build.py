"""Build the pneumatic finger: a hanging bar with a row of pockets that one channel joins, blown up from inside.

    python meshes/pneu-finger/build.py              # pneu_finger.vtu and robot.toml
    python meshes/pneu-finger/build.py --picture    # pneu_finger.png too

The pockets bulge and push each other apart on their side, so that the finger bends to the other side,
as the networks of pockets of Ilievski and others (2011) do. The body is built of blocks,
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

BASE, WALL, POCKET, GAP, POCKETS = 10.0, 2.5, 5.0, 3.0, 5
"""Along the finger [mm]: the clamped end, a pocket's walls, a pocket, the gap to the next one; how many."""
BACK, CHANNEL, ROOF, TOP = 4.0, 7.0, 10.0, 20.0
"""Away from the back [mm]: where the channel begins and ends, the floor of the gaps, the pockets' outside."""
SIDE, WIDTH = 3.0, 18.0
"""Side walls, and the whole across [mm]."""
PITCH = 2 * WALL + POCKET + GAP
LENGTH = BASE + POCKETS * PITCH - GAP + WALL
PORTRAIT = Portrait(
    [0.12, -0.36, -0.005], [-0.004, 0.0, -0.040], ({}, {"air": 8e3}, {"air": 16e3}), fx=2300.0, size_px=(560, 640)
)


def body_mesh() -> TetMesh:
    """Return the tetrahedra of the finger [m]."""
    along = [0.0, BASE]
    for pocket in range(POCKETS):
        start = BASE + pocket * PITCH
        steps = [WALL, WALL + POCKET, 2 * WALL + POCKET] + ([PITCH] if pocket < POCKETS - 1 else [])
        along += [start + step for step in steps]
    along.append(LENGTH)
    across = [-WIDTH / 2, -WIDTH / 2 + SIDE, 0.0, WIDTH / 2 - SIDE, WIDTH / 2]
    away = [0.0, BACK, CHANNEL, ROOF, TOP - WALL, TOP]
    return block_mesh([away, across, [-z for z in reversed(along)]], keep=is_silicone, place=in_metres)


def in_metres(points: FloatArray) -> FloatArray:
    """Return points [mm] in metres."""
    return points * 1e-3


def is_silicone(centre: FloatArray) -> BoolArray:
    """Return whether cells with these centres [mm], shape (c, 3), are neither in a pocket, nor in the channel, nor in a gap."""
    away, across, along = centre[:, 0], np.abs(centre[:, 1]), -centre[:, 2] - BASE
    place = along % PITCH
    last = along > POCKETS * PITCH - GAP
    gap = (along > 0) & ~last & (place > 2 * WALL + POCKET) & (away > ROOF)
    inside = across < WIDTH / 2 - SIDE
    pocket = (along > 0) & ~last & (place > WALL) & (place < WALL + POCKET) & (away > BACK) & (away < TOP - WALL) & inside
    joined = (along > WALL) & (along < POCKETS * PITCH - GAP - WALL)
    channel = joined & (away > BACK) & (away < CHANNEL) & inside
    return np.asarray(~(gap | pocket | channel))


def at(away: float, across: float, along: float) -> list[float]:
    """Return a place [m] away from the back [mm], across [−1, 1] and along the finger [mm]."""
    return micrometres(1e-3 * np.array([away, across * WIDTH / 2, -along]))


def middles() -> list[float]:
    """Return the middles of the pockets along the finger [mm]."""
    return [BASE + pocket * PITCH + WALL + POCKET / 2 for pocket in range(POCKETS)]


def robot_document() -> dict[str, Any]:
    """Return the tables of robot.toml."""
    places = {"tip": at(TOP / 2, 0.0, LENGTH)}
    for number, along in enumerate(middles(), start=1):
        places[f"pocket-{number}"] = at(TOP, 0.0, along)
        places[f"front-{number}"] = at(BACK / 2, -1.0, along)
        if number % 2:
            places[f"back-{number}"] = at(0.0, 0.0, along)
    return {
        "format": "femsense-robot-1",
        "name": "pneu-finger",
        "mesh": {"file": "pneu_finger.vtu", "unit": "m", "element": "tet10"},
        "material": {"young_modulus_pa": 250e3, **SILICONE},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": [[-0.001, -0.010, -0.001], [0.021, 0.010, 0.001]]}],
        "chambers": [{"name": "air", "seed_m": at((BACK + CHANNEL) / 2, 0.0, middles()[2]), "max_pressure_pa": 16e3}],
        "markers": [{"name": name, "position_m": place} for name, place in places.items()],
        "features": {"count": 51},
        "appearance": {"color_rgb": [0.80, 0.30, 0.36]},
    }


if __name__ == "__main__":
    build(HERE, body_mesh, robot_document, PORTRAIT)
