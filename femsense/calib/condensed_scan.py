# mypy: allow-untyped-decorators
"""Dense clouds as fewer points: neighbouring pixels of one surface are averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.scan import Scan, ray_std
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.kernels import njit
from femsense.model.camera import CameraNoise

STEEPEST = 4.0
"""Surfaces are averaged whose depth changes by less than so many times the way along the image: 76° of incidence."""


def block_side(points: int, most: int) -> int:
    """Return the side of square blocks [pixels] whose means are about `most` at most, of so many points; 1: none are averaged."""
    return int(np.ceil(np.sqrt(points / most))) if points > most else 1


def in_blocks(scan: Scan, noises: Sequence[CameraNoise], pixels: Sequence[float], side: int) -> Scan:
    """Return the scan with neighbouring pixels averaged where their depth is continuous: those of the robot, and those of everything else.

    Pixels are grouped in square blocks of the image of each camera. The mean of points of a plane is a point of the plane.

    Arguments:
        noises: of the cameras.
        pixels: angle between neighbouring rays of each camera [rad].
        side: of a block [pixels], see `block_side`.
    """
    if side == 1:
        return scan
    angles = side * np.maximum(pixels, 1e-9)
    own, view, count = _averaged(scan.camera_points, scan.view, noises, angles)
    others, others_view, _ = _averaged(scan.others, scan.others_view, noises, angles)
    return replace(scan, camera_points=own, view=view, count=count, others=others, others_view=others_view)


def _averaged(
    points: FloatArray, view: IntArray, noises: Sequence[CameraNoise], angles: FloatArray
) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return points, each of its camera, with the means of blocks of so many radians in their place, and how many points each stands for."""
    parts = []
    for v in np.unique(view):
        own = points[view == v]
        means, count = _blocks(own, 6.0 * ray_std(own, np.full(len(own), v), noises), float(angles[v]))
        parts.append((means, np.full(len(means), v), count))
    if not parts:
        return points, view, np.zeros(0)
    means, views, count = (np.concatenate(columns) for columns in zip(*parts))
    return freeze(means), freeze(views, np.int64), freeze(count)


@njit(cache=True)
def _blocks(points, noise, angle):  # type: ignore[no-untyped-def]
    """Return the means of square blocks whose depths differ by no more than noise and slope let expect, all other points, and how many each stands for."""
    n = len(points)
    at, low, high = np.empty((n, 2), dtype=np.int64), np.full(2, 2**62), np.full(2, -(2**62))
    for i in range(n):
        for c in range(2):
            at[i, c] = int(np.floor(points[i, c] / points[i, 2] / angle))
            low[c], high[c] = min(low[c], at[i, c]), max(high[c], at[i, c])
    columns, cells = high[0] - low[0] + 1, (high[0] - low[0] + 1) * (high[1] - low[1] + 1)
    total, number, first = np.zeros((cells, 3)), np.zeros(cells), np.empty(cells, dtype=np.int64)
    near, far = np.full(cells, np.inf), np.full(cells, -np.inf)
    cell = np.empty(n, dtype=np.int64)
    for i in range(n):
        cell[i] = k = (at[i, 1] - low[1]) * columns + at[i, 0] - low[0]
        if number[k] == 0.0:
            first[k] = i
        total[k] += points[i]
        number[k] += 1.0
        near[k], far[k] = min(near[k], points[i, 2]), max(far[k], points[i, 2])
    means, count, m = np.empty((n, 3)), np.empty(n), 0
    for k in range(cells):
        if number[k] > 0.0 and far[k] - near[k] <= noise[first[k]] + STEEPEST * angle * points[first[k], 2]:
            means[m], count[m] = total[k] / number[k], number[k]
            number[k], m = 0.0, m + 1
    for i in range(n):
        if number[cell[i]] > 0.0:
            means[m], count[m] = points[i], 1.0
            m += 1
    return means[:m].copy(), count[:m].copy()
