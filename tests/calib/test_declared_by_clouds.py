"""A declared pose that the clouds of free frames contradict, with no marker in them."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import arm, record
from clouded_arm import EYES, with_clouds

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.pose import move_pose
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


@pytest.mark.parametrize("modulus", [300e3, 500e3])
def test_a_declared_pose_that_is_right_is_not_accused(seen: Seen, modulus: float) -> None:
    assert said_of(declared(seen, [0.0] * 6), modulus) == []


def test_where_a_modulus_explains_as_much_both_are_named(seen: Seen) -> None:
    told = said_of(declared(seen, [0.0] * 6), 180e3)
    if seen[0].actuation_zero == "unknown":  # inputs take up what the modulus leaves
        assert not [text for text in told if text.startswith("refused")]
        return
    (text,) = told
    assert not text.startswith("refused")
    assert "a modulus 1.7 times as large leaves" in text or "a modulus 1.6 times as large leaves" in text
