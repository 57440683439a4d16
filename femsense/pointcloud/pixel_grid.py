"""The pixels from which the points of an unorganised cloud come, where their rays tell them."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.pointcloud.cloud import PointCloud, without_mixed_pixels

FINEST = 1e-4
"""No pixel is narrower than this [1]; rays that are closer differ by the digits of a file."""
REGULAR = 0.1
"""Rays are those of pixels where they lie so few pixels off their centres, root mean square [1]."""
WIDEST = 5_000
"""More pixels than this no camera has along a line."""


def without_mixed_points(cloud: PointCloud) -> PointCloud:
    """Return a cloud without points that saw two surfaces at once (see `without_mixed_pixels`): its points are put back into a depth image.

    A cloud whose rays are not those of pixels stays as it is: one that was thinned to a grid of voxels, merged, or bent straight by a lens.
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
    """Return along one axis the pixel of each ray (n,), counted from the first, and the width of a pixel [1]; None where the rays are not regular."""
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
