"""Distances from triangles, by brute force."""

from __future__ import annotations

import numpy as np

from femsense.fem.mesh import closest_in_triangle


def distances(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance of each point from the nearest of the triangles (t, 3, 3)."""
    found = np.empty(len(points))
    for i, point in enumerate(points):
        spread = np.broadcast_to(point, (len(triangles), 3))
        nearest = np.einsum("ti,tic->tc", closest_in_triangle(triangles, spread), triangles)
        found[i] = np.linalg.norm(nearest - point, axis=1).min()
    return found
