"""An empirical correction, judged on held-out data: it is handed back only where it helps there."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.correction import Correction, inputs_of, learn_correction, rows_of
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.result.records import CorrectionRecord

HELPS = 1.0
"""Held-out frames must be better by so many standard errors of their mean: as sweeps that are left out must be for an effect, and more."""


def judged_correction(data: Data, fitted: FittedModel) -> CorrectionRecord:
    """Return the empirical correction of what a model leaves, with its verdict: whether held-out markers are predicted better with it."""
    if "markers" not in data.measured:
        return CorrectionRecord(False, "clouds alone do not tell where markers are")
    learned = learn_correction(data, fitted)
    if learned is None:
        return CorrectionRecord(False, "what is left is no smooth function of the inputs, or there are too few states")
    pairs = [(t, r) for t, r in zip(data.held, fitted.held_residuals) if t.scene.crossings is None]
    after = [r - rows_of(learned, t)[0] for t, r in pairs]
    gains = np.concatenate([_by_frame(t.scene.frame, r, a) for (t, r), a in zip(pairs, after)])
    mean, error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else float("inf")
    far = float(np.max([np.abs(inputs_of(t) / learned.ranges).max() for t, _ in pairs]))
    helps = mean > HELPS * error
    words = "held-out markers are predicted better" if helps else "held-out markers are not surely predicted better"
    return _record(learned, helps, words, rms_of([r for _, r in pairs]), rms_of(after), far)


def _by_frame(frame: IntArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return by how much the mean square of each frame falls [m²]."""
    number = np.unique(frame, return_inverse=True)[1]
    fall = (before**2).sum(axis=1) - (after**2).sum(axis=1)
    return np.asarray(np.bincount(number, fall) / np.bincount(number))


def _record(c: Correction, helps: bool, words: str, before: float, after: float, far: float) -> CorrectionRecord:
    return CorrectionRecord(
        accepted=helps,
        verdict=words,
        validation_rms_before_m=before,
        validation_rms_after_m=after,
        largest_input=far,
        kernel=c.kernel,
        length=c.length,
        inputs=c.input_names,
        ranges=tuple(c.ranges.tolist()),
        markers=c.marker_names,
        states=_rows(c.states),
        basis=_rows(c.basis),
        weights_m=tuple(_rows(term) for term in c.weights),
        covariance_m2=_rows(c.covariance),
    )


def correction_of(record: CorrectionRecord) -> Correction:
    """Return the function that a record holds."""
    arrays = (np.array(v, dtype=np.float64) for v in (record.states, record.basis, record.weights_m, record.covariance_m2))
    states, basis, weights, covariance = arrays
    assert record.kernel is not None and record.length is not None
    return Correction(
        record.kernel, record.length, record.inputs, np.array(record.ranges), record.markers, states, basis, weights, covariance
    )


def _rows(values: FloatArray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(v) for v in row) for row in values)
