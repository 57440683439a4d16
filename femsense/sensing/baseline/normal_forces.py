"""Normal forces from the displacements of feature points, with their covariance.

Source: "Calibration and force sensing with an RGB-D camera", section V.B, equation 12. The covariance is ours: that of weighted least squares
over the forces that are not held at zero.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.qp.problem import Problem
from femsense.qp.solve import solve

UNSEEN = 1e6
"""Variance of a force that no row determines [N²]."""
_BLIND = 1e-12  # share of the largest curvature below which a direction counts as unseen
_PRESSING = 1e-7  # share of the largest gradient above which a bound acts


def normal_forces(W: FloatArray, moved: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the forces f ≥ 0 that minimise Σ ((W f − moved) / std)², shape (m,) [N], and their covariance, shape (m, m) [N²].

    A force that its bound holds at zero has no variance; one that no row determines has the variance UNSEEN.

    Arguments:
        W: displacement of each row (a feature along its normal) per force [m/N], shape (r, m).
        moved: observed displacement of each row [m], shape (r,).
        std: standard deviation of each row [m], shape (r,).

    Raises:
        DataError: the problem has no answer.
    """
    rows, wanted = W / std[:, None], moved / std
    P, q = rows.T @ rows, -rows.T @ wanted
    answer = solve(Problem(P, q, lb=np.zeros(len(q))))
    if answer.x is None or answer.multipliers is None:
        raise DataError(f"the force problem has no answer: {answer.status}")
    unit = 1.0 / np.sqrt(np.maximum(np.diag(P), _BLIND * np.diag(P).max(initial=1e-300)))  # forces that move the rows alike
    gradient, bound = np.abs(unit * q), np.abs(unit * answer.multipliers.z_box)
    free = np.flatnonzero(bound <= _PRESSING * max(gradient.max(initial=0.0), bound.max(initial=0.0)))
    covariance = np.zeros(P.shape)
    covariance[np.ix_(free, free)] = _inverse(P[np.ix_(free, free)], unit[free])
    return np.asarray(answer.x), covariance


def _inverse(P: FloatArray, unit: FloatArray) -> FloatArray:
    """Return P⁻¹, shape (f, f); UNSEEN on the diagonal of what P does not determine. `unit`: scales in which its diagonal is 1."""
    values, vectors = np.linalg.eigh(unit[:, None] * P * unit)
    seen = values > _BLIND * values.max(initial=0.0)
    inverse = unit[:, None] * (vectors[:, seen] / values[seen]) @ vectors[:, seen].T * unit
    unseen = (np.abs(vectors[:, ~seen]) > 1e-6).any(axis=1)
    inverse[unseen, :], inverse[:, unseen] = 0.0, 0.0
    inverse[unseen, unseen] = UNSEEN
    return np.asarray(inverse)
