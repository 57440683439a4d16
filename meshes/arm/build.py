"""Build the arm: a hanging, tapered column of silicone with four cables along it.

    python meshes/arm/build.py              # arm.vtu and robot.toml
    python meshes/arm/build.py --picture    # arm.png too

Each cable is tied near the tip and runs through five rings of the body to its motor above the clamp.
The body is built of blocks, so that the script makes the same mesh each time.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from femsense import TetMesh, block_mesh
from femsense.core.arrays import FloatArray

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from workshop import SILICONE, Portrait, build, micrometres  # noqa: E402

LENGTH = 180.0
"""From the clamp down to the tip [mm]."""
RADIUS, TIP_RADIUS = 18.0, 11.0
ROUNDNESS = 0.7
RINGS = 12
"""Layers of cells along the arm."""
CABLE_SHARE = 0.7
"""Distance of the cables from the axis, over the radius there."""
CABLE_RINGS = (0.95, 0.75, 0.55, 0.35, 0.15)
"""Where a cable meets the body, over the length; far end first."""
SIDES = {"north": (0.0, 1.0), "west": (-1.0, 0.0), "south": (0.0, -1.0), "east": (1.0, 0.0)}
MARKER_RINGS = {"upper": 0.25, "middle": 0.5, "lower": 0.75, "end": 0.97}
PORTRAIT = Portrait(
    [-0.20, -0.62, 0.10], [0.0, 0.0, -0.075], ({}, {"east": 3.0}, {"north": 3.0, "west": 3.0}), fx=2100.0, size_px=(620, 680)
)


def body_mesh() -> TetMesh:
    """Return the tetrahedra of the arm [m]."""
    across = np.linspace(-1.0, 1.0, 5)
    return block_mesh([across, across, np.linspace(-1.0, 0.0, RINGS + 1)], place=hung)


def hung(points: FloatArray) -> FloatArray:
    """Return points of the column [−1, 1]² × [−1, 0], shape (n, 3), where they are in the arm [m]."""
    depth = -points[:, 2:]
    flat = rounded_square(points[:, :2], roundness=ROUNDNESS)
    return np.hstack([radius(depth) * flat, -LENGTH * depth]) * 1e-3


def rounded_square(points: FloatArray, *, roundness: float) -> FloatArray:
    """Return points (n, 2) of the square [−1, 1]² moved towards the disc of the same half width.

    `roundness` 0 leaves the square, 1 gives the disc (x √(1 − y²/2), y √(1 − x²/2)), whose four corner cells are flat.
    """
    x, y = points[:, 0], points[:, 1]
    disc = np.stack([x * np.sqrt(1.0 - y**2 / 2.0), y * np.sqrt(1.0 - x**2 / 2.0)], axis=1)
    return (1.0 - roundness) * points + roundness * disc


def radius(depth: FloatArray | float) -> Any:
    """Return the radius [mm] at a depth over the length."""
    return RADIUS + (TIP_RADIUS - RADIUS) * depth


def on_arm(side: tuple[float, float], depth: float, share: float = 1.0) -> list[float]:
    """Return the place on a side of the arm [m] at a depth over the length, at a share of the radius there."""
    across = share * radius(depth) * np.array(side)
    return micrometres([*(1e-3 * across), -1e-3 * LENGTH * depth])


def robot_document() -> dict[str, Any]:
    """Return the tables of robot.toml."""
    places = {"tip": [0.0, 0.0, -LENGTH * 1e-3]}
    for ring, depth in MARKER_RINGS.items():
        places |= {f"{ring}-{name}": on_arm(side, depth) for name, side in SIDES.items()}
    return {
        "format": "femsense-robot-1",
        "name": "arm",
        "mesh": {"file": "arm.vtu", "unit": "m", "element": "tet10"},
        "material": {"young_modulus_pa": 250e3, **SILICONE},
        "gravity": {"vector_m_s2": [0.0, 0.0, -9.81]},
        "fixed": [{"box_m": [[-0.02, -0.02, -0.001], [0.02, 0.02, 0.001]]}],
        "cables": [cable_table(name, side) for name, side in SIDES.items()],
        "markers": [{"name": name, "position_m": place} for name, place in places.items()],
        "features": {"count": 51},
        "appearance": {"color_rgb": [0.16, 0.62, 0.42]},
    }


def cable_table(name: str, side: tuple[float, float]) -> dict[str, object]:
    """Return the cable on a side of the arm; at its pull point it turns outwards."""
    top = CABLE_SHARE * RADIUS * 1e-3 * np.array(side)
    return {
        "name": name,
        "path_m": [on_arm(side, depth, CABLE_SHARE) for depth in CABLE_RINGS],
        "pull_point_m": micrometres([*top, 0.010]),
        "exit_direction": [*side, 0.0],
        "max_tension_n": 5.0,
    }


if __name__ == "__main__":
    build(HERE, body_mesh, robot_document, PORTRAIT)
