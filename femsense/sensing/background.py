"""What stands around the robot, far from it, as the first free frame shows it: it tells a camera that moved from a body that is pushed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.calib.scan import Scan, read_scan
from femsense.core.arrays import FloatArray
from femsense.pointcloud.local_planes import LocalPlanes, local_planes
from femsense.pointcloud.rays import GRAZING
from femsense.sensing.types import Sensor

MANY = 8000
"""Points of the background that are kept of the first free frame, of each camera at most."""
FEWEST = 100
"""Fewer points are no background."""


def background_of(sensor: Sensor, k: int) -> LocalPlanes | None:
    """Return the background as frame k shows it, where no camera has moved yet; None where too little is seen of it."""
    poses = sensor.calibration.poses
    scan = read_scan(sensor.robot, sensor.recording, k, poses, sensor.robot.body.mesh.nodes, some=MANY)
    points = np.zeros((0, 3)) if scan is None else scan.background(poses)
    return local_planes(points) if len(points) >= FEWEST else None


def off_background(
    sensor: Sensor, background: LocalPlanes, scan: Scan, poses: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return how far points of a scan lie off the background, in standard deviations, shape (g,), and how that moves with pose steps, shape (g, 6 v).

    Where the background's plane is seen at a grazing angle, a point says nothing, as on the body: both are 0. There depth hardly moves a point off
    the plane, so that it seemed infinitely sure, and the equations of a frame had no solution.

    Arguments:
        poses: of the cameras, as the points are to be placed.
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
