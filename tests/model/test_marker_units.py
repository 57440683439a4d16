"""Markers in another unit show by their distances, in every command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record

from femsense.core.arrays import freeze
from femsense.core.errors import DataError
from femsense.model.marker_units import check_marker_distances, check_marker_sizes, doubt_of_size

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


def test_markers_that_span_more_than_a_robot_are_doubted_with_the_units_that_they_may_be_in() -> None:
    rng = np.random.default_rng(0)
    chain = np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2]]) + 1e-3 * rng.normal(size=(200, 3, 3))
    chain[0] = 99.0  # an outlier is no unit
    away = chain + np.array([0.0, 0.5, 3.0])  # in a camera's frame
    assert doubt_of_size(chain) == doubt_of_size(away) == ""
    assert "are they in millimetres (0.15 m) or in centimetres (1.5 m)?" in doubt_of_size(1e3 * chain)
    assert "are they in centimetres (0.15 m)?" in doubt_of_size(1e2 * chain)
    assert "are they in another unit?" in doubt_of_size(1e5 * chain)
    assert "are they in millimetres (0.14 m)" in doubt_of_size(
        1e3 * np.linspace([0, 0, 0], [0.1, 0.1, 0], 50)[:, None]
    )  # one that moves


@pytest.mark.parametrize(("scale", "said"), [(1e3, "millimetres"), (1e2, "centimetres"), (7.0, "are they of the same robot")])
def test_markers_of_another_size_than_the_model_makes_are_refused(scale: float, said: str) -> None:
    known = np.random.default_rng(0).normal(size=(20, 4, 3))
    check_marker_sizes(1.3 * known + 5.0, known)
    check_marker_sizes(scale * known[:, :1], known[:, :1])  # one alone has no size
    with pytest.raises(DataError, match=f"do not fit the model: .* times too large: .*{said}"):
        check_marker_sizes(scale * known, known)
