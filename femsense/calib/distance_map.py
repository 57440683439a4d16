"""Distances to measured points on a grid, and many poses that follow closest points on it at once."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from femsense.core.arrays import FloatArray

MOST_CELLS = 4e6
"""Cells of the map: 16 MB of distances and 48 MB of places; a wider scene gets larger ones."""
KEPT = 0.7
"""This share of a pose's points, the nearest ones, moves it."""


class DistanceMap:
    """Distances to the nearest measured point, cut off, and where that lies."""

    def __init__(self, points: FloatArray, cell: float, cap: float) -> None:
        self.low = points.min(axis=0) - cap
        volume = float(np.prod(points.max(axis=0) + cap - self.low))
        self.cell, self.cap = (cell := max(cell, (volume / MOST_CELLS) ** (1 / 3))), cap
        shape = np.ceil((points.max(axis=0) + cap - self.low) / cell).astype(int) + 1
        empty = np.ones(shape, dtype=bool)
        empty[tuple(((points - self.low) / cell).astype(int).T)] = False
        distance, self.nearest = distance_transform_edt(empty, return_indices=True)
        self.map = np.minimum(distance * cell, cap).astype(np.float32)

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return distances [m], shape (…,), of points (…, 3)."""
        at, inside = self._cells(points)
        return np.asarray(np.where(inside, self.map[at[..., 0], at[..., 1], at[..., 2]], self.cap))

    def closest(self, points: FloatArray) -> FloatArray:
        """Return the measured place nearest to each point (…, 3), to within a cell [m], shape (…, 3)."""
        at, _ = self._cells(points)
        cells = np.moveaxis(self.nearest[:, at[..., 0], at[..., 1], at[..., 2]], 0, -1)
        return np.asarray(self.low + (cells + 0.5) * self.cell)

    def _cells(self, points: FloatArray) -> tuple[np.ndarray, np.ndarray]:
        at = np.floor((points - self.low) / self.cell).astype(np.int64)
        inside = ((at >= 0) & (at < self.map.shape)).all(axis=-1)
        return np.clip(at, 0, np.array(self.map.shape) - 1), inside


def follow(near: DistanceMap, places: FloatArray, poses: FloatArray, *, steps: int) -> tuple[FloatArray, FloatArray]:
    """Return poses to which closest points lead, shape (b, 4, 4), and the mean of their distances, cut off [m], shape (b,).

    Arguments:
        near: of the measured points.
        places: of each pose, on the body [m], shape (b, k, 3).
        poses: T_camera_body from which each starts, shape (b, 4, 4).
        steps: of closest points and rigid fit in turns (Besl and McKay 1992).
    """
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    for _ in range(steps):
        placed = np.einsum("bij,bkj->bki", R, places) + t[:, None]
        distance = near(placed)
        weight = (distance <= np.quantile(distance, KEPT, axis=1, keepdims=True)).astype(float)
        R, t = _rigid_fits(near.closest(placed), places, weight)
    moved = np.tile(np.eye(4), (len(R), 1, 1))
    moved[:, :3, :3], moved[:, :3, 3] = R, t
    return moved, near(np.einsum("bij,bkj->bki", R, places) + t[:, None]).mean(axis=1)


def _rigid_fits(a: FloatArray, b: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations (b, 3, 3) and shifts (b, 3) that take b (b, k, 3) best onto a (Kabsch 1976)."""
    total = weight.sum(axis=1)[:, None]
    mean_a, mean_b = (np.einsum("bk,bki->bi", weight, x) / total for x in (a, b))
    U, _, Vt = np.linalg.svd(np.einsum("bk,bki,bkj->bij", weight, a - mean_a[:, None], b - mean_b[:, None]))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    R = U @ Vt
    return R, mean_a - np.einsum("bij,bj->bi", R, mean_b)
