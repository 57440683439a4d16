"""A calibration that is given, and a recording that it may not belong to."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import arm, record

from femsense.calib.calibrate import calibrate
from femsense.calib.calibration import Calibration
from femsense.calib.given import check_given
from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.model.recording import Recording

LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5)])


@cache
def recording() -> Recording:
    return record(LEVELS, noise=2e-4)[0]


@cache
def calibration() -> Calibration:
    return calibrate(arm(), recording())


def test_a_recording_of_its_own_is_not_accused(recwarn: pytest.WarningsRecorder) -> None:
    check_given(arm(), recording(), calibration())
    check_given(arm(), replace(recording(), free=None), calibration())
    assert not recwarn


def test_a_camera_that_moved_is_named() -> None:
    moved = replace(recording(), marker_xyz=freeze(np.add(recording().marker_xyz, [0.01, 0.0, 0.0])))
    with pytest.warns(UserWarning, match=r"the camera sees the body 10(\.\d)? mm from where the calibration has it"):
        check_given(arm(), moved, calibration())


def test_what_calibrate_refuses_is_refused_with_a_calibration_too() -> None:
    with pytest.raises(DataError, match="wrong sign"):
        check_given(arm(), replace(recording(), inputs=freeze(-recording().inputs)), calibration())
    with pytest.raises(DataError, match="seem left-handed"):
        check_given(arm(), replace(recording(), marker_xyz=freeze(recording().marker_xyz * [1.0, 1.0, -1.0])), calibration())
