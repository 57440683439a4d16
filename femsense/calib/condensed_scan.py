"""Dense clouds as fewer points: neighbouring pixels of one surface are averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.scan import Scan, pixel_of
from femsense.core.arrays import freeze
from femsense.model.camera import CameraNoise

STEEPEST = 4.0
"""Surfaces are averaged whose depth changes by less than so many times the way along the image: 76° of incidence."""


def block_side(points: int, most: int) -> int:
    """Return the side of square blocks [pixels] whose means are about `most` at most, of so many points; 1: none are averaged."""
    return int(np.ceil(np.sqrt(points / most))) if points > most else 1


def in_blocks(scan: Scan, noises: Sequence[CameraNoise], side: int) -> Scan:
    """Return the scan with neighbouring pixels of the robot averaged where their depth is continuous.

    Pixels are grouped in square blocks of the image of each camera. The mean of points of a plane is a point of the plane.

    Arguments:
        noises: of the cameras.
        side: of a block [pixels], see `block_side`.
    """
    if side == 1 or not len(scan.view):
        return scan
    rays = scan.camera_points[:, :2] / scan.camera_points[:, 2:]
    pixel = np.array([pixel_of(scan, view) for view in range(len(noises))])[scan.view]
    angle = side * np.maximum(pixel, 1e-9)
    cell = np.floor(rays / angle[:, None]).astype(np.int64)
    cell -= cell.min(axis=0)
    key = (scan.view * (int(cell[:, 0].max()) + 1) + cell[:, 0]) * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=-1))
    number = np.diff(np.append(start, len(order)))
    z = scan.camera_points[order, 2]
    deep = np.maximum.reduceat(z, start) - np.minimum.reduceat(z, start)
    allowed = 6.0 * scan.ray_std(noises)[order][start] + STEEPEST * (angle * scan.camera_points[:, 2])[order][start]
    one = deep <= allowed
    members = np.repeat(one, number)
    middle = np.add.reduceat(scan.camera_points[order], start, axis=0)[one] / number[one, None]
    alone = order[~members]
    return replace(
        scan,
        camera_points=freeze(np.vstack([middle, scan.camera_points[alone]])),
        view=freeze(np.concatenate([scan.view[order[start[one]]], scan.view[alone]]), np.int64),
        count=freeze(np.concatenate([number[one].astype(np.float64), np.ones(len(alone))])),
    )
