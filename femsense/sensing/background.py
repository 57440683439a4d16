"""The static background of the first contact-free frame. It distinguishes a moved camera from a pushed body."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.calib.scan import Scan, read_scan
from femsense.core.arrays import FloatArray
from femsense.pointcloud.local_planes import LocalPlanes, local_planes
from femsense.pointcloud.rays import GRAZING
from femsense.sensing.types import Sensor

MANY = 8000
"""Maximum number of background points per camera."""
FEWEST = 100
"""Minimum number of background points."""


def background_of(sensor: Sensor, k: int) -> LocalPlanes | None:
    """Return the background in frame k, before any camera has moved; None if too few of its points are visible."""
    poses = sensor.calibration.poses
    scan = read_scan(sensor.robot, sensor.recording, k, poses, sensor.robot.body.mesh.nodes, some=MANY)
    points = np.zeros((0, 3)) if scan is None else scan.background(poses)
    return local_planes(points) if len(points) >= FEWEST else None


def off_background(
    sensor: Sensor, background: LocalPlanes, scan: Scan, poses: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the distances of scan points from the background in standard deviations, shape (g,), and their derivatives by the poses, shape
    (g, 6 v).

    Both are 0 at grazing incidence: there the depth hardly changes the distance from the plane, so that σ of the distance would tend to 0
    and the normal equations would be singular.

    Arguments:
        poses: of the cameras, with which the points are mapped to the robot frame.
    """
    points = scan.background(poses)
    nearest = background.nearest(points)
    normal = background.normals[nearest]
    ray = points - np.array([T[:3, 3] for T in poses])[scan.far_view]
    depth = np.linalg.norm(ray, axis=1)
    slant = np.abs(np.einsum("gc,gc->g", ray, normal)) / depth
    std = np.hypot(sensor.knowledge.depth_std(depth, scan.far_view) * slant, background.rough[nearest])
    std[slant < GRAZING] = np.inf
    by_pose = np.zeros((len(points), len(poses), 6))
    by_pose[np.arange(len(points)), scan.far_view] = np.hstack([np.cross(points - sensor.pivot, normal), normal])
    off = np.einsum("gc,gc->g", points - background.middles[nearest], normal)
    return off / std, by_pose.reshape(len(points), -1) / std[:, None]
