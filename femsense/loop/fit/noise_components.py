"""The noise of marker residuals: components common to a marker, a frame, a sweep and a repeated state, and white noise.

The model (docs/reference/closing-the-loop-rules.md, section 4) is

    Σ = s² I + h² [same marker in the same state] + f² [same frame] + r² [same sweep] + m² [same marker] Gᵢ Gⱼᵀ

The variances are estimated by restricted maximum likelihood (Patterson & Thompson 1971) from the residual of the richest linear model, so that
effects under test do not count as noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.least_squares import basis_of
from femsense.core.parallel import each
from femsense.loop.data.trial import COMPONENTS, Groups, Trial

ROUNDING = 1e-12
"""Directions of the fields with less than this share of the largest square are rounding errors."""
FLOOR = 2e-6
"""Smallest noise of a marker [m]."""
UNTOLD = 5e-4
"""Noise before it is estimated [m]: of a marker along each axis, of clouds along the normal."""


@dataclass(frozen=True, eq=False, slots=True)
class Noise:
    """Standard deviations of the components of the noise [m]."""

    std: dict[str, float]
    """Of markers, along each axis."""
    source: str
    """The source, in words."""
    surface: dict[str, float] = field(default_factory=lambda: {"white": UNTOLD})
    """Of clouds, along the normal."""
    assumed: float | None = None
    """Repeatability of a marker along each axis if it was not measured [m]; None: the white component."""

    def components(self, groups: Groups) -> dict[str, float]:
        """Return the standard deviations of the components of rows with these groups [m]."""
        return self.std if groups.surface is None else self.surface

    def joined(self, estimate: Noise, clouds: bool) -> Noise:
        """Return this noise with an estimate for markers, or for clouds."""
        source = "; ".join(dict.fromkeys(s for s in (self.source, estimate.source) if s))
        return replace(self, source=source, surface=estimate.std) if clouds else replace(self, source=source, std=estimate.std)

    def row_std(self, groups: Groups) -> float:
        """Return the standard deviation of a row with these groups [m]: of a marker coordinate, or of a cloud along the normal."""
        return float(np.sqrt(sum(v**2 for v in self.components(groups).values())))

    def covariance(self, groups: Groups) -> FloatArray:
        """Return the covariance of the rows of one axis [m²], shape (k, k), without the rotating placements."""
        std = self.components(groups)
        sigma = np.eye(len(groups.marker)) * std["white"] ** 2
        for name in COMPONENTS[1:]:
            if std.get(name, 0.0) > 0 and not (name == "marker" and groups.turns is not None):
                sigma += std[name] ** 2 * groups.shared(name)
        return sigma

    def placements(self, groups: Groups) -> FloatArray:
        """Return the fields of misplaced markers [m], scaled to one standard deviation, shape (k, c, b); empty if they do not rotate."""
        fields = groups.placements
        none = np.zeros((len(groups.marker), 3 if groups.surface is None else 1, 0))
        return none if fields is None or not self.std.get("marker", 0.0) else self.std["marker"] * fields

    def plain_whitener(self, groups: Groups) -> Whitener:
        """Return the whitener of rows with these groups, without the rotating placements."""
        return Whitener(_lower(self, groups), np.zeros((0, 0)), np.zeros(0))

    def whitener(self, groups: Groups, error: FloatArray | None = None) -> Whitener:
        """Return the whitener of rows with these groups.

        `error` (k, c, b) are additional random fields [m], each scaled to one standard deviation.
        """
        return _whitener(self, groups, _Same(error))

    def whiteners(self, trials: Sequence[Trial]) -> list[Whitener]:
        """Return the whitener of each trial, with its discretisation error."""
        return [self.whitener(t.groups, t.mesh_error) for t in trials]

    @property
    def total(self) -> float:
        """Root mean square 3-D noise of a marker [m]; with clouds only, that of a cloud along the normal."""
        if not self.std:
            return self.along_normals
        return float(np.sqrt(3.0 * sum(v**2 for v in self.std.values())))

    @property
    def along_normals(self) -> float:
        """Root mean square noise of a cloud along the normal [m]."""
        return float(np.sqrt(sum(v**2 for v in self.surface.values())))


@lru_cache(maxsize=4)
def _lower(noise: Noise, groups: Groups) -> FloatArray:
    """Return the Cholesky factor of the covariance of the rows of one axis [m], shape (k, k); cached, because consecutive fits need the same one."""
    lower = np.asarray(cholesky(noise.covariance(groups), lower=True))
    lower.flags.writeable = False
    return lower


@dataclass(frozen=True, eq=False, slots=True)
class _Same:
    """An array compared by identity, as a key of a cache."""

    array: FloatArray | None

    def __hash__(self) -> int:
        return id(self.array)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.array is other.array


@lru_cache(maxsize=8)
def _whitener(noise: Noise, groups: Groups, error: _Same) -> Whitener:
    """Return the result of `Noise.whitener`; cached, because consecutive fits need the same one."""
    plain, placements = noise.plain_whitener(groups), noise.placements(groups)
    fields = placements if error.array is None else np.concatenate([error.array, placements], axis=2)
    if not fields.shape[2]:
        return plain
    whole = whiten(plain, fields)
    square, turn = np.linalg.eigh(whole.T @ whole)
    seen = square > ROUNDING * square[-1]
    size = np.sqrt(square[seen])
    return Whitener(plain.lower, whole @ (turn[:, seen] / size), 1.0 - 1.0 / np.sqrt(1.0 + size**2))


@dataclass(frozen=True, eq=False, slots=True)
class Whitener:
    """A square root of the inverse covariance Σ ⊗ 1₃ + E Eᵀ:  w ↦ (1 − D diag(shrink) Dᵀ) L⁻¹ w."""

    lower: FloatArray
    """Cholesky factor L of Σ, shape (k, k)."""
    directions: FloatArray
    """Left singular vectors D of L⁻¹ E, shape (c k, b)."""
    shrink: FloatArray
    """shape (b,)."""


def whiten(whitener: Whitener, values: FloatArray) -> FloatArray:
    """Return rows (k, c, …) whitened, flattened to (c k, …)."""
    k, c = values.shape[:2]
    flat = solve_triangular(whitener.lower, values.reshape(k, -1), lower=True, check_finite=False)
    rows = np.asarray(flat.reshape(c * k, *values.shape[2:]))
    if not whitener.shrink.size:
        return rows
    along = np.tensordot(whitener.directions.T, rows, axes=1)
    return np.asarray(rows - np.tensordot(whitener.directions * whitener.shrink, along, axes=1))


NEAR_STD = float(np.log(2.0))
"""Prior of the components of a repeated estimate: a factor of two, as the σ of their logarithm."""
FLAT = 1e-6
"""Relative decrease of the likelihood at which its maximisation ends: 0.01 in a log-likelihood of ten thousand."""
MAX_REML_ROWS = 500
"""Maximum number of rows for the estimate; beyond it whole frames are left out, and points of clouds."""


def estimate_noise(
    residuals: list[FloatArray],
    nuisance: list[FloatArray],
    extra: list[FloatArray],
    groups: list[Groups],
    before: dict[str, float] | None = None,
    most: Mapping[str, float] | None = None,
) -> Noise:
    """Return the components of the noise by restricted maximum likelihood.

    Arguments:
        residuals: residuals of each recording [m], shape (k, c) with k rows: of markers (c = 3) or of clouds (c = 1).
        nuisance: columns of the fitted parameters, shape (k, c, p), the same p everywhere.
        extra: columns of possible effects, shape (k, c, q), the best first; they are projected out.
        groups: groups of rows with common errors (marker, state, frame, sweep) in each recording.
        before: components [m] of an earlier estimate with a smaller model; prior of the new one (a factor of two).
        most: component → its upper bound [m].
    """
    residuals, nuisance, extra, groups = _thinned(residuals, nuisance, extra, groups)
    names = ["white", *sorted({n for g in groups for n in g.members()})]
    distinct = sum(g.observations for g in groups)
    basis = _richest(nuisance, extra, distinct)
    scale = float(np.sqrt(np.mean(np.concatenate([r.ravel() for r in residuals]) ** 2))) + FLOOR
    jitter = _jitter(residuals, groups) if "state" in names else 0.0
    lowest = np.log(np.maximum(1e-3 * scale, FLOOR))
    highest = np.log([max(min(3.0 * scale, (most or {}).get(n, np.inf)), 2.0 * np.exp(lowest)) for n in names])
    bounds = [(lowest, h) for h in highest]
    near = None if before is None else np.log([max(before.get(n, 0.0), np.exp(lowest)) for n in names])
    likelihood = Likelihood(names, residuals, basis, groups, near)

    def from_start(start: FloatArray) -> Any:
        return minimize(
            likelihood, np.clip(start, lowest, highest), jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": FLAT}
        )

    best = min(each(from_start, starting_points(names, scale, jitter, near)), key=lambda answer: answer.fun)
    std = {name: float(v) for name, v in zip(names, np.exp(best.x))}
    std = {name: max(v, FLOOR) if name == "white" else v if v > 2e-2 * scale else 0.0 for name, v in std.items()}
    origin = "from repeated states" if "state" in names else "no repeated state: assumed from the residual"
    return Noise(std, f"restricted maximum likelihood, {origin}")


def starting_points(names: Sequence[str], scale: float, jitter: float, near: FloatArray | None) -> list[FloatArray]:
    """Return starting values of the maximisation: logarithms of standard deviations [m].

    Arguments:
        names: names of the noise components.
        scale: rms of the residuals [m].
        jitter: scatter of repeated states [m], 0 without any.
        near: logarithms of an earlier estimate.
    """
    if near is not None:  # a component estimated as zero has no gradient in its logarithm and would stay zero: raise it once
        return [near, np.maximum(near, np.log(0.3 * scale))]
    whites = {max(jitter, FLOOR), 0.3 * scale, 0.7 * scale}
    return [np.log([w if n == "white" else 0.3 * scale for n in names]) for w in whites]


class Likelihood:
    """Minus the restricted log-likelihood of log standard deviations, with its gradient.

    With V = Σ v_i V_i, the same for each axis and block-diagonal over recordings, and P = V⁻¹ − V⁻¹X(XᵀV⁻¹X)⁻¹XᵀV⁻¹,

        2 L = log|V| + log|XᵀV⁻¹X| + rᵀPr,    ∂(2 L)/∂v_i = tr(P V_i) − rᵀP V_i P r.

    Rotating placements are random effects u in addition to the fixed ones (Henderson 1975): X is extended by their fields and 1/m² is added to
    their part of the normal matrix N. The same expressions hold, plus n log m² in the value, and
    ∂(2 L)/∂m² = n/m² − (tr N⁻¹ᵤᵤ + |û|²)/m⁴.
    """

    def __init__(
        self,
        names: list[str],
        residuals: list[FloatArray],
        basis: list[FloatArray],
        groups: list[Groups],
        near: FloatArray | None = None,
    ) -> None:
        self.names, self.residuals, self.near = names, residuals, near
        placements = [np.zeros((*r.shape, 0)) if g.placements is None else g.placements for g, r in zip(groups, residuals)]
        self.fixed = basis[0].shape[2]
        self.basis = [np.concatenate([X, block], axis=2) for X, block in zip(basis, _beside_each_other(placements))]
        self.placement = names.index("marker") if "marker" in names and self.basis[0].shape[2] > self.fixed else None
        self.parts = [
            [None if i == self.placement and g.turns is not None else g.shared(name) for i, name in enumerate(names)]
            for g in groups
        ]

    def __call__(self, log_std: FloatArray) -> tuple[float, FloatArray]:
        variance = np.exp(2.0 * log_std)
        p, fixed, placement = self.basis[0].shape[2], self.fixed, self.placement
        normal, right, log_det, own = np.zeros((p, p)), np.zeros(p), 0.0, 0.0
        pieces = []
        for r, X, parts in zip(self.residuals, self.basis, self.parts):
            inverse, log_size = _inverse(sum(v * part for v, part in zip(variance, parts) if part is not None))
            ViX, Vir = np.einsum("kl,lcp->kcp", inverse, X, optimize=True), inverse @ r
            normal += np.einsum("kcp,kcq->pq", X, ViX, optimize=True)
            right += np.einsum("kcp,kc->p", X, Vir)
            log_det += r.shape[1] * log_size
            own += float((r * Vir).sum())
            pieces.append((inverse, ViX, Vir, parts))
        normal += 1e-12 * np.trace(normal) / max(p, 1) * np.eye(p)
        if placement is not None:
            normal[fixed:, fixed:] += np.eye(p - fixed) / variance[placement]
            log_det += (p - fixed) * float(np.log(variance[placement]))
        factor = cholesky(normal, lower=True)
        fitted = cho_solve((factor, True), right)
        value = log_det + 2.0 * float(np.log(np.diag(factor)).sum()) + own - float(right @ fitted)
        gradient = np.zeros(len(variance))
        for inverse, ViX, Vir, parts in pieces:
            Pr = Vir - ViX @ fitted
            half = cho_solve((factor, True), ViX.reshape(-1, p).T).T.reshape(ViX.shape)
            inner = np.einsum("kcp,lcp->kl", ViX, half, optimize=True)
            outer = np.einsum("kc,lc->kl", Pr, Pr)
            kernel = Pr.shape[1] * inverse - inner - outer
            gradient += [0.0 if part is None else float((kernel * part).sum()) for part in parts]
        if placement is not None:
            of_placements = cho_solve((factor, True), np.eye(p)[:, fixed:])[fixed:]
            left = float(np.trace(of_placements) + fitted[fixed:] @ fitted[fixed:]) / variance[placement]
            gradient[placement] += (p - fixed - left) / variance[placement]
        gradient = np.asarray(gradient * variance)
        if self.near is None:
            return 0.5 * value, gradient
        off = (log_std - self.near) / NEAR_STD
        return 0.5 * value + 0.5 * float(off @ off), gradient + off / NEAR_STD


def _beside_each_other(blocks: list[FloatArray]) -> list[FloatArray]:
    """Return the columns (k, c, q) of several recordings block-diagonally: each has its own, and zeros in those of the others."""
    ends = np.cumsum([0, *(b.shape[2] for b in blocks)])
    return [np.pad(b, ((0, 0), (0, 0), (a, ends[-1] - a - b.shape[2]))) for b, a in zip(blocks, ends)]


def _inverse(matrix: FloatArray) -> tuple[FloatArray, float]:
    """Return the inverse of a positive definite matrix and the logarithm of its determinant."""
    L = cholesky(matrix, lower=True)
    inverse, failed = dpotri(L, lower=1)
    if failed:
        raise LinAlgError("the covariance is singular")
    return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T), 2.0 * float(np.log(np.diag(L)).sum())


def _jitter(residuals: list[FloatArray], groups: list[Groups]) -> float:
    """Return the scatter of repeated rows about their mean [m]."""
    above, below = 0.0, 0
    for r, g in zip(residuals, groups):
        count = np.bincount(g.state)
        mean = np.stack([np.bincount(g.state, column) for column in r.T], axis=1) / count[:, None]
        above += float(((r - mean[g.state]) ** 2).sum())
        below += r.shape[1] * int((count - 1).sum())
    return float(np.sqrt(above / below)) if below else 0.0


def _thinned(
    residuals: list[FloatArray], nuisance: list[FloatArray], extra: list[FloatArray], groups: list[Groups]
) -> tuple[list[FloatArray], list[FloatArray], list[FloatArray], list[Groups]]:
    step = int(np.ceil(sum(len(r) for r in residuals) / MAX_REML_ROWS))
    if step <= 1:
        return residuals, nuisance, extra, groups
    keep = [_spread_rows(g, step) for g in groups]
    thin = [g.of_rows(k) for g, k in zip(groups, keep)]
    pick = [[a[k] for a, k in zip(arrays, keep)] for arrays in (residuals, nuisance, extra)]
    return pick[0], pick[1], pick[2], thin


def _spread_rows(groups: Groups, step: int) -> BoolArray:
    """Return about every `step`-th row: whole frames, and points of clouds too."""
    if groups.surface is None:
        return np.asarray(groups.frame % step == 0)
    points = int(np.ceil(np.sqrt(step)))
    return np.asarray((groups.frame % int(np.ceil(step / points)) == 0) & (groups.marker % points == 0))


def _richest(nuisance: list[FloatArray], extra: list[FloatArray], distinct: int) -> list[FloatArray]:
    """Return an orthonormal basis of the nuisance columns and of `extra`, in its order.

    `extra` takes at most a third of the remaining degrees of freedom, so that enough are left for the noise.
    """
    basis = list(basis_of(_stacked(nuisance))[0].T)
    spare = max((distinct - len(basis)) // 3, 0)
    for column in _stacked(extra).T:
        if spare == 0:
            break
        left = column - np.transpose(basis) @ (np.array(basis) @ column)
        size = float(np.linalg.norm(left))
        if size > 0.02:  # linearly independent of the basis
            basis.append(left / size)
            spare -= 1
    Q = np.transpose(basis)
    spans = np.cumsum([0, *(c.shape[0] * c.shape[1] for c in nuisance)])
    return [Q[a:b].reshape(*block.shape[:2], len(basis)) for block, (a, b) in zip(nuisance, pairwise(spans))]


def _stacked(columns: list[FloatArray]) -> FloatArray:
    """Return the columns of all recordings stacked, scaled to unit length, shape (c Σk, p)."""
    flat = np.vstack([c.reshape(c.shape[0] * c.shape[1], c.shape[2]) for c in columns])
    norm = np.linalg.norm(flat, axis=0)
    return np.asarray(flat[:, norm > 0] / norm[norm > 0])
