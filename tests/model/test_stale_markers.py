"""Markers written where they were before are left out; what may repeat by itself is not."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline
from femsense.model.stale_markers import without_far_markers, without_stale_markers, without_twins

F, M = 6, 4


def recorded(xyz: np.ndarray, inputs: np.ndarray) -> Recording:
    rows = MarkerRows(list("abcd"), np.repeat(np.arange(F), M), np.tile(np.arange(M), F), xyz.reshape(-1, 3))
    return make_recording(Timeline(0.1 * np.arange(F)), drives=Drives(["c"], inputs[:, None]), markers=rows)


def noisy() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(F, M, 3)).round(6)


def left(xyz: np.ndarray, inputs: np.ndarray) -> list[tuple[int, int]]:
    r = without_stale_markers(recorded(xyz, inputs))
    return list(zip(r.marker_frame.tolist(), r.marker_index.tolist()))


def test_a_lost_marker_that_keeps_its_last_place() -> None:
    xyz = noisy()
    xyz[3:5, 1] = xyz[2, 1]
    with pytest.warns(UserWarning, match="left out: b in frame 3, b in frame 4"):
        rows = left(xyz, np.arange(F))
    assert {(k, m) for k in range(F) for m in range(M)} - set(rows) == {(3, 1), (4, 1)}


def test_a_tracker_that_freezes_while_inputs_change() -> None:
    xyz = noisy()
    xyz[4:] = xyz[3]
    with pytest.warns(UserWarning, match="and 2 more"):
        rows = left(xyz, np.arange(F))
    assert max(k for k, _ in rows) == 3
    assert len(left(xyz, np.array([0, 1, 2, 3, 3, 3]))) == F * M  # nothing should have moved
    with pytest.warns(UserWarning, match="and 2 more"):
        assert max(k for k, _ in left(xyz, np.array([0, 1, 2, 3, 4, 4]))) == 3  # the copy of a copy


def test_coarse_digits_and_markers_that_never_move_are_kept() -> None:
    rng = np.random.default_rng(1)
    coarse = 0.1 + 0.001 * rng.integers(0, 2, size=(F, M, 3))
    assert len(left(coarse, np.arange(F))) == F * M
    still = noisy()
    still[:, 2] = still[0, 2]
    assert len(left(still, np.arange(F))) == F * M


def test_one_row_far_from_the_others_is_left_out_but_not_another_unit() -> None:
    xyz = noisy()
    xyz[2, 3] = [0.0, 0.0, 90.0]
    with pytest.warns(UserWarning, match="left out: d in frame 2"):
        assert len(without_far_markers(recorded(xyz, np.zeros(F)), 10.0).marker_frame) == F * M - 1
    assert len(without_far_markers(recorded(1e3 * xyz, np.zeros(F)), 10.0).marker_frame) == F * M


def test_two_markers_at_one_place_are_both_left_out() -> None:
    xyz = noisy()
    xyz[2, 3] = xyz[2, 0]
    xyz[4, 1] = xyz[3, 2]  # of another frame
    with pytest.warns(UserWarning, match="another marker of the frame; left out: a in frame 2, d in frame 2$"):
        r = without_twins(recorded(xyz, np.arange(F)))
    rows = set(zip(r.marker_frame.tolist(), r.marker_index.tolist()))
    assert {(k, m) for k in range(F) for m in range(M)} - rows == {(2, 0), (2, 3)}
    plain = recorded(noisy(), np.arange(F))
    assert without_twins(plain) is plain
