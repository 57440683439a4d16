"""The filters of the sensing chain: a box, a voxel grid, and the removal of lone points.

Source: "Calibration and force sensing with an RGB-D camera",
section V.A.1 (the filters' names are those of the Point Cloud Library).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.grid import build_grid, cell_keys, count_neighbors, positive


def pass_through(cloud: PointCloud, box_m: npt.ArrayLike) -> PointCloud:
    """Return the points inside an axis-aligned box, its faces included.

    Arguments:
        box_m: lower and upper corner [m], shape (2, 3); ±inf leaves a side open.
    Raises:
        InputError: not two corners, or a lower corner above the upper one.
    """
    box = np.asarray(box_m, dtype=np.float64)
    if box.shape != (2, 3) or not (box[0] <= box[1]).all():
        raise InputError("not a box", where="box_m", found=box.tolist(), expected="[[x, y, z], [x, y, z]], lower corner first")
    x, y, z = cloud.points.T
    inside = (x >= box[0, 0]) & (x <= box[1, 0]) & (y >= box[0, 1]) & (y <= box[1, 1]) & (z >= box[0, 2]) & (z <= box[1, 2])
    return cloud.select(inside)


def voxel_grid(cloud: PointCloud, size_m: float) -> PointCloud:
    """Return one point per occupied voxel: the mean of its points, with the mean of their colours.

    Voxels sit at whole multiples of size_m from the origin, so that the same scene gives the same voxels in every frame.

    Arguments:
        size_m: edge of a voxel [m].
    Returns:
        The cloud, ordered by voxel (x slowest, z fastest).
    Raises:
        InputError: a size that is not positive, or too small for the extent.
    """
    size = positive(size_m, "size_m")
    if len(cloud) == 0:
        return cloud
    keys, _ = cell_keys(cloud.points, size, np.zeros(3))
    order = np.argsort(keys, kind="stable")
    ascending = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], ascending[1:] != ascending[:-1]]))
    points = _means(cloud.points, order, starts)
    return PointCloud(points, None if cloud.colors is None else np.clip(_means(cloud.colors, order, starts), 0.0, 1.0))


def remove_radius_outliers(cloud: PointCloud, radius_m: float, min_neighbors: int) -> PointCloud:
    """Return the points that have at least min_neighbors other points within radius_m [m]. Raises InputError."""
    radius = positive(radius_m, "radius_m")
    counts = count_neighbors(build_grid(cloud.points, radius), radius, enough=max(int(min_neighbors), 0))
    return cloud.select(counts >= min_neighbors)


def _means(values: FloatArray, order: IntArray, starts: IntArray) -> FloatArray:
    counts = np.diff(np.append(starts, len(values)))
    return np.asarray(np.add.reduceat(values[order], starts, axis=0) / counts[:, None])
