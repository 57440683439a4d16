"""The noise of marker residuals: what is common to a marker, a frame, a sweep and a repeated state, and what is left.

    Σ = s² I + h² [same marker in the same state] + m² [same marker] + f² [same frame] + r² [same sweep]

for each axis alike. The variances come by restricted maximum likelihood (Patterson & Thompson 1971) from the residual that the
richest linear model leaves, so that no effect under test counts as noise. Jitter within a hold is not the noise: a state
that is measured five times repeats its error five times, and the term h² says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

from femsense.arrays import FloatArray, IntArray

COMPONENTS = ("white", "state", "marker", "frame", "sweep")
FLOOR = 2e-6
"""No camera's markers are better than this [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Groups:
    """What the rows of a recording's residual have in common; one number a row, shape (k,)."""

    marker: IntArray
    frame: IntArray
    sweep: IntArray
    state: IntArray
    """Marker within a state (same inputs and loads)."""

    def members(self) -> dict[str, IntArray]:
        """Return the groupings that can be told apart here: each has groups of several rows, and several groups."""
        result: dict[str, IntArray] = {}
        for name in COMPONENTS[1:]:
            labels = getattr(self, name)
            count = np.bincount(labels)
            if (count > 1).any() and len(count) > 1:
                result[name] = labels
        return result


@dataclass(frozen=True, eq=False, slots=True)
class Noise:
    """Standard deviations of the components of the noise [m]."""

    std: dict[str, float]
    source: str
    """Where they come from, in words."""

    def covariance(self, groups: Groups) -> FloatArray:
        """Return the covariance of the rows of one axis [m²], shape (k, k)."""
        k = len(groups.marker)
        sigma = np.eye(k) * self.std["white"] ** 2
        for name in COMPONENTS[1:]:
            if self.std.get(name, 0.0) > 0:
                labels = getattr(groups, name)
                sigma += self.std[name] ** 2 * (labels[:, None] == labels[None, :])
        return sigma

    def whitener(self, groups: Groups) -> FloatArray:
        """Return the lower Cholesky factor L of the covariance, shape (k, k); L⁻¹ whitens."""
        return np.asarray(cholesky(self.covariance(groups), lower=True))

    @property
    def total(self) -> float:
        """Root mean square 3-D noise of a marker [m]."""
        return float(np.sqrt(3.0 * sum(v**2 for v in self.std.values())))


def whiten(factor: FloatArray, values: FloatArray) -> FloatArray:
    """Return L⁻¹ values for rows (k, 3, …), axis by axis, flattened to (3k, …)."""
    k = len(values)
    flat = solve_triangular(factor, values.reshape(k, -1), lower=True)
    return np.asarray(flat.reshape(3 * k, *values.shape[2:]))


def estimate_noise(residuals: list[FloatArray], columns: list[FloatArray], groups: list[Groups]) -> Noise:
    """Return the components of the noise by restricted maximum likelihood.

    Arguments:
        residuals: of each recording [m], shape (k, 3).
        columns: what the richest model can explain, shape (k, 3, p), the same p everywhere.
        groups: of each recording.
    """
    names = ["white", *sorted({n for g in groups for n in g.members()})]
    basis = _compact(columns)
    scale = float(np.sqrt(np.mean(np.concatenate([r.ravel() for r in residuals]) ** 2))) + FLOOR

    def negative_log_likelihood(log_std: FloatArray) -> float:
        std = dict(zip(names, np.exp(log_std)))
        std["white"] = max(std["white"], FLOOR)
        return _reml(Noise(std, ""), residuals, basis, groups)

    start = np.log(np.full(len(names), 0.3 * scale))
    bounds = [(np.log(FLOOR), np.log(30 * scale))] + [(np.log(1e-3 * scale), np.log(30 * scale))] * (len(names) - 1)
    best = minimize(negative_log_likelihood, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60, "eps": 1e-3})
    std = {name: float(v) for name, v in zip(names, np.exp(best.x))}
    std = {name: v if name == "white" or v > 2e-3 * scale else 0.0 for name, v in std.items()}
    repeats = "state" in names
    return Noise(std, "restricted maximum likelihood, with repeats" if repeats else "restricted maximum likelihood; no repeated state: assumed from the residual")


def _reml(noise: Noise, residuals: list[FloatArray], basis: list[FloatArray], groups: list[Groups]) -> float:
    p = basis[0].shape[2]
    log_det, XX, Xr, rr = 0.0, np.zeros((p, p)), np.zeros(p), 0.0
    for r, X, g in zip(residuals, basis, groups):
        try:
            L = noise.whitener(g)
        except np.linalg.LinAlgError:
            return 1e30
        log_det += 3 * 2 * float(np.log(np.diag(L)).sum())
        wr, WX = whiten(L, r), whiten(L, X)
        XX += WX.T @ WX
        Xr += WX.T @ wr
        rr += float(wr @ wr)
    factor = cholesky(XX + 1e-12 * np.trace(XX) / p * np.eye(p), lower=True)
    fit = float(Xr @ cho_solve((factor, True), Xr))
    return 0.5 * (log_det + 2 * float(np.log(np.diag(factor)).sum()) + rr - fit)


def _compact(columns: list[FloatArray]) -> list[FloatArray]:
    """Return an orthonormal basis of the columns, so that near duplicates cost no degrees of freedom; at most a third of the rows."""
    stacked = np.vstack([c.reshape(-1, c.shape[2]) for c in columns])
    norm = np.linalg.norm(stacked, axis=0)
    U, s, _ = np.linalg.svd(stacked[:, norm > 0] / norm[norm > 0], full_matrices=False)
    keep = min(int((s > 0.03 * s[0]).sum()), len(stacked) // 3)
    U = U[:, : max(keep, 1)]
    parts, at = [], 0
    for c in columns:
        parts.append(U[at : at + c.shape[0] * 3].reshape(c.shape[0], 3, -1))
        at += c.shape[0] * 3
    return parts
