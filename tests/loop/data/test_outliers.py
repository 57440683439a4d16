"""Single markers that are far off are left out and said; what is off in many frames is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.loop.data.outliers import outliers
from femsense.loop.improve import improve
from femsense.loop.thresholds import DEFAULTS
from femsense.model.recording import Recording


def rows(frames: int = 30, markers: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a residual of 0.2 mm with a drift of frames and offsets of markers, and the frame and marker of each row."""
    rng, frame, marker = np.random.default_rng(1), np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    values = 2e-4 * rng.normal(size=(frames * markers, 3)) + 5e-3 * np.sin(frame / 5.0)[:, None] + 3e-3 * (marker % 3)[:, None]
    return values, frame, marker


def test_a_marker_that_is_far_off_in_one_frame_is_a_stray():
    values, frame, marker = rows()
    assert not outliers(values, frame, marker, 5e-3, DEFAULTS).any()
    values[57] += [0.0, 8e-3, 0.0]
    assert np.flatnonzero(outliers(values, frame, marker, 5e-3, DEFAULTS)).tolist() == [57]
    assert not outliers(values, frame, marker, 9e-3, DEFAULTS).any()


def test_two_markers_that_swap_their_names_are_outliers_and_neighbours_that_are_off_alike_are_not():
    values, frame, marker = rows()
    first, second = np.flatnonzero((frame == 9) & np.isin(marker, (2, 5)))
    values[first] += [0.0, 9e-3, 0.0]
    values[second] -= [0.0, 9e-3, 0.0]
    assert np.flatnonzero(outliers(values, frame, marker, 5e-3, DEFAULTS)).tolist() == [first, second]
    values[second] += [2e-3, 18e-3, 0.0]
    assert not outliers(values, frame, marker, 5e-3, DEFAULTS).any()


def test_a_marker_that_slips_or_a_frame_that_is_off_is_none():
    values, frame, marker = rows()
    values[(marker == 4) & (frame > 14)] += 9e-3
    values[frame == 7] += 20e-3
    assert not outliers(values, frame, marker, 5e-3, DEFAULTS).any()


@pytest.mark.parametrize("k", [2, -2])
def test_the_loop_leaves_outliers_out_whether_they_are_fitted_or_held_out(k: int):
    """One marker a decimetre away, in the first sweep or in the last one, which is held out."""
    inputs, labels = sweeps()
    plain, _ = record(inputs, effects=[{"name": "stiffness", "scale": 1.25}], labels=labels, truth=arm((8, 3, 3)))
    row = int(np.flatnonzero(plain.marker_frame == (k % len(inputs)))[3])
    loop = improve(arm(), [plain])
    with pytest.warns(UserWarning, match=f"outliers are left out: m3 in frame {k % len(inputs)}"):
        spoiled = improve(arm(), [_moved(plain, row)])
    assert [(o.frame, o.marker) for o in spoiled.data.outliers] == [(k % len(inputs), "m3")] and not loop.data.outliers
    assert [e.name for e in spoiled.effects] == [e.name for e in loop.effects] == ["stiffness"]
    assert spoiled.after.validation_rms_m == pytest.approx(loop.after.validation_rms_m, rel=0.05)


def _moved(recording: Recording, row: int) -> Recording:
    xyz = recording.marker_xyz.copy()
    xyz[row] += [0.02, 0.03, 0.1]
    return replace(recording, marker_xyz=xyz)
