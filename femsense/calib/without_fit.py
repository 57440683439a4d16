"""Calibrations in which no frame is fitted: poses from markers at rest, or as they are declared."""

from __future__ import annotations

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.first_poses import first_poses
from femsense.calib.inputs import first_inputs, initial_state
from femsense.calib.joint import PLACEMENT_STD_FLOOR
from femsense.calib.marker_fit import root_mean_square
from femsense.core.arrays import IntArray
from femsense.core.errors import DataError
from femsense.core.least_squares import covariance_of
from femsense.core.pose import std_of_entries
from femsense.model.camera_frame import in_robot_frame
from femsense.model.observation import Scene, rest_residual
from femsense.model.recording import Recording
from femsense.model.recording_checks import camera_text, how_to_free
from femsense.model.robot import Robot


def from_rest(robot: Robot, recording: Recording) -> Calibration:
    """Return the calibration of a recording none of whose frames can be used: poses from the markers at rest alone."""
    if recording.actuation_zero == "unknown" and (robot.body.cables or robot.body.chambers):
        raise DataError(f"initial inputs need a frame that is free of undeclared contact: mark it {how_to_free(recording)}")
    number = {name: i for i, name in enumerate(robot.marker_names)}
    rest = recording.rest
    assert rest is not None
    marker = np.array([number.get(name, -1) for name in rest.names], dtype=np.int64)
    known = marker >= 0
    scene = Scene(
        recording, *(np.zeros(0, np.int64),) * 4, np.zeros((0, 3)), marker[known], rest.view[known], rest.positions[known]
    )
    poses = first_poses(robot, scene)
    left = rest_residual(robot, scene, poses)
    sigma = max(float(np.sqrt((left**2).sum() / max(left.size - 6 * len(poses), 1))), PLACEMENT_STD_FLOOR)
    arm = robot.marker_points[scene.rest_marker] - robot.marker_points.mean(axis=0)
    J = np.concatenate([np.hstack([np.cross(a, np.eye(3)), np.eye(3)]) for a in arm])
    covariance = covariance_of(J / sigma)
    state = initial_state(robot, recording, None)
    none: dict[str, float | None] = {n: 0.0 for n in robot.body.cable_names}
    per_marker = {robot.marker_names[m]: float(np.linalg.norm(r)) for m, r in zip(scene.rest_marker, left)}
    places = in_robot_frame(scene.rest_points, scene.rest_view, poses, robot.observation)
    placements_m = {robot.marker_names[m]: p.tolist() for m, p in zip(scene.rest_marker, places)}
    return Calibration(
        poses[0],
        tuple(poses),
        recording.camera_names,
        dict(state.tension),
        dict(state.shortening),
        root_mean_square(left),
        per_marker,
        (),
        std_of_entries(poses[0], covariance, robot.marker_points.mean(axis=0)),
        covariance,
        none,
        dict(none),
        "converged (from rest.csv alone: no frame is free)",
        placements_m,
    )


def as_declared(robot: Robot, recording: Recording, frames: IntArray) -> Calibration:
    """Return the calibration of a recording without markers whose poses are declared."""
    missing = [camera_text(name) for name, T in zip(recording.camera_names, recording.T_robot_camera) if T is None]
    if missing:
        raise DataError(
            f"no markers, no clouds and no T_robot_camera: the pose of {', '.join(missing)} is not known. Record "
            f"markers or clouds, or write T_robot_camera in recording.toml"
        )
    unknown = recording.actuation_zero == "unknown" and bool(robot.body.cables)
    if unknown and not recording.has_clouds:
        raise DataError("initial inputs need markers or clouds of free frames: record those, or absolute inputs")
    poses = tuple(T for T in recording.T_robot_camera if T is not None)
    state = initial_state(robot, recording, first_inputs(robot, recording))
    none: dict[str, float | None] = {n: 0.0 for n in robot.body.cable_names}
    return Calibration(
        poses[0],
        poses,
        recording.camera_names,
        dict(state.tension),
        dict(state.shortening),
        float("nan"),
        {},
        (),
        np.zeros((4, 4)),
        np.zeros((6, 6)),
        none,
        dict(none),
        "as declared: there are no markers to fit",
        frames=tuple(int(recording.frame_numbers[k]) for k in frames),
    )
