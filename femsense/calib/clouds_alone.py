"""Poses of cameras without markers from the clouds of contact-free frames, without an initial guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.cloud_pose_search import View, find_cloud_pose
from femsense.calib.first_poses import in_line
from femsense.calib.from_clouds import START_STD, fit_clouds
from femsense.calib.inputs import calibrated_inputs, most_different
from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.camera_frame import undo_depth
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.model.marker_correction import recorded_inputs
from femsense.model.recording import Recording
from femsense.model.recording_checks import camera_text, how_to_free
from femsense.model.robot import Robot
from femsense.pointcloud.rays import Surface
from femsense.pointcloud.segmentation import color_mask

FRAMES = 3
"""Number of contact-free frames for the pose search, those with the most different inputs."""
UNDETERMINED = 0.5
"""A direction is undetermined if its standard deviation exceeds this share of START_STD."""


def views_without_markers(recording: Recording, frames: IntArray) -> list[int]:
    """Return the cameras with clouds and an undeclared pose that markers do not determine: fewer than three in each usable frame, or
    collinear ones."""
    seen = set(recording.unnamed_view.tolist())
    if recording.rest is not None:
        seen |= set(recording.rest.view.tolist())
    return [
        v
        for v, T in enumerate(recording.T_robot_camera)
        if T is None
        and v not in seen
        and any(files[v] is not None for files in recording.cloud_files)
        and not _markers_tell_pose(recording, frames, v)
    ]


def _markers_tell_pose(recording: Recording, frames: IntArray, view: int) -> bool:
    """Return whether the named markers of a camera determine its pose."""
    mine = (recording.marker_view == view) & np.isin(recording.marker_frame, frames)
    most = np.bincount(recording.marker_frame[mine]).max(initial=0)
    return bool(most >= 3 and not in_line(recording.marker_xyz[mine]))


def placed_by_clouds(robot: Robot, recording: Recording, calibration: Calibration, views: Sequence[int]) -> Calibration:
    """Return the calibration with poses of cameras without markers.

    Arguments:
        robot, recording: results of `load_robot` and `load_recording`.
        calibration: calibration of the other cameras; the poses of `views` are replaced.
        views: the cameras.

    Raises:
        DataError: no contact-free frame with a cloud, no pose that fits, a symmetric body, or clouds that do not determine a pose.
    """
    states = free_states(robot, recording, calibration, views)
    start = started_at(
        robot, calibration, {v: find_cloud_pose(seen_by(robot, recording, states, v)).T_robot_camera for v in views}
    )
    fitted = fit_clouds(robot, recording, start, guessed=views)
    _check_determined(recording, start, fitted, views)
    inputs_too = recording.actuation_zero == "unknown" and bool(robot.body.cables) and not calibration.marker_covariance.any()
    return fitted if inputs_too else replace(fitted, status="converged (cameras placed by clouds alone)")


def started_at(robot: Robot, calibration: Calibration, starts: dict[int, FloatArray]) -> Calibration:
    """Return the calibration with initial poses of some cameras, with the uncertainty of a search."""
    poses, covariance = list(calibration.poses), np.zeros((6 * len(calibration.poses),) * 2)
    if calibration.joint_covariance.size:
        covariance[:] = calibration.joint_covariance
    law = calibration.law_step.copy()
    turn, shift = START_STD[0], START_STD[1] * float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    for v, T in starts.items():
        own, poses[v] = slice(6 * v, 6 * v + 6), freeze(T)
        covariance[own, :], covariance[:, own] = 0.0, 0.0
        covariance[own, own] = np.diag([turn**2] * 3 + [shift**2] * 3)
        law[own] = 0.0
    return replace(
        calibration,
        T_robot_camera=poses[0],
        poses=tuple(poses),
        pose_covariance=freeze(covariance[:6, :6]),
        joint_covariance=freeze(covariance),
        law_step=freeze(law),
    )


def free_states(robot: Robot, recording: Recording, calibration: Calibration, views: Sequence[int]) -> dict[int, Equilibrium]:
    """Return the equilibria of the contact-free frames for the pose search."""
    free = np.zeros(recording.frame_count, dtype=bool) if recording.free is None else recording.free
    frames = [int(k) for k in np.flatnonzero(free) if all(recording.cloud_files[k][v] is not None for v in views)]
    if not frames:
        raise DataError(
            "the pose of a camera without markers needs a cloud of a free frame: mark frames in which nothing touches "
            f"the robot {how_to_free(recording)}"
        )
    initial = calibrated_inputs(robot, recording, calibration) if recording.actuation_zero == "unknown" else None
    driven = DrivenRobot(robot, drive_of(robot, recording, initial=initial))
    rows = recorded_inputs(recording)[frames]
    rows = rows / np.maximum(np.abs(rows).max(axis=0), 1e-12)
    states = {frames[i]: solve_frame(driven, frames[i]) for i in most_different(rows, FRAMES)}
    still = {k: state for k, state in states.items() if state.converged}
    if not still:
        raise DataError("no equilibrium in the free frames: are the inputs those of this robot?")
    return still


def seen_by(robot: Robot, recording: Recording, states: dict[int, Equilibrium], view: int) -> list[View]:
    """Return the views of the body by one camera in the frames of given equilibria."""
    triangles, seen = body_surface(robot.body.mesh).triangles, []
    for k, state in states.items():
        cloud = read_frame_cloud(recording, k, view=view)
        if cloud is None:
            continue
        points = undo_depth(cloud.points, robot.observation)
        mine, colored = np.ones(len(points), dtype=bool), cloud.colors is not None and robot.color_rgb is not None
        if cloud.colors is not None and robot.color_rgb is not None:
            mine = color_mask(cloud.colors, robot.color_rgb)
        ahead = points[:, 2] > 0
        seen.append(View(points[ahead], mine[ahead], Surface(state.positions, triangles), colored))
    return seen


def _check_determined(recording: Recording, start: Calibration, fitted: Calibration, views: Sequence[int]) -> None:
    """Refuse a pose that is about as uncertain after the fit as after the search.

    Raises:
        DataError: a direction of a camera is undetermined.
    """
    for v in views:
        own = slice(6 * v, 6 * v + 6)
        scale = 1.0 / np.sqrt(np.diag(start.joint_covariance)[own])
        values, vectors = np.linalg.eigh(scale[:, None] * fitted.joint_covariance[own, own] * scale)
        if values[-1] > UNDETERMINED**2:
            raise DataError(
                f"the clouds do not determine the pose of {camera_text(recording.camera_names[v])} "
                f"{_direction(vectors[:, -1])}: the fitted pose may be far off. Record contact-free frames in which other inputs bend the "
                "robot in other directions, or three markers that are not on one line; or declare T_robot_camera"
            )


def _direction(vector: FloatArray) -> str:
    """Return the text for a direction of (rotation, shift)."""
    turn, shift = np.linalg.norm(vector[:3]), np.linalg.norm(vector[3:])
    axis = vector[:3] / turn if turn > shift else vector[3:] / shift
    about = ", ".join(format(a, "g") for a in (np.round(axis, 1) + 0.0).tolist())  # without −0
    return f"as it turns about [{about}]" if turn > shift else f"along [{about}]"
