# mypy: allow-untyped-decorators
"""Normals of a cloud, from the spread of each point's neighbours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_points
from femsense.core.kernels import njit
from femsense.pointcloud.grid import build_grid, positive, runs_around, squared_distance


def estimate_normals(
    points: npt.ArrayLike, radius_m: float, *, camera_position: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> tuple[FloatArray, FloatArray]:
    """Return unit normals (n, 3) that face the camera and the standard deviation (n,) [m] of the neighbours across them.

    The normal is the direction in which the neighbours within radius_m, the point included, spread least. A point with fewer
    than two neighbours faces the camera and has a standard deviation of NaN.

    Arguments:
        points: [m], shape (n, 3).
        radius_m: neighbourhood [m]; several times the depth noise and the spacing of the points.
        camera_position: the side that normals face [m], shape (3,).
    Raises:
        InputError: a radius that is not positive.
    """
    positions = as_points(points)
    radius = positive(radius_m, "radius_m")
    normals, spread = np.zeros((len(positions), 3)), np.full(len(positions), np.nan)
    if len(positions) == 0:
        return normals, spread
    grid = build_grid(positions, radius)
    moments, counts = _covariances(grid.points, grid.keys, grid.dims, radius**2)
    values, vectors = np.linalg.eigh(moments)
    to_camera = np.asarray(camera_position, dtype=np.float64) - grid.points
    found = vectors[:, :, 0]
    found[counts < 3] = to_camera[counts < 3] / np.maximum(np.linalg.norm(to_camera[counts < 3], axis=1, keepdims=True), 1e-300)
    found[np.einsum("ij,ij->i", found, to_camera) < 0.0] *= -1.0
    normals[grid.order] = found
    scatter = np.sqrt(np.maximum(values[:, 0], 0.0) * counts / np.maximum(counts - 3, 1))
    spread[grid.order] = np.where(counts < 3, np.nan, scatter)
    return normals, spread


@njit(cache=True)
def _covariances(points: FloatArray, keys: IntArray, dims: IntArray, radius2: float) -> tuple[FloatArray, IntArray]:
    """Return the covariance (n, 3, 3) of each point's neighbours and their number (n,)."""
    moments, counts = np.zeros((len(points), 3, 3)), np.zeros(len(points), dtype=np.int64)
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    last = -1
    for q in range(len(points)):
        if keys[q] != last:
            last = keys[q]
            runs_around(keys, last, dims[1] * dims[2], dims[2], starts, ends)
        counts[q] = _covariance(points, q, starts, ends, radius2, moments[q])
    return moments, counts


@njit(cache=True)
def _covariance(points: FloatArray, q: int, starts: IntArray, ends: IntArray, radius2: float, out: FloatArray) -> int:
    """Write the covariance of the points within the radius of point q, taken about it first to keep digits."""
    mean, count = np.zeros(3), 0
    for j in range(9):
        for i in range(starts[j], ends[j]):
            if squared_distance(points[q], points[i]) > radius2:
                continue
            count += 1
            for a in range(3):
                mean[a] += points[i, a] - points[q, a]
                for b in range(3):
                    out[a, b] += (points[i, a] - points[q, a]) * (points[i, b] - points[q, b])
    for a in range(3):
        for b in range(3):
            out[a, b] = out[a, b] / count - mean[a] * mean[b] / count**2
    return count
