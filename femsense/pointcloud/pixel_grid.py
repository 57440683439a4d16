"""Recovery of the pixel grid of an unorganised cloud from its rays."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.pointcloud.cloud import PointCloud, without_mixed_pixels

FINEST = 1e-4
"""Minimum width of a pixel [1]; smaller differences of rays are rounding errors of a file."""
REGULAR = 0.1
"""Maximum root mean square distance of rays from the centres of pixels [px]."""
WIDEST = 5_000
"""Maximum number of pixels along a line."""


def without_mixed_points(cloud: PointCloud) -> PointCloud:
    """Remove mixed points from a cloud (see `without_mixed_pixels`), by means of the depth image that it came from.

    A cloud without a regular pixel grid is returned unchanged: one that was thinned by voxels, merged, or undistorted.
    """
    z = cloud.points[:, 2]
    if len(z) < 2 or z.min() <= 0.0:
        return cloud
    columns, rows = (_pixels(cloud.points[:, i] / z) for i in (0, 1))
    if columns is None or rows is None:
        return cloud
    image = np.zeros((rows[0].max() + 1, columns[0].max() + 1))
    image[rows[0], columns[0]] = z
    if np.count_nonzero(image) < len(z):  # two points in one pixel
        return cloud
    left = without_mixed_pixels(image, 1.0 / columns[1], 1.0 / rows[1])
    return cloud.select(left[rows[0], columns[0]] > 0.0)


def _pixels(rays: FloatArray) -> tuple[IntArray, float] | None:
    """Return the pixel index of each ray along one axis (n,), counted from the first, and the width of a pixel [1]; None if the rays are
    not regular."""
    ordered = np.sort(rays)
    group = np.append(0, np.cumsum(np.diff(ordered) > FINEST))
    count = np.bincount(group)
    middles = np.bincount(group, ordered) / count
    if len(middles) < 3:
        return None
    steps = np.diff(middles)
    at = np.append(0.0, np.cumsum(np.round(steps / np.median(steps))))
    if at[-1] > WIDEST:
        return None
    width, first = np.polyfit(at, middles, 1, w=np.sqrt(count))
    place = (rays - first) / width
    index = np.round(place).astype(np.int64)
    regular = np.sqrt(np.mean((place - index) ** 2)) < REGULAR
    return (index - index.min(), float(width)) if regular else None
