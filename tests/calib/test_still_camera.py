"""A camera that was moved between two frames is named; a model that lacks something is no moved camera."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.model.recording import Recording

LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5)])
RECORDING: Recording = record(LEVELS, noise=2e-4)[0]


def test_a_camera_that_moved_is_named_with_the_frames() -> None:
    moved = RECORDING.marker_xyz + np.outer(RECORDING.marker_frame >= 3, [0.01, 0.0, 0.004])
    with pytest.raises(
        DataError, match=r"the camera or the .* moved between frames 2 and 3: .* column free marks with 1, write 0 there"
    ):
        calibrate(arm(), replace(RECORDING, marker_xyz=freeze(moved)))


def test_a_soft_body_and_markers_close_together_are_no_moved_camera() -> None:
    with pytest.warns(UserWarning, match="young_modulus_pa"):
        calibrate(arm(modulus=600e3), RECORDING)
    tip = np.isin(RECORDING.marker_index, [8, 9, 10, 11])
    kept = {name: freeze(getattr(RECORDING, name)[tip], np.int64) for name in ("marker_frame", "marker_index", "marker_view")}
    bent = RECORDING.marker_xyz[tip] + np.outer(kept["marker_frame"] >= 3, [0.002, 0.0, 0.0])
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        calibrate(arm(), replace(RECORDING, **kept, marker_xyz=freeze(bent)))
    assert not [w for w in heard if "moved" in str(w.message)]  # they move as one, whatever moves them
