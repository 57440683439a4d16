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
        noises: noise model of each camera.
        pixels: angle between neighbouring rays of each camera [rad].
        side: side of a block of pixels [1], result of `block_side`.
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
    """Return points in which the mean of each block of pixels replaces its points, shape (m, 3), the camera of each and the number of points it represents,
    both of shape (m,).

    Arguments:
        angles: side of a block of each camera [rad].
    """
    parts = []
    for v in np.unique(view):
        own = points[view == v]
        at = np.floor(own[:, :2] / own[:, 2:] / angles[v]).astype(np.int64)
        at -= at.min(axis=0)
        cell = np.unique(at[:, 1] * (at[:, 0].max() + 1) + at[:, 0], return_inverse=True)[1]
        allowed = 6.0 * ray_std(own, np.full(len(own), v), noises) + STEEPEST * angles[v] * own[:, 2]
        means, count = _blocks(own, cell, allowed)
        parts.append((means, np.full(len(means), v), count))
    if not parts:
        return points, view, np.zeros(0)
    means, views, count = (np.concatenate(columns) for columns in zip(*parts))
    return freeze(means), freeze(views, np.int64), freeze(count)


@njit(cache=True)
def _blocks(points, cell, allowed):  # type: ignore[no-untyped-def]
    """Return the means of blocks whose depths differ by no more than is allowed, all other points, and the number of points that each represents."""
    n, cells = len(points), cell.max() + 1
    total, number, first = np.zeros((cells, 3)), np.zeros(cells), np.empty(cells, dtype=np.int64)
    near, far = np.full(cells, np.inf), np.full(cells, -np.inf)
    for i in range(n):
        k = cell[i]
        if number[k] == 0.0:
            first[k] = i
        total[k] += points[i]
        number[k] += 1.0
        near[k], far[k] = min(near[k], points[i, 2]), max(far[k], points[i, 2])
    means, count, m = np.empty((n, 3)), np.empty(n), 0
    for k in range(cells):
        if far[k] - near[k] <= allowed[first[k]]:
            means[m], count[m] = total[k] / number[k], number[k]
            number[k], m = 0.0, m + 1
    for i in range(n):
        if number[cell[i]] > 0.0:
            means[m], count[m] = points[i], 1.0
            m += 1
    return means[:m].copy(), count[:m].copy()
