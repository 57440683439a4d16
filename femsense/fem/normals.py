# mypy: allow-untyped-decorators
"""Normals of triangulated surfaces: compiled."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit


@njit(cache=True, nogil=True)
def area_vectors(positions: FloatArray, triangles: IntArray, vectors: FloatArray) -> None:
    """Write normal × area of triangles (t, 3) of nodes (n, 3)."""
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            first = (positions[b, j] - positions[a, j]) * (positions[c, k] - positions[a, k])
            vectors[t, i] = (first - (positions[b, k] - positions[a, k]) * (positions[c, j] - positions[a, j])) / 2.0


@njit(cache=True, nogil=True)
def unit_sums(triangles: IntArray, vectors: FloatArray, normals: FloatArray) -> None:
    """Write the direction of the sum of vectors (t, 3) over the triangles of each node, shape (n, 3); 0 where there are none."""
    normals[:] = 0.0
    for t in range(len(triangles)):
        for corner in range(3):
            for i in range(3):
                normals[triangles[t, corner], i] += vectors[t, i]
    for n in range(len(normals)):
        length = np.sqrt(normals[n, 0] ** 2 + normals[n, 1] ** 2 + normals[n, 2] ** 2)
        if length > 0.0:
            for i in range(3):
                normals[n, i] /= length
