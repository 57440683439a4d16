"""Markers that are all a little too large: said with the scale, and right ones are not accused."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, by_two_cameras, record

from femsense.calib.calibrate import calibrate
from femsense.calib.marker_readings import scaled
from femsense.core.errors import DataError
from femsense.model.recording import Recording

PULLS = np.array([[0.0, 0, 0, 0], [1.0, 0, 0, 0], [1.0, 0, 0.7, 0], [0, 0, 1.2, 0], [0, 0, 0, 1.0]])
SAID = r"the camera are ([\d.]+) ± [\d.]+ times too large"


@cache
def recording(zero: str = "absolute") -> Recording:
    how = {"zero": zero, "initial": np.array([0.6, 0.3, 0.2, 0.4])} if zero == "unknown" else {}
    return record(PULLS, noise=2e-4, seed=1, **how)[0]


def scales_said(seen: Recording, modulus: float = 300e3) -> list[float]:
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            calibrate(arm(modulus=modulus), seen)
        except DataError as error:
            return [float(x) for x in re.findall(SAID, str(error))]
    return [float(x) for w in heard for x in re.findall(SAID, str(w.message))]


@pytest.mark.parametrize("zero", ["absolute", "unknown"])
@pytest.mark.parametrize("scale", [1.03, 0.97])
def test_a_scale_is_said_with_its_number(zero: str, scale: float) -> None:
    (found,) = scales_said(scaled(recording(zero), [0], scale))
    assert found == pytest.approx(scale, abs=0.003)


@pytest.mark.parametrize("zero", ["absolute", "unknown"])
@pytest.mark.parametrize("modulus", [180e3, 300e3, 500e3])
def test_right_markers_are_not_accused_whatever_the_modulus(zero: str, modulus: float) -> None:
    assert scales_said(recording(zero), modulus) == []


@pytest.mark.parametrize(
    ("scale", "which"), [((1.0, 1.04), r"camera right are 1\.0[34]"), ((1.03, 1.03), r"all cameras are 1\.0(29|3)")]
)
def test_the_cameras_are_named_whose_markers_are_too_large(scale: tuple[float, float], which: str) -> None:
    with pytest.warns(UserWarning, match=rf"the markers of {which}\d* ± \S+ times too large"):
        calibrate(arm(), by_two_cameras(recording(), scale=scale))


def test_a_declared_pose_that_is_off_is_no_scale() -> None:
    away = T_ROBOT_CAMERA.copy()
    away[:3, 3] += 0.002 * away[:3, 2]  # along the view, as a scale about the camera would
    seen = replace(recording(), T_robot_camera=(away,))
    assert scales_said(seen) == []
