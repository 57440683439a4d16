"""What poses alone move: the background as rows, and by how much a step of the poses would lower Φ."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.inference.rows import Rows
from femsense.sensing.background import look, off_background
from femsense.sensing.fit import contact_columns
from femsense.sensing.model import Fit, Model

FAR = 0.1
"""Prior of a pose that has moved: one standard deviation in radians and in shares of the body's diagonal."""
OTHER = float(np.log(1e-2))
"""Log odds that a pixel of the background shows something new."""
HUBER = 2.5
"""Whitened residuals of the background beyond this count linearly."""


def far(model: Model) -> FloatArray:
    """Return the standard deviations of (rotation [rad], shift [m]) of poses that have moved, shape (6 v,)."""
    return np.tile(np.repeat([FAR, FAR * model.sensor.size], 3), model.views)


def background_rows(model: Model, k: int) -> Rows | None:
    """Return the rows of the background of frame k, which move with the poses alone; None where no contact-free frame shows enough of it."""
    sensor = model.sensor
    if sensor.background is None:
        return None
    glance = look(sensor, k)
    if not len(glance.view):
        return None
    off, by_pose = off_background(sensor, sensor.background, glance, sensor.calibration.poses)
    told = by_pose.any(axis=1)
    off, by_pose, r = off[told], by_pose[told], int(told.sum())
    zeros = np.zeros((r, 3))
    return Rows(
        off, np.ones(r), np.full(r, OTHER), np.full(r, 1.0 / model.overdispersion), np.zeros((r, 3), dtype=np.int64), zeros, zeros, by_pose,
        np.zeros((r, len(model.skin.field))), np.zeros(r), zeros, np.zeros(r, dtype=np.bool_),
    )  # fmt: skip


def pose_gain(model: Model, best: Fit) -> float:
    """Return by how much pose steps of any size would lower Φ next to the contacts of a fit, to first order."""
    J = contact_columns(model, best, best.axes, best.linearised)
    forces, q = J[:, np.arange(J.shape[1]) % 5 < 3], best.N.shape[1]
    beside, W, P = np.hstack([forces, best.N]), best.weight[:, None], best.C[:, : 6 * model.views] * far(model)
    prior = np.diag(np.append(np.zeros(forces.shape[1]), np.ones(q)))
    own = P - beside @ (np.linalg.pinv((beside * W).T @ beside + prior) @ ((beside * W).T @ P))
    gain = _lowered(own, own * W, best.left(model.nuisance) * best.rows.std)
    background = background_rows(model, best.frame.index)
    if background is not None:
        B = background.by_pose * far(model)
        weight = background.share / np.maximum(1.0, np.abs(background.residual) / HUBER)
        gain += _lowered(B, B * weight[:, None], background.residual)
    return gain


def _lowered(A: FloatArray, WA: FloatArray, residual: FloatArray) -> float:
    """Return by how much columns A (r, q) with unit priors lower the weighted sum of squares of a residual."""
    right = WA.T @ residual
    return float(right @ np.linalg.solve(np.eye(A.shape[1]) + WA.T @ A, right))
