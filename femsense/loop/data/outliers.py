"""Outliers: single measurements that deviate from the others of their frame and of their marker.

A reflection, or the names of two markers swapped in one frame, would dominate a least-squares fit and the reported error.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import Trial
from femsense.loop.thresholds import Thresholds


def without_outliers(data: Data, fitted: Sequence[FloatArray], held_out: Sequence[FloatArray]) -> Data:
    """Return the data without the outliers in the residuals (k, c) [m] of the fitted and the held-out trials, and warn of each recording's."""
    train = [_kept(data, t, r) for t, r in zip(data.train, fitted)]
    held = [_kept(data, t, r) for t, r in zip(data.held, held_out)]
    pairs = [*zip(data.train, train), *zip(data.held, held)]
    found = [s for before, after in pairs if after is not before for s in _named(data, before, after)]
    return replace(data, train=train, held=held, outliers=(*data.outliers, *found)) if found else data


def _kept(data: Data, trial: Trial, residual: FloatArray) -> Trial:
    """Return a trial without its outliers; unchanged if there are none, or for clouds."""
    if trial.scene.crossings is not None:
        return trial
    off = outliers(
        residual, trial.scene.frame, trial.scene.marker, data.thresholds.far_off * data.robot.body.reach, data.thresholds
    )
    if not off.any():
        return trial
    return replace(trial, scene=trial.scene.of_rows(~off), groups=trial.groups.of_rows(~off), mesh_error=None)


def outliers(residual: FloatArray, frame: IntArray, marker: IntArray, far: float, thresholds: Thresholds) -> BoolArray:
    """Return which rows of a residual (k, 3) [m] are outliers, shape (k,).

    After the medians of its frame and of its marker are subtracted, an outlier is longer than `far` [m] and than `outlying` times the 90 % quantile.

    Several rows of a frame that deviate in the same direction are kept: there the model is wrong, not the measurement. Two markers with
    swapped names deviate in opposite directions.
    """
    apart = _less_medians(_less_medians(residual, frame), marker)
    size = np.linalg.norm(apart, axis=1)
    off = size > max(far, thresholds.outlying * float(np.quantile(size, 0.9)))
    for k in np.unique(frame[off]):
        rows = np.flatnonzero(off & (frame == k))
        if len(rows) > 1 and (apart[rows] @ apart[rows].T > 0.0).all():
            off[rows] = False
    return off if off.sum() <= max(thresholds.rare * len(off), 1) else np.zeros(len(off), dtype=bool)


def _less_medians(values: FloatArray, labels: IntArray) -> FloatArray:
    """Return values (k, 3) with the median of the rows of the same label subtracted."""
    result = values.copy()
    for label in np.unique(labels):
        rows = labels == label
        result[rows] -= np.median(values[rows], axis=0)
    return result


def _named(data: Data, before: Trial, after: Trial) -> list[tuple[int, str]]:
    """Return frame numbers and names of the markers that a trial has lost, and warn of them."""
    scene = before.scene
    kept = set(zip(after.scene.frame.tolist(), after.scene.marker.tolist(), after.scene.view.tolist()))
    lost = [r for r in zip(scene.frame.tolist(), scene.marker.tolist(), scene.view.tolist()) if r not in kept]
    found = [(int(scene.recording.frame_numbers[f]), data.robot.marker_names[m]) for f, m, _ in lost]
    said = ", ".join(f"{name} in frame {number}" for number, name in found[:5]) + (" …" if len(found) > 5 else "")
    warnings.warn(f"{scene.recording.folder}: outliers are left out: {said}", stacklevel=2)
    return found
