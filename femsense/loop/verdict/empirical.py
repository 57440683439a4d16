"""An empirical correction, tested on held-out data; it is returned only if it helps there."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.correction import inputs_of, learn_correction, rows_of
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.result.records import CorrectionRecord
from femsense.model.marker_correction import Correction


def judged_correction(data: Data, fitted: FittedModel) -> tuple[CorrectionRecord, Correction | None]:
    """Return the record of an empirical correction, and the correction if the mean square of held-out frames falls by more than its standard error;
    else None."""
    if "markers" not in data.measured:
        return CorrectionRecord(False, "clouds alone do not show where markers are"), None
    learned = learn_correction(data, fitted)
    if learned is None:
        return CorrectionRecord(False, "the residual is not a smooth function of the inputs, or there are too few states"), None
    pairs = [(t, r) for t, r in zip(data.held, fitted.held_residuals) if t.scene.crossings is None]
    after = [r - rows_of(learned, t)[0] for t, r in pairs]
    gains = np.concatenate([_by_frame(t.scene.frame, r, a) for (t, r), a in zip(pairs, after)])
    mean, error = float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))) if len(gains) > 1 else float("inf")
    helps = mean > error
    record = CorrectionRecord(
        accepted=helps,
        verdict="held-out markers are predicted better" if helps else "held-out markers are not predicted significantly better",
        validation_rms_before_m=rms_of([r for _, r in pairs]),
        validation_rms_after_m=rms_of(after),
        largest_input=float(np.max([np.abs(inputs_of(t) / learned.ranges).max() for t, _ in pairs])),
        kernel=learned.kernel,
        length=learned.length,
        terms=learned.terms,
        noise_m=learned.noise,
    )
    return record, learned if helps else None


def _by_frame(frame: IntArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the decrease of the mean square of each frame [m²]."""
    number = np.unique(frame, return_inverse=True)[1]
    fall = (before**2).sum(axis=1) - (after**2).sum(axis=1)
    return np.asarray(np.bincount(number, fall) / np.bincount(number))
