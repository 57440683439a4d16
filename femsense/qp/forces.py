"""External forces from the displacements of feature points, with their covariance.

Source: "Calibration and force sensing with an RGB-D camera", section V.B, equations 10–14. The covariance is ours: that of
weighted least squares in the space that the acting constraints leave free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, freeze
from femsense.core.errors import InputError
from femsense.qp.problem import ForceOptions, Problem, build_force_problem, prior_precision
from femsense.qp.solve import Solution, solve

_BLIND = 1e-12  # share of the largest curvature below which a direction counts as unseen


@dataclass(frozen=True, eq=False, slots=True)
class ForceEstimate:
    """Forces, tensions, and how far they can be trusted. Without an answer the numbers are NaN, the standard deviations inf."""

    forces: FloatArray
    """[N], shape [f], in the order of the columns."""
    cable_tensions: FloatArray
    """[N], shape [a]."""
    nuisance: FloatArray
    """Factors of the nuisance columns, shape [k]."""
    covariance: FloatArray
    """Covariance of the forces [N²], shape [f, f]: 0 for a force at an active bound; for a force that no row depends on, inf on the
    diagonal and 0 off the diagonal."""
    std: FloatArray
    """Standard deviation of each force [N], shape [f]."""
    held: BoolArray
    """Whether a force is determined by bounds or constraints alone, shape [f]: its std is then 0, which is no measure of its error."""
    residual: FloatArray
    """Residual of each row: modelled − observed [m], shape [r]."""
    reduced_chi2: float
    """Weighted squares of the residual per degree of freedom, about 1 where std is right; NaN without degrees of freedom."""
    certificate: Solution
    """The answer of the solver with its residuals and status."""

    @property
    def status(self) -> str:
        """`solved`, or the reason of the failure."""
        return str(self.certificate.status)


def estimate_forces(
    W_forces: npt.ArrayLike,
    W_cables: npt.ArrayLike | None,
    free: npt.ArrayLike,
    target: npt.ArrayLike,
    *,
    std: npt.ArrayLike | None = None,
    options: ForceOptions | None = None,
    inflate: bool = False,
    solver: str = "daqp",
    tolerance: float = 1e-7,
) -> ForceEstimate:
    """Return the forces that move the features to where they were seen, with their covariance (equations 10–14).

    With x = (tensions, forces, nuisance), H the curvature of the data and the nuisance priors, P = H + ridge,
    and Z a basis of the directions that equalities and acting inequalities leave free,

        covariance = Z (ZᵀPZ)⁻¹ ZᵀHZ (ZᵀPZ)⁻¹ Zᵀ,   restricted to the forces.

    Arguments:
        W_forces, W_cables, free, target: see `build_force_problem`.
        std: standard deviation of each row [m]: a number or (r,), > 0; inf leaves a row out. Where it is not given, all rows
            count alike and their scatter is estimated from the residual.
        options: inputs, bounds and priors; ridge in 1/N² with std given.
        inflate: multiply the covariance by reduced_chi2 where that is above 1 (std too small by an unknown common factor).
        solver, tolerance: see `solve`.
    Returns:
        ForceEstimate; a problem without an answer is a status in `certificate`.
    Raises:
        InputError: shapes that do not fit, or standard deviations that are not positive.
    """
    known = options or ForceOptions()
    rows = np.shape(np.asarray(free))[0] if np.ndim(free) else 0
    if std is None and (known.nuisance is not None or known.ridge > 0.0):
        raise InputError("priors need the scale of the noise", where="std", found="nuisance or ridge without std", expected="std")
    weights = _row_weights(std, rows)
    problem = build_force_problem(W_forces, W_cables, free, target, weights=weights, options=known)
    solution = solve(problem, solver=solver, tolerance=tolerance)
    blocks = [np.asarray(block, dtype=np.float64) for block in (W_cables, W_forces, known.nuisance) if block is not None]
    W = np.hstack(blocks)
    tensions = 0 if W_cables is None else np.shape(W_cables)[1]
    forces = slice(tensions, tensions + np.shape(W_forces)[1])
    if solution.x is None:
        return _no_estimate(solution, problem.size, forces, len(W))
    residual = W @ solution.x + np.asarray(free, dtype=np.float64) - np.asarray(target, dtype=np.float64)
    prior = np.concatenate([np.zeros(forces.stop), prior_precision(known.nuisance_std, problem.size - forces.stop)])
    Z = _free_directions(problem, solution)
    chi2 = _reduced_chi2(W, weights, residual, prior, solution.x, Z)
    factor = chi2 if std is None else max(chi2, 1.0) if inflate and np.isfinite(chi2) else 1.0
    covariance, held = _covariance(problem.P, W.T @ (weights[:, None] * W) + np.diag(prior), Z, forces)
    covariance = _times(covariance, factor)
    return ForceEstimate(
        forces=freeze(solution.x[forces]),
        cable_tensions=freeze(solution.x[:tensions]),
        nuisance=freeze(solution.x[forces.stop :]),
        covariance=freeze(covariance),
        std=freeze(np.sqrt(np.diag(covariance))),
        held=freeze(held, np.bool_),
        residual=freeze(residual),
        reduced_chi2=chi2,
        certificate=solution,
    )


# --- helpers ----------------------------------------------------------------------------------------------------------


def _row_weights(std: npt.ArrayLike | None, rows: int) -> FloatArray:
    if std is None:
        return np.ones(rows)
    values = np.asarray(std, dtype=np.float64)
    if values.ndim > 1 or values.size not in (1, rows) or not (values > 0.0).all():
        raise InputError(
            "standard deviations that do not fit", where="std", found=values.tolist(), expected=f"a number or ({rows},), > 0"
        )
    return np.asarray(1.0 / np.broadcast_to(values.ravel() if values.ndim else values, (rows,)) ** 2)


def _no_estimate(solution: Solution, size: int, forces: slice, rows: int) -> ForceEstimate:
    count = forces.stop - forces.start
    return ForceEstimate(
        forces=freeze(np.full(count, np.nan)),
        cable_tensions=freeze(np.full(forces.start, np.nan)),
        nuisance=freeze(np.full(size - forces.stop, np.nan)),
        covariance=freeze(np.diag(np.full(count, np.inf))),
        std=freeze(np.full(count, np.inf)),
        held=freeze(np.zeros(count), np.bool_),
        residual=freeze(np.full(rows, np.nan)),
        reduced_chi2=np.nan,
        certificate=solution,
    )


def _free_directions(problem: Problem, solution: Solution) -> FloatArray:
    """Return an orthonormal basis (n, d) of the directions in which no equality and no acting inequality moves.

    Directions are measured in unknowns of unit curvature, then returned in the problem's own units.
    """
    P, q, G, _, A, _, _, _ = problem.parts()
    assert solution.multipliers is not None
    curvature = np.sqrt(np.maximum(np.diag(P), 0.0))
    largest = float(curvature.max(initial=0.0)) or 1.0
    D = 1.0 / np.where(curvature > 1e-12 * largest, curvature, largest)
    acting = D * np.abs(solution.multipliers.z_box)
    lengths = np.linalg.norm(G * D, axis=1)
    pressing = solution.multipliers.z * lengths
    scale = 1e-7 * max(float(np.abs(D * q).max(initial=0.0)), float(acting.max(initial=0.0)), float(pressing.max(initial=0.0)))
    rows = np.vstack([A * D, (G * D)[pressing > scale], np.eye(len(q))[acting > scale]])
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-300)
    if len(rows) == 0:
        return np.asarray(np.diag(D))
    _, values, vectors = np.linalg.svd(rows)
    rank = int((values > 1e-10 * max(float(values.max(initial=0.0)), 1e-300)).sum())
    return np.asarray(D[:, None] * vectors[rank:].T)


def _covariance(P: FloatArray, H: FloatArray, Z: FloatArray, forces: slice) -> tuple[FloatArray, BoolArray]:
    """Return the covariance of the forces (f, f) and which of them no free direction moves (f,)."""
    directions = Z[forces]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(P)[forces], 1e-300))
    held = np.asarray((np.abs(directions) <= 1e-9 * scale[:, None]).all(axis=1))
    values, vectors = np.linalg.eigh(Z.T @ P @ Z) if Z.shape[1] else (np.zeros(0), np.zeros((0, 0)))
    seen = values > _BLIND * max(float(values.max(initial=0.0)), 1e-300)
    basis = Z @ vectors[:, seen] / values[seen]
    half = basis @ (vectors[:, seen].T @ Z.T @ H @ Z @ vectors[:, seen]) @ basis.T
    covariance = 0.5 * (half + half.T)[forces, forces]
    blind = (np.abs(directions @ vectors[:, ~seen]) > 1e-6 * scale[:, None]).any(axis=1)
    covariance[blind, :] = 0.0
    covariance[:, blind] = 0.0
    covariance[blind, blind] = np.inf
    covariance[held, :] = 0.0
    covariance[:, held] = 0.0
    return covariance, held


def _reduced_chi2(
    W: FloatArray, weights: FloatArray, residual: FloatArray, prior: FloatArray, x: FloatArray, Z: FloatArray
) -> float:
    """Return the weighted sum of squares per degree of freedom, each prior being one more row; NaN without degrees of freedom."""
    rows = np.vstack([np.sqrt(weights)[:, None] * W, np.diag(np.sqrt(prior))[prior > 0.0]])
    used = int((weights > 0.0).sum() + (prior > 0.0).sum())
    freedom = used - (int(np.linalg.matrix_rank(rows @ Z)) if Z.shape[1] else 0)
    return float((weights * residual**2).sum() + (prior * x**2).sum()) / freedom if freedom > 0 else float("nan")


def _times(covariance: FloatArray, factor: float) -> FloatArray:
    """Return the covariance times a factor; if the factor is unknown (NaN), the variance of every force that is not held is inf."""
    if np.isfinite(factor):
        return np.where(np.isinf(covariance), covariance, covariance * factor)
    return np.diag(np.where(np.diag(covariance) > 0.0, np.inf, 0.0))
