"""The F test of lack of fit against pure error, from repeated states."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.data.repeats import repeated_means
from femsense.loop.data.trial import Trial
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.result.evidence import LackOfFit, Tested
from femsense.loop.result.records import Structure
from femsense.model.repeats import LEAST_REPEATS


def tested(trials: list[Trial], residuals: list[FloatArray], fit: JointFit, structure: Structure) -> Tested:
    """Return the tests of the residuals [m], (k, c) per trial, of a fit."""
    return Tested(structure, lack_of_fit(trials, residuals, len(fit.fit.theta)), fit.rms)


def lack_of_fit(trials: list[Trial], residuals: list[FloatArray], parameters: int) -> LackOfFit | None:
    """Return the F test of lack of fit against pure error; None if too few states repeat.

    A repeat is a state reached again from the same previous state. Frames of one stay share their error and are averaged first.
    F = [Σ n c̄² / (cells − parameters)] / [Σ (c − c̄)² / (stays − cells)] over the cells (state, marker); under the null hypothesis
    that the model is complete, F has the F distribution with these degrees of freedom.
    """
    from scipy.stats import f as fisher

    lack, pure, cells, stays = 0.0, 0.0, 0, 0
    for trial, residual in zip(trials, residuals):
        for values in repeated_means(trial, residual):
            mean = values.mean(axis=0)
            lack += len(values) * float(mean @ mean)
            pure += float(((values - mean) ** 2).sum())
            cells, stays = cells + len(mean), stays + len(mean) * len(values)
    own, free = cells - parameters, stays - cells
    if free < LEAST_REPEATS or own < 1 or pure <= 0:
        return None
    ratio = (lack / own) / (pure / free)
    error = float(np.sqrt(max(r.shape[1] for r in residuals) * pure / free))
    return LackOfFit(ratio, float(fisher.sf(ratio, own, free)), own, free, error)
