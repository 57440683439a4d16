"""Check whether a given calibration belongs to a recording: its contact-free frames are calibrated again and compared."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from femsense.calib.calibrate import calibrated_start
from femsense.calib.calibration import Calibration
from femsense.calib.pressure_zeros import with_initial_pressures
from femsense.calib.rigid import poses_apart
from femsense.core.arrays import IntArray
from femsense.model.marker_correction import corrected
from femsense.model.recording import Recording
from femsense.model.recording_checks import check_against
from femsense.model.robot import Robot

MOVED = 5.0
"""A camera has moved if the body appears displaced by more than this multiple of the calibration residual …"""
SHARE = 0.01
"""… and by this share of the body's diagonal; below, forces change little."""
FEWEST, MARKERS = 2, 4
"""Minimum number of contact-free frames, and of markers in them."""


def check_given(robot: Robot, recording: Recording, calibration: Calibration) -> None:
    """Refuse a recording whose own contact-free frames cannot be calibrated, and warn about a camera that has moved since.

    Recordings without contact-free frames, or without named markers in them, are not checked.

    Arguments:
        robot: the robot.
        recording: result of `load_recording`.
        calibration: calibration of this or another recording.

    Raises:
        DataError: markers or inputs that do not belong to the robot.
    """
    frames = _telling(recording)
    if len(frames) < FEWEST or len(calibration.poses) != len(recording.camera_names):
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reported by the estimate
        fitting = check_against(robot, recording)
    if calibration.is_corrected:
        fitting = corrected(fitting, robot.require_correction(), calibration.poses)
    free = replace(fitting, T_robot_camera=(None,) * len(recording.camera_names))
    driven = with_initial_pressures(robot.in_recording(recording.label), calibration.chamber_pressure_pa)
    poses, _, _ = calibrated_start(driven, free, frames, strict=True)
    for v, name in enumerate(recording.camera_names):
        off = poses_apart(calibration.poses[v], poses[v], robot.marker_points)
        size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
        if off > max(MOVED * calibration.rms_m, SHARE * size):
            camera = f"camera {name}" if name else "the camera"
            warnings.warn(
                f"{camera} sees the body {1e3 * off:.3g} mm from where the calibration has it: was it moved since? Calibrate this "
                f"recording",
                stacklevel=3,
            )


def _telling(recording: Recording) -> IntArray:
    """Return the contact-free frames in which every camera sees enough markers."""
    if recording.free is None or recording.unnamed_frame.size:
        return np.zeros(0, dtype=np.int64)
    seen = np.zeros((len(recording.time_s), len(recording.camera_names)), dtype=np.int64)
    np.add.at(seen, (recording.marker_frame, recording.marker_view), 1)
    return np.flatnonzero(recording.free & (seen >= MARKERS).all(axis=1))
