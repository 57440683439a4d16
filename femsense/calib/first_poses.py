"""Where the fit of the camera poses begins: declared, from markers at rest, or from those of one frame."""

from __future__ import annotations

import numpy as np

from femsense.calib.inputs import first_inputs
from femsense.calib.rigid import fit_rigid, fit_rigid_robust
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import SolveOptions
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.model.observation import Scene
from femsense.model.recording_checks import camera_text
from femsense.model.robot import Robot

IN_LINE = 0.1
"""Markers lie nearly in a line where they are so much narrower than long [1]."""


def first_poses(robot: Robot, scene: Scene) -> list[FloatArray]:
    """Return a start for the pose of each camera: declared, from the markers at rest, or from those of the first frame.

    Raises:
        DataError: a camera sees fewer than three markers.
    """
    poses: list[FloatArray] = []
    for v, name in enumerate(scene.recording.camera_names):
        declared = scene.recording.T_robot_camera[v]
        resting = scene.rest_view == v
        if declared is not None:
            poses.append(declared)
        elif resting.sum() >= 3:
            poses.append(fit_rigid_robust(robot.marker_points[scene.rest_marker[resting]], scene.rest_points[resting])[0])
        else:
            poses.append(_pose_from_frames(robot, scene, v, name))
    return poses


def _pose_from_frames(robot: Robot, scene: Scene, view: int, name: str) -> FloatArray:
    """Fit the first frame in which a camera sees enough markers to the model of that frame; all such frames where its markers lie nearly in a line.

    About a line one frame does not say how the robot is turned, and a fit from there does not find it: three markers on a finger of `gripper` left the
    pose 17° off, and all its frames start it at 0.6°.
    """
    driven = DrivenRobot(robot, drive_of(robot, scene.recording, initial=first_inputs(robot, scene.recording)))
    mine = scene.view == view
    many = [int(k) for k in scene.frames if ((scene.frame == k) & mine).sum() >= 3]
    if not many:
        most = max((int(((scene.frame == k) & mine).sum()) for k in scene.frames), default=0)
        raise DataError(
            f"{camera_text(name)} needs a frame with three markers for its pose; the most in one frame is {most}. "
            f"Give T_robot_camera, or show more markers"
        )
    used = many if in_line(scene.points[(scene.frame == many[0]) & mine]) else many[:1]
    modelled, measured = [], []
    for k in used:
        rows = (scene.frame == k) & mine
        state = solve_frame(driven, k, options=SolveOptions(single=True))
        shape = state.positions if state.converged else robot.body.mesh.nodes
        modelled.append(robot.markers.positions(shape)[scene.marker[rows]])
        measured.append(scene.points[rows])
    return fit_rigid(np.vstack(modelled), np.vstack(measured))


def in_line(points: FloatArray) -> bool:
    """Return whether points (n, 3) lie nearly in a line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < IN_LINE * spread[0])
