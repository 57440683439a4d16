"""Points between the frames of cameras and the robot, through poses and the camera's depth law."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.pose import invert_pose, transform_points
from femsense.model.robot import Observation


def undo_depth(points: FloatArray, seen: Observation) -> FloatArray:
    """Return true camera points [m] from measured ones: measured distance = scale × true distance + offset."""
    if seen.depth_scale != 1.0 or seen.depth_offset != 0.0:
        distance = np.linalg.norm(points, axis=1, keepdims=True)
        points = np.asarray(points * (distance - seen.depth_offset) / seen.depth_scale / distance)
    for correct in seen.corrections:
        points = correct(points)
    return points


def redo_depth(points: FloatArray, seen: Observation) -> FloatArray:
    """Return the measured camera points of true ones [m]; the inverse of `undo_depth` (corrections by fixed point)."""
    if seen.depth_scale == 1.0 and seen.depth_offset == 0.0 and not seen.corrections:
        return points
    for correct in reversed(seen.corrections):
        target = points
        for _ in range(20):
            points = points + (target - correct(points))
    distance = np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(points * (seen.depth_scale * distance + seen.depth_offset) / distance)


def in_robot_frame(points: FloatArray, view: IntArray, poses: Sequence[FloatArray], seen: Observation) -> FloatArray:
    """Return measured points in the robot frame [m], each through the pose of its camera."""
    corrected = undo_depth(points, seen)
    result = np.empty_like(corrected)
    for v, T in enumerate(poses):
        result[view == v] = transform_points(T, corrected[view == v])
    return result


def as_measured(points: FloatArray, view: IntArray, poses: Sequence[FloatArray], seen: Observation) -> FloatArray:
    """Return where each camera measures points of the robot frame [m], camera frame; the inverse of `in_robot_frame`."""
    result = np.empty_like(points)
    for v, T in enumerate(poses):
        result[view == v] = transform_points(invert_pose(T), points[view == v])
    return redo_depth(result, seen)
