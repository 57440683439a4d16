"""A smooth error over the surface of the body: the correlated error of neighbouring rows.

The error at a point s is Σ_i k_i(s) e_i with normalised Gaussian weights k_i (Σ k_i² = 1) about p centres, as functions of position and of
the direction that the surface faces: the error of a body that sags too far is large on its upper face and small on its sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from femsense.core.arrays import FloatArray, freeze
from femsense.model.robot import spread_points

CENTRES = 24
"""Degrees of freedom of the field along the body (docs/method/estimator.md)."""
OVERLAP = 0.7
"""Correlation length over the median distance of neighbouring centres."""
ACROSS_EDGES = 2.0
"""Faces that look in opposite directions are 2 × 2 × 2 correlation lengths apart: nearly independent."""


@dataclass(frozen=True, eq=False, slots=True)
class ErrorField:
    """A smooth error along the surface of the body: a sum of kernels at p centres."""

    places: FloatArray
    """On the surface at rest [m], shape (p, 3)."""
    facing: FloatArray
    """Outward unit normals there, shape (p, 3)."""
    length: float
    """Correlation length [m]."""

    def __len__(self) -> int:
        return len(self.places)

    def weights(self, places: FloatArray, facing: FloatArray) -> FloatArray:
        """Return k_i at points at rest (r, 3) [m] with surface normals (r, 3), shape (r, p)."""
        result = np.empty((len(places), len(self.places)))
        _weights(places, facing, self.places, self.facing, self.length, ACROSS_EDGES * self.length, result)
        return result


def facing_of(corners: FloatArray) -> FloatArray:
    """Return the unit normals of triangles (t, 3, 3), shape (t, 3)."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def spread_field(places: FloatArray, facing: FloatArray, size: float) -> ErrorField:
    """Return a field with centres distributed over a surface.

    Arguments:
        places: points of the surface at rest [m], shape (s, 3).
        facing: outward unit normals there, shape (s, 3).
        size: diagonal of the body [m].
    """
    first = places[spread_points(places, CENTRES)]
    distance = np.linalg.norm(first[:, None] - first[None], axis=2) + size * np.eye(len(first))
    length = OVERLAP * (float(np.median(distance.min(axis=1))) if len(first) > 1 else size)
    chosen = spread_points(np.hstack([places, ACROSS_EDGES * length * facing]), CENTRES)
    return ErrorField(freeze(places[chosen]), freeze(facing[chosen]), length)


@njit(cache=True, fastmath=True)
def _weights(places, facing, centres, looks, length, across, result):  # type: ignore[no-untyped-def]
    scale, p = -0.5 / length**2, len(centres)
    for j in range(len(places)):
        least = np.inf
        for i in range(p):
            squared = 0.0
            for c in range(3):
                squared += (places[j, c] - centres[i, c]) ** 2 + (across * (facing[j, c] - looks[i, c])) ** 2
            result[j, i] = squared
            least = min(least, squared)
        total = 0.0
        for i in range(p):
            result[j, i] = np.exp(scale * (result[j, i] - least))
            total += result[j, i] ** 2
        total = 1.0 / np.sqrt(total)
        for i in range(p):
            result[j, i] *= total
