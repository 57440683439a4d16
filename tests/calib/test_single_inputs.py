"""The input of one cable that is off is named, with its gain and offset; what the model lacks is no such input."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import arm, record

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import FloatArray, freeze
from femsense.model.recording import Recording, select_frames

LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0.4, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5), (0, 0, 0.3, 0)])


@cache
def recording() -> Recording:
    return record(LEVELS, noise=2e-4)[0]


def with_inputs(inputs: FloatArray) -> Recording:
    return replace(recording(), inputs=freeze(inputs))


def test_an_offset_of_half_the_range_of_one_cable_is_named_though_little_is_left() -> None:
    spoiled = with_inputs(np.add(recording().inputs, [0.4, 0.0, 0.0, 0.0]))
    with pytest.warns(UserWarning, match=r"the input of up alone seems off \(times \S+ ± \S+, plus -0\.39 ± 0\.01 N\).*to 0\.3"):
        found = calibrate(arm(), spoiled)
    assert found.rms_m < 0.7e-3  # the check of other readings does not look at what fits as well as this


def test_a_gain_of_one_cable_is_named() -> None:
    with pytest.warns(UserWarning, match=r"the input of left alone seems off \(times 0\.82 ± "):
        calibrate(arm(), with_inputs(recording().inputs * [1.0, 1.0, 1.25, 1.0]))


@pytest.mark.parametrize("gain", [0.6, 0.75, 1.25])
@pytest.mark.parametrize("which", [0, 2])
def test_of_two_cables_the_one_is_named_whose_input_is_off(gain: float, which: int) -> None:
    """Beside the gain in common, one that is too weak is the other that is too strong; a fit with it tells."""
    pulls = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0.4, 0, 0.3, 0), (0, 0, 0.9, 0), (0.7, 0, 0.7, 0), (0.2, 0, 0.5, 0)])
    two = record(pulls, noise=2e-4)[0]
    spoiled = two.inputs.copy()
    spoiled[:, which] *= gain
    with pytest.warns(UserWarning, match=rf"the input of {('up', '', 'left')[which]} alone seems off") as heard:
        calibrate(arm(), replace(two, inputs=freeze(spoiled)))
    (read,) = (float(found[1]) for item in heard if (found := re.search(r"off \(times (\S+) ±", str(item.message))))
    assert read == pytest.approx(1.0 / gain, rel=0.12)


@pytest.mark.parametrize("modulus", [300e3, 450e3])
def test_neither_a_right_input_nor_a_soft_body_is_accused(modulus: float, recwarn: pytest.WarningsRecorder) -> None:
    calibrate(arm(modulus=modulus), recording())
    assert not [w for w in recwarn if "alone seems off" in str(w.message)]


def test_intervals_hold_a_gain_beside_an_offset() -> None:
    spoiled = with_inputs(np.add(recording().inputs * [1.0, 1.0, 1.0, 1 / 1.3], [0.0, 0.0, 0.0, 0.45]))
    with pytest.warns(UserWarning, match="the input of right alone seems off") as heard:
        calibrate(arm(), spoiled)
    read = re.search(r"times (\S+) ± (\S+), plus (\S+) ± (\S+) N", str(heard[0].message))
    assert read is not None
    gain, gain_std, offset, offset_std = map(float, read.groups())
    assert abs(gain - 1.3) < 0.05 + 3.0 * gain_std
    assert abs(offset + 0.585) < 0.02 + 3.0 * offset_std


def test_too_few_frames_tell_nothing(recwarn: pytest.WarningsRecorder) -> None:
    spoiled = np.add(recording().inputs[:3], [0.4, 0.0, 0.0, 0.0])
    calibrate(arm(), select_frames(with_inputs(recording().inputs), np.arange(3)))
    calibrate(arm(), replace(select_frames(recording(), np.arange(3)), inputs=freeze(spoiled)))
    assert not [w for w in recwarn if "alone seems off" in str(w.message)]
