"""Inputs in another unit, and motions that hint at another modulus."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import arm, record

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.model.recording import Recording

LEVELS = [(0, 0, 0, 0), (0.8, 0, 0, 0), (0.4, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5), (0, 0, 0.3, 0)]


@cache
def recording() -> Recording:
    return record(np.array(LEVELS), noise=2e-4)[0]


def with_inputs(inputs: np.ndarray) -> Recording:
    return replace(recording(), inputs=freeze(inputs))


@pytest.mark.parametrize(("scale", "unit"), [(1 / 9.807, "kilogram-force"), (1 / 4.448, "pounds")])
def test_inputs_in_another_unit_are_refused(scale: float, unit: str) -> None:
    with pytest.raises(DataError, match=rf"the inputs seem to be in {unit}: .*The files hold newtons"):
        calibrate(arm(), with_inputs(scale * recording().inputs))


def test_right_inputs_are_not_accused_and_a_soft_body_is_only_mentioned(recwarn: pytest.WarningsRecorder) -> None:
    assert calibrate(arm(), recording()).rms_m < 5e-4
    assert not recwarn
    with pytest.warns(UserWarning, match="times as far as the model.*young_modulus_pa"):
        calibrate(arm(modulus=600e3), recording())
