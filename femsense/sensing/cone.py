"""Projection of fitted forces onto the admissible ones in the metric of the posterior: pushes within Coulomb's cones about the inward
normals, and hanging weights."""

from __future__ import annotations

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize

from femsense.core.arrays import FloatArray
from femsense.sensing.model import Fit
from femsense.sensing.types import Sensor

SLACK = 1e-9
LEAST = 1e-3
"""Normal force of the initial guess [N]."""


def within_cones(sensor: Sensor, fit: Fit, axes: FloatArray) -> FloatArray | None:
    """Return the forces (m, 3) [N] within their cones that minimise (f − f₀)ᵀ Σ⁻¹ (f − f₀); None if f₀ is inside already, or if there is no
    cone.

    |f_t| ≤ −μ f_n for contacts that push; a hanging weight does not pull upwards.

    Arguments:
        fit: forces f₀ and their covariance Σ.
        axes: outward normal, or upward where a weight hangs, and two tangents of each contact, shape (m, 3, 3).
    """
    mu, hangs = sensor.options.friction, np.array([contact.pulls for contact in fit.contacts], dtype=np.bool_)
    pushes = [not c.pulls and mu is not None and (c.source != "given" or sensor.options.push) for c in fit.contacts]
    bound = np.flatnonzero(hangs | np.array(pushes, dtype=np.bool_))
    along, across = np.where(hangs, 1.0, mu or 0.0), np.where(hangs, 0.0, 1.0)
    local = np.einsum("mij,mj->mi", axes, fit.forces)
    if all(-along[i] * local[i, 0] >= across[i] * np.linalg.norm(local[i, 1:]) - SLACK for i in bound):
        return None
    K = np.linalg.inv(fit.covariance + 1e-12 * np.eye(len(fit.covariance)))
    x0, start = fit.forces.ravel(), fit.forces.copy()
    for i in bound:
        normal = max(-local[i, 0], LEAST)
        size = max(across[i] * float(np.linalg.norm(local[i, 1:])), 1e-9)
        start[i] = axes[i].T @ np.array([-normal, *(local[i, 1:] * min(1.0, along[i] * normal / size))])
    scale = 1.0 / max(float(np.linalg.norm(start.ravel() - x0)) ** 2 * float(np.linalg.norm(K)), 1e-9)

    def room(x: FloatArray) -> FloatArray:
        own = np.array([axes[i] @ x[3 * i : 3 * i + 3] for i in bound])
        return np.asarray(-along[bound] * own[:, 0] - across[bound] * np.sqrt((own[:, 1:] ** 2).sum(axis=1) + 1e-12))

    found = minimize(  # type: ignore[call-overload]
        lambda x: float(scale * (x - x0) @ K @ (x - x0)),
        start.ravel(),
        jac=lambda x: np.asarray(2.0 * scale * K @ (x - x0)),
        constraints=NonlinearConstraint(room, 0.0, np.inf),
        method="SLSQP",
        options={"maxiter": 50, "ftol": 1e-9},
    )
    return np.asarray(found.x.reshape(-1, 3)) if found.success else start
