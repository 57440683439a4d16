"""Leave-one-sweep-out cross-validation of a fitted model, linearised, without refitting.

At the optimum of a fit linearised in its parameters, the rows b of a sweep that is left out are predicted with the error (1 − H_bb)⁻¹ r_b,
with covariance (1 − H_bb)⁻¹, H = J (JᵀJ)⁻¹ Jᵀ (Cook & Weisberg 1982). Twice the log predictive density is then
log|1 − H_bb| − r_bᵀ (1 − H_bb)⁻¹ r_b + const.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import IntArray
from femsense.core.least_squares import basis_of
from femsense.loop.data.trial import Trial, numbers_of
from femsense.loop.fit.joint_fit import JointFit

LEAST_SWEEPS = 3
"""Minimum number of sweeps for a standard error."""
OPEN = 1e-8
"""Smallest eigenvalue of 1 − H_bb: the share of the information on a direction that the other sweeps provide. Below it the direction is not predicted."""


def sweeps_predicted(trials: list[Trial], before: JointFit, after: JointFit) -> tuple[float, float]:
    """Return the gain in twice the log predictive density, summed over left-out sweeps, and the standard error of that sum.

    The standard error is infinite for fewer than LEAST_SWEEPS sweeps.
    """
    rows = sweep_rows(trials, before)
    gains = np.array([_density(after, r) - _density(before, r) for r in rows])
    if len(gains) < LEAST_SWEEPS:
        return float(gains.sum()), float("inf")
    return float(gains.sum()), float(np.sqrt(len(gains)) * gains.std(ddof=1))


def sweep_rows(trials: list[Trial], fit: JointFit) -> list[IntArray]:
    """Return the rows of the whitened residual of each sweep of each recording, markers and clouds together."""
    found: dict[tuple[int, int], list[IntArray]] = {}
    at = 0
    for number, trial, jet in zip(numbers_of(trials), trials, fit.jets):
        sweep = np.repeat(trial.groups.sweep, jet.residual.shape[1])
        for s in np.unique(sweep):
            found.setdefault((number, int(s)), []).append(at + np.flatnonzero(sweep == s))
        at += len(sweep) + jet.rest.size + 6 * len(trial.poses)
    return [np.concatenate(rows) for rows in found.values()]


def _density(fit: JointFit, rows: IntArray) -> float:
    """Return twice the log predictive density of left-out rows, up to a constant."""
    J, r = np.asarray(fit.fit.jacobian), np.asarray(fit.fit.residual)
    B = J[rows] @ basis_of(J)[1]  # H_bb = B Bᵀ
    inner = np.eye(B.shape[1]) - B.T @ B
    values, vectors = np.linalg.eigh(inner)
    mixed = vectors.T @ (B.T @ r[rows])
    mixed[values < OPEN] = 0.0  # only the left-out rows determine this direction: they would fit any value
    values = np.maximum(values, OPEN)
    return float(np.log(values).sum() - r[rows] @ r[rows] - (mixed**2 / values).sum())
