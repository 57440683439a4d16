"""The noise of marker residuals: what is common to a marker, a frame, a sweep and a repeated state, and what is left.

    Σ = s² I + h² [same marker in the same state] + m² [same marker] + f² [same frame] + r² [same sweep]

for each axis alike. The variances come by restricted maximum likelihood (Patterson & Thompson 1971) from the residual that the
richest linear model leaves, so that no effect under test counts as noise. Jitter within a hold is not the noise: a state
that is measured five times repeats its error five times, and the term h² says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

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

    def whitener(self, groups: Groups, error: FloatArray | None = None) -> Whitener:
        """Return what whitens rows with these groups.

        `error` (k, 3, b) are fields [m] that the residual may hold by chance, each with a standard deviation of once its size.
        """
        lower = np.asarray(cholesky(self.covariance(groups), lower=True))
        plain = Whitener(lower, np.zeros((3 * len(lower), 0)), np.zeros(0))
        if error is None:
            return plain
        directions, size, _ = np.linalg.svd(whiten(plain, error), full_matrices=False)
        return Whitener(lower, directions, 1.0 - 1.0 / np.sqrt(1.0 + size**2))

    @property
    def total(self) -> float:
        """Root mean square 3-D noise of a marker [m]."""
        return float(np.sqrt(3.0 * sum(v**2 for v in self.std.values())))


@dataclass(frozen=True, eq=False, slots=True)
class Whitener:
    """A square root of the inverse covariance Σ ⊗ 1₃ + E Eᵀ:  w ↦ (1 − D diag(shrink) Dᵀ) L⁻¹ w."""

    lower: FloatArray
    """Cholesky factor L of Σ, shape (k, k)."""
    directions: FloatArray
    """Left singular vectors D of L⁻¹ E, shape (3k, b)."""
    shrink: FloatArray
    """shape (b,)."""


def whiten(whitener: Whitener, values: FloatArray) -> FloatArray:
    """Return rows (k, 3, …) whitened, flattened to (3k, …)."""
    k = len(values)
    flat = solve_triangular(whitener.lower, values.reshape(k, -1), lower=True)
    rows = np.asarray(flat.reshape(3 * k, *values.shape[2:]))
    if not whitener.shrink.size:
        return rows
    along = np.tensordot(whitener.directions.T, rows, axes=1)
    return np.asarray(rows - np.tensordot(whitener.directions * whitener.shrink, along, axes=1))


MAX_REML_ROWS = 700
"""Rows that the estimate of the noise uses at most; more are thinned out by whole frames."""


def estimate_noise(
    residuals: list[FloatArray], nuisance: list[FloatArray], extra: list[FloatArray], groups: list[Groups]
) -> Noise:
    """Return the components of the noise by restricted maximum likelihood.

    Arguments:
        residuals: of each recording [m], shape (k, 3).
        nuisance: columns of what is fitted, shape (k, 3, p), the same p everywhere.
        extra: columns of what might be in the data besides, shape (k, 3, q), the likeliest first; these count as explained.
        groups: of each recording.
    """
    residuals, nuisance, extra, groups = _thinned(residuals, nuisance, extra, groups)
    names = ["white", *sorted({n for g in groups for n in g.members()})]
    distinct = sum(3 * (int(g.state.max()) + 1) for g in groups)
    basis = _richest(nuisance, extra, distinct)
    scale = float(np.sqrt(np.mean(np.concatenate([r.ravel() for r in residuals]) ** 2))) + FLOOR
    jitter = _jitter(residuals, groups) if "state" in names else 0.0
    lowest, highest = np.log(np.maximum(1e-3 * scale, FLOOR)), np.log(3.0 * scale)
    likelihood = _Likelihood(names, residuals, basis, groups)
    best = None
    for white in {max(jitter, FLOOR), 0.3 * scale, 0.7 * scale}:
        start = np.clip(np.log([white if n == "white" else 0.3 * scale for n in names]), lowest, highest)
        answer = minimize(likelihood, start, jac=True, method="L-BFGS-B", bounds=[(lowest, highest)] * len(names))
        best = answer if best is None or answer.fun < best.fun else best
    assert best is not None
    std = {name: float(v) for name, v in zip(names, np.exp(best.x))}
    std = {name: max(v, FLOOR) if name == "white" else v if v > 2e-2 * scale else 0.0 for name, v in std.items()}
    how = "with repeats" if "state" in names else "no repeated state: assumed from the residual"
    return Noise(std, f"restricted maximum likelihood, {how}")


class _Likelihood:
    """Minus the restricted log-likelihood of log standard deviations, with its gradient.

    2 L = log|V| + log|XᵀV⁻¹X| + rᵀPr,  ∂(2 L)/∂v_i = tr(P V_i) − rᵀP V_i P r,  P = V⁻¹ − V⁻¹X(XᵀV⁻¹X)⁻¹XᵀV⁻¹,  V = Σ v_i V_i, the
    same for each axis and block-diagonal over recordings.
    """

    def __init__(self, names: list[str], residuals: list[FloatArray], basis: list[FloatArray], groups: list[Groups]) -> None:
        self.names, self.residuals, self.basis = names, residuals, basis
        self.parts = [[_pattern(g, name) for name in names] for g in groups]

    def __call__(self, log_std: FloatArray) -> tuple[float, FloatArray]:
        variance = np.exp(2.0 * log_std)
        p = self.basis[0].shape[2]
        normal, right, log_det, own = np.zeros((p, p)), np.zeros(p), 0.0, 0.0
        pieces = []
        for r, X, parts in zip(self.residuals, self.basis, self.parts):
            inverse, log_size = _inverse(sum(v * part for v, part in zip(variance, parts)))
            ViX, Vir = np.einsum("kl,lcp->kcp", inverse, X, optimize=True), inverse @ r
            normal += np.einsum("kcp,kcq->pq", X, ViX, optimize=True)
            right += np.einsum("kcp,kc->p", X, Vir)
            log_det += 3.0 * log_size
            own += float((r * Vir).sum())
            pieces.append((inverse, ViX, Vir, parts))
        factor = cholesky(normal + 1e-12 * np.trace(normal) / max(p, 1) * np.eye(p), lower=True)
        fitted = cho_solve((factor, True), right)
        value = log_det + 2.0 * float(np.log(np.diag(factor)).sum()) + own - float(right @ fitted)
        gradient = np.zeros(len(variance))
        for inverse, ViX, Vir, parts in pieces:
            Pr = Vir - ViX @ fitted
            half = cho_solve((factor, True), ViX.reshape(-1, p).T).T.reshape(ViX.shape)
            inner = np.einsum("kcp,lcp->kl", ViX, half, optimize=True)
            outer = np.einsum("kc,lc->kl", Pr, Pr)
            kernel = 3.0 * inverse - inner - outer
            gradient += [float((kernel * part).sum()) for part in parts]
        return 0.5 * value, np.asarray(gradient * variance)


def _pattern(groups: Groups, name: str) -> FloatArray:
    """Return which rows share a component, shape (k, k)."""
    labels = np.arange(len(groups.marker)) if name == "white" else getattr(groups, name)
    return np.asarray(labels[:, None] == labels[None, :], dtype=float)


def _inverse(matrix: FloatArray) -> tuple[FloatArray, float]:
    """Return the inverse of a positive definite matrix and the logarithm of its determinant."""
    L = cholesky(matrix, lower=True)
    return np.asarray(cho_solve((L, True), np.eye(len(L)))), 2.0 * float(np.log(np.diag(L)).sum())


def _jitter(residuals: list[FloatArray], groups: list[Groups]) -> float:
    """Return the scatter of repeated rows about their mean [m]."""
    above, below = 0.0, 0
    for r, g in zip(residuals, groups):
        count = np.bincount(g.state)
        mean = np.stack([np.bincount(g.state, r[:, c]) for c in range(3)], axis=1) / count[:, None]
        above += float(((r - mean[g.state]) ** 2).sum())
        below += 3 * int((count - 1).sum())
    return float(np.sqrt(above / below)) if below else 0.0


def _thinned(
    residuals: list[FloatArray], nuisance: list[FloatArray], extra: list[FloatArray], groups: list[Groups]
) -> tuple[list[FloatArray], list[FloatArray], list[FloatArray], list[Groups]]:
    step = int(np.ceil(sum(len(r) for r in residuals) / MAX_REML_ROWS))
    if step <= 1:
        return residuals, nuisance, extra, groups
    keep = [g.frame % step == 0 for g in groups]
    thin = [
        Groups(*(np.unique(getattr(g, n)[k], return_inverse=True)[1] for n in ("marker", "frame", "sweep", "state")))
        for g, k in zip(groups, keep)
    ]
    pick = [[a[k] for a, k in zip(arrays, keep)] for arrays in (residuals, nuisance, extra)]
    return pick[0], pick[1], pick[2], thin


def _richest(nuisance: list[FloatArray], extra: list[FloatArray], distinct: int) -> list[FloatArray]:
    """Return an orthonormal basis of the nuisance and of what might be there besides, the first columns of `extra` first.

    The latter take at most a third of the degrees of freedom that the nuisance leaves, so that some are left for the noise.
    """
    Z = _stacked(nuisance)
    U, s, _ = np.linalg.svd(Z, full_matrices=False)
    basis = list(U[:, s > 1e-9 * max(s.max(initial=0.0), 1e-300)].T)
    spare = max((distinct - len(basis)) // 3, 0)
    for column in _stacked(extra).T:
        if spare == 0:
            break
        left = column - np.transpose(basis) @ (np.array(basis) @ column)
        size = float(np.linalg.norm(left))
        if size > 0.02:  # not just what is there already
            basis.append(left / size)
            spare -= 1
    Q = np.transpose(basis)
    spans = np.cumsum([0, *(c.shape[0] * 3 for c in nuisance)])
    return [Q[a:b].reshape((b - a) // 3, 3, -1) for a, b in pairwise(spans)]


def _stacked(columns: list[FloatArray]) -> FloatArray:
    """Return columns of all recordings below each other with unit length, shape (3 Σk, p)."""
    flat = np.vstack([c.reshape(3 * len(c), c.shape[2]) for c in columns])
    norm = np.linalg.norm(flat, axis=0)
    return np.asarray(flat[:, norm > 0] / norm[norm > 0])
