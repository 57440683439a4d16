"""Rows that depend on the poses only (the background), and the linearised evidence of a pose step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.inference.mixture import misfit
from femsense.inference.nuisance import fit_nuisance
from femsense.inference.rows import Rows, stacked
from femsense.sensing.background import off_background
from femsense.sensing.fit import force_of, whitened
from femsense.sensing.model import Fit, Frame, Model

FAR = 0.1
"""Prior σ of a moved pose: in radians, and relative to the body's diagonal."""
OTHER = float(np.log(1e-2))
"""Log odds that a pixel of the background shows another object."""
HUBER = 2.5
"""Whitened residuals of the background beyond this count linearly."""


def far(model: Model) -> FloatArray:
    """Return the standard deviations of (rotation [rad], shift [m]) of poses that have moved, shape (6 v,)."""
    return np.tile(np.repeat([FAR, FAR * model.sensor.size], 3), model.views)


def background_rows(model: Model, frame: Frame) -> Rows | None:
    """Return the rows of the background of a frame, which depend on the poses only; None if no contact-free frame shows enough of it."""
    sensor = model.sensor
    if sensor.background is None or frame.scan is None or not len(frame.scan.far):
        return None
    off, by_pose = off_background(sensor, sensor.background, frame.scan, sensor.calibration.poses)
    told = by_pose.any(axis=1)
    off, by_pose, r = off[told], by_pose[told], int(told.sum())
    zeros = np.zeros((r, 3))
    return Rows(
        off,
        np.ones(r),
        np.full(r, OTHER),
        np.full(r, 1.0 / model.overdispersion),
        np.zeros((r, 3), dtype=np.int64),
        zeros,
        zeros,
        by_pose,
        np.zeros((r, len(model.skin.field))),
        np.zeros((r, model.views)),
        np.zeros(r),
        zeros,
        np.zeros(r, dtype=np.bool_),
    )


def pose_gain(model: Model, best: Fit) -> float:
    """Return by how much pose steps of any size would lower −2 log evidence next to the contacts of a fit, to first order."""
    D = best.D
    scale, at = whitened(model, best, trust=False)
    X, p = np.hstack([D * scale, best.N]), np.append(at, best.eta)
    W, P = best.weight[:, None], best.C[:, : 6 * model.views] * far(model)
    WX, left = X * W, best.left(model.nuisance) * best.rows.std
    S = WX.T @ P
    Y = np.linalg.solve(np.eye(X.shape[1]) + WX.T @ X, np.column_stack([S, WX.T @ left - p]))
    gain = _lowered((P * W).T @ left - S.T @ Y[:, -1], P.T @ (P * W) - S.T @ Y[:, :-1])
    background = background_rows(model, best.frame)
    if background is not None:
        B = background.by_pose * far(model)
        weight = background.share / np.maximum(1.0, np.abs(background.residual) / HUBER)
        WB = B * weight[:, None]
        gain += _lowered(WB.T @ background.residual, WB.T @ B)
    return gain


def cost_of_moving(model: Model, best: Fit, removed: Sequence[int]) -> float:
    """Return the increase of −2 log evidence if poses are free and some contacts of a fit are removed, to first order in all parameters.

    Pixels are reweighted: those that a moved camera does not fit may be assigned to another object.
    """
    D = best.D
    scale, at = whitened(model, best, trust=False)
    kept = np.ones(len(scale), dtype=bool)
    residual = best.left(model.nuisance) * best.rows.std + best.N @ best.eta
    for i in removed:
        kept[5 * i : 5 * i + 5] = False
        own = force_of(i)
        residual = residual + D[:, own] @ (at[own] * scale[own])
    D, at = D[:, kept] * scale[kept], at[kept]
    residual = residual + D @ at
    P = best.C[:, : 6 * model.views] * far(model)
    rows, A = best.rows, np.hstack([best.N, D, P])
    start = np.concatenate([best.eta, at, np.zeros(P.shape[1])])
    background = background_rows(model, best.frame)
    before = best.evidence
    if background is not None:
        B = np.hstack([np.zeros((len(background), best.N.shape[1] + D.shape[1])), background.by_pose * far(model)])
        before += misfit(background.residual / background.std, background.log_other, background.share)[0]
        rows, A = stacked([rows, background]), np.vstack([A, B])
        residual = np.append(residual, background.residual)
    _, phi, weight = fit_nuisance(rows, residual, A, start)
    return phi + float(np.linalg.slogdet(np.eye(A.shape[1]) + (A * weight[:, None]).T @ A)[1]) - before


def _lowered(gradient: FloatArray, curvature: FloatArray) -> float:
    """Return the decrease of −2 log evidence by parameters with unit priors, to second order; gradient (q,), curvature (q, q)."""
    H = np.eye(len(gradient)) + curvature
    return float(gradient @ np.linalg.solve(H, gradient) - np.linalg.slogdet(H)[1])
