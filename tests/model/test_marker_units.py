"""Markers in another unit show by their distances, in every command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record

from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.model.marker_units import check_marker_distances

RECORDING = record(np.array([(0, 0, 0, 0), (2.0, 0, 0, 0)]), noise=2e-4)[0]


@pytest.mark.parametrize(("scale", "unit"), [(39.37, "inches"), (100.0, "centimetres"), (3.281, "feet"), (1e-3, "kilometres")])
def test_another_unit_is_named(scale: float, unit: str) -> None:
    with pytest.raises(DataError, match=rf"times too large: are they in {unit}\?"):
        check_marker_distances(arm(), replace(RECORDING, marker_xyz=freeze(scale * RECORDING.marker_xyz)))


def test_bent_bodies_lost_markers_and_swapped_labels_are_in_metres() -> None:
    check_marker_distances(arm(), RECORDING)
    lost = RECORDING.marker_xyz.copy()
    lost[:2] = 50.0
    check_marker_distances(arm(), replace(RECORDING, marker_xyz=freeze(lost)))
    check_marker_distances(arm(), replace(RECORDING, marker_index=freeze(RECORDING.marker_index[::-1], np.int64)))
