"""A declared pose that is not that of the camera is named, by how much; one that is right is not."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm, by_two_cameras, record

from femsense.calib.calibrate import calibrate
from femsense.calib.calibration import Calibration
from femsense.core.errors import DataError
from femsense.core.pose import move_pose
from femsense.model.recording import Recording

LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0)])
INITIAL = np.array([0.6, 0.3, 0.2, 0.4])


def declared(recording: Recording, step: list[float]) -> Recording:
    return replace(recording, T_robot_camera=(move_pose(T_ROBOT_CAMERA, step, pivot_a=[0.05, 0, 0]),))


ACROSS = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
"""Differences of opposite cables bend the arm, as a pose that is off turns it."""


def bends(found: Calibration) -> tuple[np.ndarray, np.ndarray]:
    """Return differences of opposite initial tensions and their deviations [N], shape (2,) each."""
    tension = ACROSS @ [found.cable_tension_n[name] for name in NAMES]
    return tension, np.sqrt(np.diag(ACROSS @ found.marker_covariance[-4:, -4:] @ ACROSS.T))


@pytest.mark.parametrize("zero", ["absolute", "unknown"])
def test_a_pose_that_is_off_is_named_with_its_shift_and_turn(zero: str) -> None:
    recording = record(LEVELS, noise=2e-4, **({"zero": zero, "initial": INITIAL} if zero == "unknown" else {}))[0]
    with pytest.raises(
        DataError,
        match=r"declared pose of the camera is .* shifted by (9\.\d+|10) mm \((9\.\d+|10), .*at the body: .* Leave T_robot_camera",
    ):
        calibrate(arm(), declared(recording, [0.0, 0.0, 0.0, 0.01, 0.0, 0.0]))
    with pytest.raises(DataError, match=r"declared pose of the camera is turned by (4\.\d+|5|5\.\d+)° "):
        calibrate(arm(), declared(recording, [0.0, np.radians(5.0), 0.0, 0.0, 0.0, 0.0]))


def test_a_pose_that_is_right_is_not_accused_though_the_body_is_too_soft() -> None:
    recording = record(LEVELS, noise=2e-4)[0]
    for robot in (arm(), arm(modulus=500e3)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = calibrate(robot, declared(recording, [0.0] * 6))
        np.testing.assert_array_equal(found.poses[0], T_ROBOT_CAMERA)


def test_a_pose_that_is_a_little_off_is_said() -> None:
    """Two millimetres beside unknown inputs, which take up a part of them, leave less than four times what a fitted pose leaves."""
    recording = record(LEVELS, noise=3e-4, zero="unknown", initial=INITIAL)[0]
    with pytest.warns(UserWarning, match=r"shifted by (1\.\d+|2|2\.\d) mm .*Or the model errs by as much: femsense improve"):
        calibrate(arm(), declared(recording, [0.0, 0.0, 0.0, 0.002, 0.0, 0.0]))


def test_deviations_of_inputs_hold_what_a_declared_pose_may_be_off() -> None:
    recording = record(LEVELS, noise=2e-4, zero="unknown", initial=INITIAL)[0]
    held, fitted = (bends(calibrate(arm(), replace(recording, T_robot_camera=(T,))))[1] for T in (T_ROBOT_CAMERA, None))
    assert np.all(held > 0.7 * fitted) and np.all(held < 1.3 * fitted)
    found, std = bends(calibrate(arm(), declared(recording, [0.0, 0.0, np.radians(0.3), 0.0, 0.0, 0.0007])))
    assert np.all(np.abs(found - ACROSS @ INITIAL) < 3.0 * std)


@pytest.mark.parametrize("zero", ["absolute", "unknown"])
def test_poses_that_are_off_together_are_named_together(zero: str) -> None:
    """Where the robot's base is elsewhere, each pose contradicts the others as soon as it alone is fitted."""
    one = record(LEVELS, noise=2e-4, **({"zero": zero, "initial": INITIAL} if zero == "unknown" else {}))[0]
    right = off(one, [0.0] * 6, [0.0] * 6)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        calibrate(arm(), right)
    assert not any("declared" in str(item.message) for item in heard)
    with pytest.raises(DataError, match=r"declared poses of cameras left, right are off: that of left is .*; that of right is"):
        calibrate(arm(), off(one, *[[0.0, 0.0, 0.0, 0.008, 0.0, 0.004]] * 2))
    with pytest.raises(DataError, match=r"declared pose of camera right is"):
        calibrate(arm(), off(one, [0.0] * 6, [0.0, 0.0, 0.0, 0.008, 0.0, 0.004]))


def off(one: Recording, *steps: list[float]) -> Recording:
    """Return a recording as two cameras have it, whose declared poses are off by steps."""
    poses = tuple(move_pose(T_ROBOT_CAMERA, step, pivot_a=[0.05, 0, 0]) for step in steps)
    return replace(by_two_cameras(one), T_robot_camera=poses)
