"""Results in a few lines of text."""

from __future__ import annotations

import pytest
from results import NAN, make_calibration

from femsense.report.loop.document import Loop
from femsense.report.loop.text import loop_text
from femsense.report.text import calibration_text


@pytest.mark.parametrize(("noise_m", "said"), [(3e-4, True), (1.2e-2, False), (NAN, False)])
def test_a_residual_far_above_the_noise_is_said_to_be_an_error_of_the_model(noise_m: float, said: bool) -> None:
    text = calibration_text(make_calibration(rms_m=2.5e-2, noise_m=noise_m))
    assert ("error of the model  24.998 mm of it: markers repeat to 0.300 mm" in text) == said


def test_a_loop_says_how_large_the_error_of_the_model_is() -> None:
    parts = {"held_out_m": 0.0121, "noise_source": "marker_noise_m of recording.toml"}
    text = loop_text(Loop.model_validate({"verdict": "unexplained", "model_error": parts}))
    assert "12.100 mm held out, beyond noise and discretisation; noise: marker_noise_m of recording.toml" in text
    assert "error of the model" not in loop_text(Loop(verdict="none"))


def test_what_was_fitted_along_and_is_handed_back_is_said_with_its_values() -> None:
    along = {"cable_offset": {"offset_n": {"value": {"m1": 0.21}, "std": {"m1": 0.08}, "unit": "N"}}}
    text = loop_text(Loop.model_validate({"verdict": "effects", "fitted_along": along}))
    title, values = text.split("cable_offset (fitted along, part of the improved robot, not named)")
    assert "verdict: effects" in title and "0.21" in values and "0.08" in values
