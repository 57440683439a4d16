"""What markers repeat to in states that are reached again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline
from femsense.model.repeats import marker_repeatability, stays_of


def holds_at(levels: list[float], noise: float) -> Recording:
    """Return a recording of five markers that go with the input, and scatter about that."""
    rng, count = np.random.default_rng(2), 5
    moved = np.repeat(np.array(levels), count)[:, None] * [1.0, 2.0, 3.0]
    return make_recording(
        Timeline(np.arange(len(levels))),
        drives=Drives(["a"], np.array(levels)[:, None]),
        markers=MarkerRows(
            [f"m{i}" for i in range(count)],
            np.repeat(np.arange(len(levels)), count),
            np.tile(np.arange(count), len(levels)),
            moved + noise * rng.normal(size=(len(levels) * count, 3)),
        ),
    )


def test_repeats_tell_what_markers_scatter_by_however_far_they_move() -> None:
    assert marker_repeatability(holds_at([0.0, 0.0, 1.0, 1.0, 2.0, 2.0] * 4, 3e-4)) == pytest.approx(3e-4, rel=0.15)
    assert marker_repeatability(holds_at([0.0, 1.0, 2.0] * 8, 3e-4)) == pytest.approx(3e-4, rel=0.15)


def test_what_is_declared_comes_first_and_without_repeats_nothing_is_known() -> None:
    recording = holds_at([0.0, 1.0, 2.0, 3.0], 3e-4)
    assert np.isnan(marker_repeatability(recording))
    assert marker_repeatability(replace(recording, marker_noise_m=1e-4)) == 1e-4


def test_a_state_that_is_reached_from_above_is_another_one_than_from_below() -> None:
    stays = stays_of(holds_at([0.0, 1.0, 2.0, 1.0, 1.0, 2.0, 1.0], 0.0))
    assert [stays[k][0] for k in range(7)] == [0, 1, 2, 3, 3, 4, 5]
    assert stays[1][1] != stays[3][1] == stays[6][1]
