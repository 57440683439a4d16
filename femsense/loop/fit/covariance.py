"""Standard deviations of fitted values, where (JᵀJ)⁻¹ is too optimistic.

* If the residual exceeds the noise, the weights were too large: all variances are multiplied by the ratio of mean squares (Birge 1932).
* If sweeps disagree by more than their noise, their separate gradients show it (cluster-robust covariance with half leverage: Bell &
  McCaffrey 2002).
* A time or a place that was selected from a few seeds and held fixed during the fit is uncertain.
* The magnitude of gravity is known, so that its direction lies on a sphere. If the data determine one component only, the tangent plane
  understates the others, which may lie anywhere on a circle. The second moment about the estimate is therefore computed over the sphere,
  weighted by the likelihood.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.least_squares import basis_of, covariance_of
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import Trial
from femsense.loop.fit.cross_validation import LEAST_SWEEPS, sweep_rows
from femsense.loop.fit.fitted_model import FittedModel, terms_of
from femsense.loop.fit.joint_fit import JointFit, JointProblem, Prior
from femsense.loop.fit.noise_components import NEAR_STD, Noise
from femsense.model.effects.base import KnownLength, known_length

RINGS, SPOKES = 160, 48
"""Directions of the quadrature: rings about the estimate, denser close to it, and points on each ring."""


def parameter_std(data: Data, fitted: FittedModel, noise: Noise, seed_std: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """Return the standard deviations of the coordinates of each effect.

    Arguments:
        data, fitted, noise: data, model and noise of the final fit.
        seed_std: effect → scatter of its coordinates over seeds that fit equally well.
    """
    own = fitted.fit.own
    std = np.maximum.reduce(
        [coordinate_std(fitted.fit, data.train, noise), std_by_sweeps(data, fitted)[own:], _with_open_seeds(data, fitted, noise)]
    )
    result = dict[str, FloatArray]()
    for effect, _, _, span in terms_of(fitted.fit):
        part = std[span]
        extra = np.zeros(len(part))
        known = seed_std.get(effect.name, extra)
        extra[: len(known)] = known[: len(part)]
        result[effect.name] = np.hypot(part, extra)
    return result


def coordinate_std(fit: JointFit, trials: list[Trial], noise: Noise) -> FloatArray:
    """Return the standard deviations of the coordinates of a hypothesis, shape (p,)."""
    growth = misfit(fit, trials, noise)
    std = growth * fit.std
    vector = known_length(fit.hypothesis.parameters)
    if vector is None or vector[0].sum() != 3 or np.linalg.norm(fit.coordinates[vector[0]]) < 1e-3:
        return std
    mask, length = vector
    sphere = _over_the_sphere(fit, np.flatnonzero(mask), length, growth)
    return np.where(mask, sphere, np.maximum(std, sphere))


def misfit(fit: JointFit, trials: list[Trial], noise: Noise) -> float:
    """Return the ratio of the residual to the noise, √(χ²/ν) ≥ 1.

    States that repeat count once. With n state means r̄ of markers in three axes (of clouds along normals) and p parameters, it is √(Σ|r̄|² / (n − p) / σ²).
    """
    square, count, expected = 0.0, 0, 0.0
    for trial, jet in zip(trials, fit.jets):
        state = trial.groups.state
        size = np.bincount(state)
        axes, std = jet.residual.shape[1], noise.components(trial.groups)
        means = np.stack([np.bincount(state, column) for column in jet.residual.T], axis=1) / size[:, None]
        square, count = square + float((means**2).sum()), count + means.size
        if trial.mesh_error is not None:
            expected += float((trial.mesh_error**2).sum()) / len(state) * len(size)
        expected += axes * float((_variance(std) + std["white"] ** 2 / size).sum())
    freedom = count - len(fit.fit.theta)
    if freedom < 1 or expected <= 0.0:
        return 1.0
    return max(1.0, float(np.sqrt(square / expected * count / freedom)))


def _variance(std: dict[str, float]) -> float:
    return sum(v**2 for name, v in std.items() if name != "white")


def _over_the_sphere(fit: JointFit, at: IntArray, length: KnownLength, growth: float) -> FloatArray:
    """Return the rms deviation from the estimate, when a vector of known length moves over its sphere and the others are refitted, shape (p,)."""
    rows = np.asarray(fit.fit.jacobian)[:-1] / growth  # without the last row, the prior of the length
    residual = np.asarray(fit.fit.residual)[:-1] / growth
    normal, slope = rows.T @ rows, rows.T @ residual
    own = np.asarray(at) + fit.own
    rest = np.setdiff1d(np.arange(len(normal)), own)
    inverse = np.linalg.pinv(normal[np.ix_(rest, rest)], rcond=1e-12, hermitian=True)
    gain = inverse @ normal[np.ix_(rest, own)]
    inner = normal[np.ix_(own, own)] - normal[np.ix_(own, rest)] @ gain
    pull = slope[own] - gain.T @ slope[rest]
    towards, area = _directions(np.asarray(fit.coordinates)[at])
    moves = length.value * towards - np.asarray(fit.coordinates)[at]
    # the length along each direction is Gaussian: curvature, slope, and χ² at its optimum
    curve = np.einsum("ki,ij,kj->k", towards, inner, towards) + 1.0 / length.std**2
    rise = np.einsum("ki,ki->k", towards, moves @ inner + pull)
    chi2 = np.einsum("ki,ki->k", moves @ inner + 2.0 * pull, moves) - rise**2 / curve
    weight = area * np.exp(-0.5 * (chi2 - chi2.min())) / np.sqrt(curve)
    weight /= weight.sum()
    moves = moves - (rise / curve)[:, None] * towards
    square = np.zeros(len(normal))
    square[own] = weight @ (moves**2 + towards**2 / curve[:, None])
    followers = -(moves @ gain.T) - inverse @ slope[rest]
    square[rest] = np.diag(inverse) + weight @ (followers**2 + (towards @ gain.T) ** 2 / curve[:, None])
    return np.sqrt(square)[fit.own :]


def _directions(estimate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors over the sphere (k, 3), dense about an estimate, with their areas (k,)."""
    axis = estimate / np.linalg.norm(estimate)
    side = np.linalg.svd(axis[None])[2][1:]
    edge = np.pi * np.linspace(0.0, 1.0, RINGS + 1) ** 3
    ring, turn = 0.5 * (edge[1:] + edge[:-1]), 2.0 * np.pi * np.arange(SPOKES) / SPOKES
    around = np.cos(turn)[:, None] * side[0] + np.sin(turn)[:, None] * side[1]
    directions = np.cos(ring)[:, None, None] * axis + np.sin(ring)[:, None, None] * around
    return directions.reshape(-1, 3), np.repeat(np.sin(ring) * np.diff(edge), SPOKES)


def std_by_sweeps(data: Data, fitted: FittedModel) -> FloatArray:
    """Return the cluster-robust standard deviations of all parameters, with sweeps as clusters, shape (p,); zero for too few sweeps."""
    J, r = np.asarray(fitted.fit.fit.jacobian), np.asarray(fitted.fit.fit.residual)
    sweeps = sweep_rows(data.train, fitted.fit)
    if len(sweeps) < LEAST_SWEEPS:
        return np.zeros(J.shape[1])
    A = basis_of(J)[1]
    pulls = []
    for rows in sweeps:
        U, s, _ = np.linalg.svd(J[rows] @ A, full_matrices=False)
        along = U.T @ r[rows]
        freed = r[rows] + U @ ((1.0 / np.sqrt(np.maximum(1.0 - s**2, 0.05)) - 1.0) * along)
        pulls.append(A @ (A.T @ (J[rows].T @ freed)))
    return np.asarray(np.sqrt(np.sum(np.square(pulls), axis=0)))


def _with_open_seeds(data: Data, fitted: FittedModel, noise: Noise) -> FloatArray:
    """Return the standard deviations of the coordinates if the selected numbers of the seeds are fitted too, shape (p,)."""
    hypothesis = fitted.fit.hypothesis
    terms, null, moving, known = [], [], [], []
    for effect, seed, parameters, span in terms_of(fitted.fit):
        held = {p.key for p in parameters}
        more = tuple(p for p in effect.polish(data.robot, data.control, seed) if p.key not in held)
        terms.append((effect, seed, (*parameters, *more)))
        null += [*fitted.fit.coordinates[span], *(p.null for p in more)]
        moving += [True] * len(parameters) + [False] * len(more)
        known += [min(p.known, NEAR_STD) for p in (*parameters, *more)]
    mask = np.array(moving, dtype=bool)
    if mask.all():
        return np.zeros(len(fitted.fit.coordinates))
    mean, std = np.array(null), np.array(known)
    mean[mask], std[mask] = fitted.fit.prior.mean, fitted.fit.prior.std
    wider = replace(hypothesis, terms=tuple(terms))
    problem = JointProblem(wider, Prior(mean, std), data.train, noise.whiteners(data.train), data.placement_std)
    theta = np.concatenate([fitted.fit.fit.theta[: fitted.fit.own], null])
    jacobian = problem.evaluate(theta, True)[1]
    assert jacobian is not None
    variance = np.diag(covariance_of(jacobian))[fitted.fit.own :]
    return np.asarray(np.sqrt(np.maximum(variance[mask], 0.0)))
