"""Coulomb friction: forces within cones about the inward normals, nearest in the metric of their posterior."""

from __future__ import annotations

import numpy as np
from scipy.optimize import NonlinearConstraint, minimize

from femsense.core.arrays import FloatArray
from femsense.sensing.model import Fit
from femsense.sensing.types import Sensor

SLACK = 1e-9
LEAST = 1e-3
"""Normal force from which the search for the nearest force in the cone starts [N]."""


def within_cones(sensor: Sensor, fit: Fit, axes: FloatArray) -> FloatArray | None:
    """Return the forces (m, 3) [N] within their cones that minimise (f − f₀)ᵀ Σ⁻¹ (f − f₀); None where they lie inside already, or no cone is set.

    Arguments:
        fit: forces f₀ and their covariance Σ.
        axes: outward normal and two tangents of each contact, shape (m, 3, 3).
    """
    mu = sensor.options.friction
    bound = [i for i, c in enumerate(fit.contacts) if not c.pulls and (c.source != "given" or sensor.options.push)]
    if mu is None or not bound:
        return None
    local = np.einsum("mij,mj->mi", axes, fit.forces)
    if all(-mu * local[i, 0] >= np.linalg.norm(local[i, 1:]) - SLACK for i in bound):
        return None
    K = np.linalg.inv(fit.covariance + 1e-12 * np.eye(len(fit.covariance)))
    x0, start = fit.forces.ravel(), fit.forces.copy()
    for i in bound:
        normal = max(-local[i, 0], LEAST)
        size = max(float(np.linalg.norm(local[i, 1:])), 1e-9)
        start[i] = axes[i].T @ np.array([-normal, *(local[i, 1:] * min(1.0, mu * normal / size))])
    scale = 1.0 / max(float(np.linalg.norm(start.ravel() - x0)) ** 2 * float(np.linalg.norm(K)), 1e-9)

    def room(x: FloatArray) -> FloatArray:
        own = np.array([axes[i] @ x[3 * i : 3 * i + 3] for i in bound])
        return np.asarray(-mu * own[:, 0] - np.sqrt((own[:, 1:] ** 2).sum(axis=1) + 1e-12))

    found = minimize(  # type: ignore[call-overload]
        lambda x: float(scale * (x - x0) @ K @ (x - x0)),
        start.ravel(),
        jac=lambda x: np.asarray(2.0 * scale * K @ (x - x0)),
        constraints=NonlinearConstraint(room, 0.0, np.inf),
        method="SLSQP",
        options={"maxiter": 50, "ftol": 1e-9},
    )
    return np.asarray(found.x.reshape(-1, 3))
