"""What stands around the robot, far from it, as the first free frame shows it: it tells a camera that moved from a body that is pushed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.calib.scan import MARGIN
from femsense.core.arrays import FloatArray, IntArray
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.camera_frame import undo_depth
from femsense.pointcloud.local_planes import LocalPlanes, local_planes
from femsense.pointcloud.rays import GRAZING
from femsense.sensing.types import Sensor

MANY, SOME = 8000, 600
"""Points of the background that are kept of the first free frame, and that are asked in another one, of each camera at most."""
FEWEST = 100
"""Fewer points are no background."""


@dataclass(frozen=True, eq=False, slots=True)
class Glance:
    """Points of the background in one frame."""

    points: FloatArray
    """In the frame of their camera [m], shape (g, 3)."""
    view: IntArray
    """Camera of each, shape (g,)."""

    def placed(self, poses: Sequence[FloatArray]) -> FloatArray:
        """Return the points in the robot's frame [m], shape (g, 3)."""
        result = np.empty_like(self.points)
        for view, T in enumerate(poses):
            mine = self.view == view
            result[mine] = self.points[mine] @ T[:3, :3].T + T[:3, 3]
        return result


NOTHING = Glance(np.zeros((0, 3)), np.zeros(0, dtype=np.int64))


def look(sensor: Sensor, k: int, *, most: int = SOME) -> Glance:
    """Return what the cameras see of the background in frame k: points farther from the body at rest than any of its own come."""
    nodes = sensor.robot.body.mesh.nodes
    low, high = nodes.min(axis=0) - MARGIN * sensor.size, nodes.max(axis=0) + MARGIN * sensor.size
    points, views = [NOTHING.points], [NOTHING.view]
    for view, T in enumerate(sensor.calibration.poses):
        cloud = read_frame_cloud(sensor.recording, k, view=view)
        if cloud is None:
            continue
        seen = undo_depth(cloud.points[cloud.points[:, 2] > 0], sensor.robot.observation)
        placed = seen @ T[:3, :3].T + T[:3, 3]
        far = seen[((placed < low) | (placed > high)).any(axis=1)]
        points.append(far[:: max(1, len(far) // most)])
        views.append(np.full(len(points[-1]), view))
    return Glance(np.vstack(points), np.concatenate(views))


def background_of(sensor: Sensor, k: int) -> LocalPlanes | None:
    """Return the background as frame k shows it, where no camera has moved yet; None where too little is seen of it."""
    points = look(sensor, k, most=MANY).placed(sensor.calibration.poses)
    return local_planes(points) if len(points) >= FEWEST else None


def off_background(
    sensor: Sensor, background: LocalPlanes, glance: Glance, poses: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return how far points lie off the background, in standard deviations, shape (g,), and how that moves with pose steps, shape (g, 6 v).

    Where the background's plane is seen at a grazing angle, a point says nothing, as on the body: both are 0. There depth hardly moves a point off
    the plane, so that it seemed infinitely sure, and the equations of a frame had no solution.

    Arguments:
        poses: of the cameras, as the points are to be placed.
    """
    points = glance.placed(poses)
    nearest = background.nearest(points)
    normal = background.normals[nearest]
    ray = points - np.array([T[:3, 3] for T in poses])[glance.view]
    depth = np.linalg.norm(ray, axis=1)
    slant = np.abs(np.einsum("gc,gc->g", ray, normal)) / depth
    std = np.hypot(sensor.knowledge.depth_std(depth, glance.view) * slant, background.rough[nearest])
    std[slant < GRAZING] = np.inf
    by_pose = np.zeros((len(points), len(poses), 6))
    by_pose[np.arange(len(points)), glance.view] = np.hstack([np.cross(points - sensor.pivot, normal), normal])
    off = np.einsum("gc,gc->g", points - background.middles[nearest], normal)
    return off / std, by_pose.reshape(len(points), -1) / std[:, None]
