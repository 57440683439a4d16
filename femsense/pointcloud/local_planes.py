"""A scene as the planes that neighbouring points of it lie on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from femsense.core.arrays import FloatArray, IntArray, freeze

AROUND = 24
"""Neighbours that tell the plane on which a point lies."""


@dataclass(frozen=True, eq=False, slots=True)
class LocalPlanes:
    """The plane of each point and its neighbours."""

    middles: FloatArray
    """A point of each plane [m], shape (b, 3)."""
    normals: FloatArray
    """Unit normals, shape (b, 3)."""
    rough: FloatArray
    """How far the neighbours lie off the plane, root mean square [m], shape (b,)."""
    tree: cKDTree = field(repr=False)
    """Of the points."""

    def nearest(self, points: FloatArray) -> IntArray:
        """Return which point is the nearest one of each (k, 3), shape (k,)."""
        return np.asarray(self.tree.query(points)[1])


def local_planes(points: FloatArray) -> LocalPlanes:
    """Return the planes of points [m], shape (b, 3), b ≥ AROUND."""
    tree = cKDTree(points)
    around = points[tree.query(points, k=AROUND)[1]]
    middles = around.mean(axis=1)
    _, spread, axes = np.linalg.svd(around - middles[:, None], full_matrices=False)
    return LocalPlanes(freeze(middles), freeze(axes[:, 2]), freeze(spread[:, 2] / np.sqrt(AROUND)), tree)
