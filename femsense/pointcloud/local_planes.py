"""A scene as local planes through neighbouring points."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from femsense.core.arrays import FloatArray, IntArray, freeze

AROUND = 24
"""Number of neighbours to which the plane of a point is fitted."""


@dataclass(frozen=True, eq=False, slots=True)
class LocalPlanes:
    """The plane of each point and its neighbours."""

    middles: FloatArray
    """A point of each plane [m], shape (b, 3)."""
    normals: FloatArray
    """Unit normals, shape (b, 3)."""
    rough: FloatArray
    """Root mean square distance of the neighbours from the plane [m], shape (b,)."""
    tree: cKDTree = field(repr=False)
    """Search tree of the points."""

    def nearest(self, points: FloatArray) -> IntArray:
        """Return the index of the nearest point of each query (k, 3), shape (k,)."""
        return np.asarray(self.tree.query(points)[1])


def local_planes(points: FloatArray) -> LocalPlanes:
    """Return the planes of points [m], shape (b, 3), b ≥ AROUND."""
    tree = cKDTree(points)
    around = points[tree.query(points, k=AROUND)[1]]
    middles = around.mean(axis=1)
    _, spread, axes = np.linalg.svd(around - middles[:, None], full_matrices=False)
    return LocalPlanes(freeze(middles), freeze(axes[:, 2]), freeze(spread[:, 2] / np.sqrt(AROUND)), tree)
