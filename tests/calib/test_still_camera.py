"""A camera that was moved between two frames is named; a model that lacks something is no moved camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record

from femsense.calib.calibrate import calibrate
from femsense.calib.checks import Pairs
from femsense.calib.still_camera import check_camera_still
from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.model.recording import Recording

LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5)])
RECORDING: Recording = record(LEVELS, noise=2e-4)[0]


def test_a_camera_that_moved_is_named_with_the_frames() -> None:
    moved = RECORDING.marker_xyz + np.outer(RECORDING.marker_frame >= 3, [0.01, 0.0, 0.004])
    with pytest.raises(DataError, match="seems to have moved between frames 2 and 3"):
        calibrate(arm(), replace(RECORDING, marker_xyz=freeze(moved)))


def test_a_soft_body_and_markers_close_together_are_no_moved_camera() -> None:
    with pytest.warns(UserWarning, match="young_modulus_pa"):
        calibrate(arm(modulus=600e3), RECORDING)
    rows, rng = np.repeat(np.arange(6), 5), np.random.default_rng(0)
    tip = np.tile([0.1, 0.0, 0.0] + 0.002 * rng.normal(size=(5, 3)), (6, 1))
    bent = Pairs(tip, tip + np.outer(rows >= 3, [0.01, 0.0, 0.0]), np.tile(np.arange(5), 6), rows)
    check_camera_still(arm(), RECORDING, [bent])  # they move as one, whatever moves them
