"""Build the finger: a silicone bar with notches, and one cable that runs through the ribs between them.

    python meshes/finger/build.py              # finger.vtu and robot.toml
    python meshes/finger/build.py --picture    # finger.png too

The finger lies along x with its ribs up; the cable lifts the tip against the weight and bends at each rib. The body is built of
blocks, so that the script makes the same mesh each time.
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

BASE, RIB, NOTCH, RIBS = 14.0, 8.0, 5.0, 6
"""Lengths along the finger [mm], and how many notches and ribs follow the base."""
WIDTH, HEIGHT = 20.0, 20.0
BACK = 10.0
"""Thickness of what is left under the notches [mm]."""
TAPER = 0.7
"""Width at the tip over the width at the base."""
CABLE_HEIGHT = 15.5
"""Where the cable runs [mm]; it is tied to the last rib."""
LENGTH = BASE + RIBS * (NOTCH + RIB)
PORTRAIT = Portrait(
    [0.02, -0.30, 0.20], [0.048, 0.0, 0.022], ({}, {"flexor": 0.8}, {"flexor": 1.6}), fx=2100.0, size_px=(760, 440)
)


def body_mesh() -> TetMesh:
    """Return the tetrahedra of the finger [m]."""
    cuts = [0.0, BASE / 2, BASE]
    for rib in range(RIBS):
        start = BASE + rib * (NOTCH + RIB)
        cuts += [start + NOTCH / 2, start + NOTCH, start + NOTCH + RIB / 2, start + NOTCH + RIB]
    height = [0.0, BACK / 2, BACK, (BACK + HEIGHT) / 2, HEIGHT]
    return block_mesh([cuts, [-WIDTH / 2, 0.0, WIDTH / 2], height], keep=is_silicone, place=tapered)


def is_silicone(centre: FloatArray) -> BoolArray:
    """Return whether cells with these centres [mm], shape (c, 3), are not in a notch."""
    along = (centre[:, 0] - BASE) % (NOTCH + RIB)
    return np.asarray((centre[:, 0] < BASE) | (along > NOTCH) | (centre[:, 2] < BACK))


def tapered(points: FloatArray) -> FloatArray:
    """Return points of the straight bar [mm], shape (n, 3), where they are in the finger [m]."""
    share = 1.0 + (TAPER - 1.0) * points[:, :1] / LENGTH
    return points * np.hstack([np.ones_like(share), share, share]) * 1e-3


def on_finger(x: float, across: float, up: float) -> list[float]:
    """Return a place given along [mm], across [−1, 1] and up [mm at the base]."""
    return micrometres(tapered(np.array([[x, across * WIDTH / 2, up]]))[0])


def ribs() -> list[float]:
    """Return the middles of the ribs along the finger [mm]."""
    return [BASE + rib * (NOTCH + RIB) + NOTCH + RIB / 2 for rib in range(RIBS)]


def robot_document() -> dict[str, Any]:
    """Return the tables of robot.toml."""
    path = [on_finger(x, 0.0, CABLE_HEIGHT) for x in reversed(ribs())] + [on_finger(BASE * 0.75, 0.0, CABLE_HEIGHT)]
    places = {"tip": on_finger(LENGTH, 0.0, HEIGHT / 2)}
    for number, x in enumerate(ribs(), start=1):
        places[f"rib-{number}"] = on_finger(x, 0.0, HEIGHT)
        if number % 2:
            places[f"left-{number}"] = on_finger(x, 1.0, HEIGHT / 2)
            places[f"right-{number}"] = on_finger(x, -1.0, HEIGHT / 2)
    return {
        "format": "femsense-robot-1",
        "name": "finger",
        "mesh": {"file": "finger.vtu", "unit": "m", "element": "tet10"},
        "material": {"young_modulus_pa": 1.2e6, **SILICONE},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": [[-0.001, -0.011, -0.001], [0.001, 0.011, 0.021]]}],
        "cables": [
            {
                "name": "flexor",
                "path_m": path,
                "pull_point_m": [-0.010, 0.0, CABLE_HEIGHT * 1e-3],
                "exit_direction": [0.0, 0.0, -1.0],
                "max_tension_n": 1.6,
            }
        ],
        "markers": [{"name": name, "position_m": place} for name, place in places.items()],
        "features": {"count": 51},
        "appearance": {"color_rgb": [0.86, 0.52, 0.16]},
    }


if __name__ == "__main__":
    build(HERE, body_mesh, robot_document, PORTRAIT)
