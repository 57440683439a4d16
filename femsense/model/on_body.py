"""Checks that declared places lie on the body."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, diagonal
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh
from femsense.model.contact_patch import body_surface, closest_surface_point

FAR = 0.1
"""A place farther from the surface than this share of the body's diagonal is none of the body."""
OTHER_UNIT = 20.0
"""A place that is this many times farther from the origin than the body is assumed to be in another unit."""


def check_on_body(mesh: TetMesh, places: FloatArray, *, where: str) -> None:
    """Refuse places that lie far from the surface of the body at rest.

    Arguments:
        mesh: of the body.
        places: [m], robot frame, shape (k, 3).
        where: their source, for the message.

    Raises:
        InputError: a place is farther from the surface than a tenth of the body's diagonal.
    """
    nodes, surface = mesh.nodes, body_surface(mesh)
    size = diagonal(nodes)
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    for place in places:
        distance = float(np.linalg.norm(closest_surface_point(surface, nodes, place) - place))
        if distance <= FAR * size:
            continue
        larger = float(np.abs(place).max()) > OTHER_UNIT * float(np.abs(nodes).max())
        raise InputError(
            "far from the surface of the body",
            where=where,
            found=f"{', '.join(f'{x:g}' for x in place)} m, {1e3 * distance:.1f} mm from the body",
            expected=f"a place on the body at rest, at most {1e3 * FAR * size:.3g} mm from it; it reaches from "
            f"{_triple(low)} to {_triple(high)} m",
            hint="this looks like millimetres: divide by 1000" if larger else _nearest(nodes, place),
        )


def _nearest(nodes: FloatArray, place: FloatArray) -> str:
    nearest = nodes[int(np.linalg.norm(nodes - place, axis=1).argmin())]
    return f"places are in the robot frame, not in the camera's; the body's nearest node is at {_triple(nearest)}"


def _triple(point: FloatArray) -> str:
    return ", ".join(f"{x:.4g}" for x in point)
