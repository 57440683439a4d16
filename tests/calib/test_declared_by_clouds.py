"""A declared pose that the clouds of free frames contradict, with no marker in them."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import arm, record
from clouded_arm import EYES, with_clouds
from scipy.spatial.transform import Rotation

from femsense.calib.calibrate import calibrate
from femsense.calib.clouds_alone import started_at
from femsense.calib.from_clouds import fit_clouds, pose_pivot
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.pose import invert_pose, move_pose, transform_points
from femsense.model.recording import Recording

INPUTS = np.array([[1.5, 0, 0, 0], [0, 1.5, 0, 0], [0, 0, 1.5, 0]])
INITIAL = np.array([0.6, 0.3, 0.2, 0.4])
Seen = tuple[Recording, FloatArray]


@pytest.fixture(scope="module", params=["absolute", "unknown"])
def seen(request, tmp_path_factory) -> Seen:
    """Clouds of three free frames without colour, and the true pose."""
    how = {"zero": "unknown", "initial": INITIAL} if request.param == "unknown" else {}
    recording, states = record(INPUTS, **how)
    folder = Path(tmp_path_factory.mktemp(request.param))
    bare, poses = with_clouds(folder, recording, states, EYES[:1], clutter=True, colored=False)
    return bare, poses[0]


def declared(seen: Seen, step: list[float]) -> Recording:
    return replace(seen[0], T_robot_camera=(move_pose(seen[1], step, pivot_a=[0.05, 0, 0]),))


def said_of(recording: Recording, modulus: float = 300e3) -> list[str]:
    """Return what is said of the declared pose: an error or warnings."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            calibrate(arm(modulus=modulus), recording)
        except DataError as error:
            return [f"refused: {error}"]
    return [str(w.message) for w in heard if "declared pose" in str(w.message)]


def test_a_declared_pose_that_clouds_contradict_is_refused_with_its_shift(seen: Seen) -> None:
    for step, word in (
        ([0, 0, 0, 0, 0.01, 0], r"shifted by (9\.\d+|10\.?\d?) mm"),
        ([0, 0, 0, 0, 0, 0.005], r"shifted by (4|5)\.\d+ mm"),
    ):
        with pytest.raises(DataError, match=rf"declared pose of camera .*{word}"):
            calibrate(arm(), declared(seen, step))


def test_a_declared_pose_that_is_far_away_is_refused(seen: Seen) -> None:
    with pytest.raises(DataError, match="declared pose of camera"):
        calibrate(arm(), declared(seen, [0, 0, 0, 0.1, 0, 0]))


def test_a_turn_of_a_few_degrees_is_said(seen: Seen) -> None:
    (text,) = said_of(declared(seen, [0, np.radians(4.0), 0, 0, 0, 0]))
    assert "turned by" in text


@pytest.mark.parametrize("axis", [3, 4, 5])
def test_three_millimetres_are_said_or_refused(seen: Seen, axis: int) -> None:
    (text,) = said_of(declared(seen, [0.003 if i == axis else 0.0 for i in range(6)]))
    assert re.search(r"shifted by (2\.\d+|3(\.\d+)?) mm", text)


def test_what_the_clouds_know_is_said_where_a_fitted_pose_leaves_a_third(seen: Seen) -> None:
    if seen[0].actuation_zero == "absolute":
        (text,) = said_of(declared(seen, [0, 0, 0, 0.002, 0, 0]))
        assert "times what the clouds leave open" in text and not text.startswith("refused")


@pytest.mark.parametrize("modulus", [300e3, 500e3])
def test_a_declared_pose_that_is_right_is_not_accused(seen: Seen, modulus: float) -> None:
    assert said_of(declared(seen, [0.0] * 6), modulus) == []


def test_deviations_of_a_pose_hold_what_another_law_would_move(seen: Seen) -> None:
    """4.0 deviations off without it, where the inputs are known: six coordinates give 2.4 by chance."""
    recording, T = seen
    if recording.actuation_zero == "unknown":
        return
    robot = arm()
    start = started_at(robot, calibrate(robot, replace(recording, T_robot_camera=(T,))), {0: T})
    found = fit_clouds(robot, recording, start, guessed=(0,))
    apart, pivot = T @ invert_pose(found.poses[0]), pose_pivot(robot)
    step = np.append(Rotation.from_matrix(apart[:3, :3]).as_rotvec(), transform_points(apart, pivot[None])[0] - pivot)
    assert np.sqrt(step @ np.linalg.solve(found.joint_covariance, step)) < 3.0


def test_where_a_modulus_explains_as_much_both_are_named(seen: Seen) -> None:
    told = said_of(declared(seen, [0.0] * 6), 180e3)
    if seen[0].actuation_zero == "unknown":  # inputs take up what the modulus leaves
        assert not [text for text in told if text.startswith("refused")]
        return
    (text,) = told
    assert not text.startswith("refused")
    assert "a modulus 1.7 times as large leaves" in text or "a modulus 1.6 times as large leaves" in text
