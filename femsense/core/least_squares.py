"""Bounded Gauss–Newton for whitened residuals, with priors as rows, a covariance, and infinite variances along undetermined directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import lsq_linear

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.core.local_model import Curvature, LocalModel, Nonsmoothness

Evaluate = Callable[[FloatArray, bool], tuple[FloatArray, FloatArray | None]]
"""(θ, with derivative) → whitened residual (N,), Jacobian (N, p) or None. A θ that cannot be evaluated raises DataError."""


STILL = 1e-2
"""The fit has converged when a step changes the whitened residual by less than this norm."""


NEARLY = 4.0
"""A step is idle if its gain is below the threshold `gain` and the predicted gain of the undamped step is below NEARLY × `gain`."""
LITTLE = 2.0
"""A step is the last one if the Jacobian at θ predicts a gain below LITTLE × `enough`. This threshold is not scaled by the misfit, which may be
large because the fit is far from its minimum."""
LEAST_SHRINKING = 0.25
"""Smallest predicted ratio of the lengths of two successive steps."""
CONVERGED, STOPPED_EARLY = "converged", "stopped early"
MOST_DAMPING = 1e8
AT_NONSMOOTH = 0.2
"""θ lies on a kink of the residual if it is within this number of standard errors of it."""


@dataclass(frozen=True, eq=False, slots=True)
class FitResult:
    """A least-squares estimate."""

    theta: FloatArray
    """Shape (p,)."""
    covariance: FloatArray
    """Of θ for unit residual variance, shape (p, p); infinite variance along directions that the data do not determine."""
    residual: FloatArray
    """Whitened residual, shape (N,)."""
    jacobian: FloatArray
    """Its derivative, shape (N, p); on a kink the convex combination of both one-sided derivatives for which the gradient vanishes."""
    cost: tuple[float, ...]
    """Sum of squares after each iteration, the start first."""
    status: str
    """"converged", "iterations", or "stopped early" (see `worth` of `GaussNewtonOptions`)."""
    own: bool = True
    """Whether the Jacobian was computed at θ; otherwise it is that of an earlier step."""


class Pace:
    """Lengths of the last step and, extrapolated as a geometric series, of the next one; inf: unknown.

    Only steps with a Jacobian computed at their own start count."""

    def __init__(self) -> None:
        self.last, self.next = np.inf, np.inf

    def took(self, length: float) -> None:
        """Count a step; inf where it was damped."""
        self.next = length * max(length / self.last, LEAST_SHRINKING) if length < self.last < np.inf else np.inf
        self.last = length


def broyden_update(J: FloatArray, step: FloatArray, scale: FloatArray, missed: FloatArray) -> FloatArray:
    """Return Broyden's update of a Jacobian, shape (N, p): the nearest one that reproduces the change along the last step.

    Arguments:
        J: a Jacobian, shape (N, p).
        step: the step that was taken, shape (p,).
        scale: norm of each column, the unit of its parameter, shape (p,).
        missed: change of the residual minus J step, shape (N,).

    J + missed (D²s)ᵀ / (sᵀD²s), D = diag(scale).  Source: Broyden, "A class of methods for solving nonlinear simultaneous equations" (1965).
    """
    along = scale**2 * step
    size = float(along @ step)
    return J if size == 0.0 else J + np.outer(missed, along / size)


@dataclass(frozen=True, slots=True)
class Learning:
    """How a fit uses the history of its steps."""

    update: Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray] = broyden_update
    """J, step, scale, missed → the Jacobian after a step."""
    pace: Callable[[], Pace] = Pace
    """Factory of the predictor of step lengths."""
    curvature: Callable[[], Curvature] = Curvature
    """Factory of the estimator of second derivatives."""


@dataclass(frozen=True, slots=True)
class GaussNewtonOptions:
    """When a Jacobian is reused, and when a fit ends."""

    max_iterations: int = 30
    """Gauss–Newton steps at most."""
    tolerance: float = 1e-10
    """Relative decrease at which it stops [1]."""
    still: float = STILL
    """Change of the whitened residual at which it stops, in units of the root mean square misfit if that exceeds 1."""
    serves: float = 0.0
    """A Jacobian is reused if its prediction error is below this share of the change of the residual, or below the square root of the gain threshold."""
    worth: float = np.inf
    """Stop early if the sum of squares will stay above this value: the predicted gain is less than half of the excess, or a borrowed
    Jacobian predicts no further gain."""
    trusted: float = 0.0
    """A reused Jacobian may also declare convergence if its relative prediction error stayed below this value in every step since it was computed."""
    enough: float = 0.0
    """Decrease of the sum of squares that counts as a gain, in units of the mean squared misfit if that exceeds 1. 0: `tolerance` alone decides."""
    learning: Learning = field(default_factory=Learning)
    """How it uses the history of its steps."""


def gauss_newton(
    evaluate: Evaluate,
    theta: FloatArray,
    *,
    low: FloatArray | None = None,
    high: FloatArray | None = None,
    known: tuple[FloatArray, FloatArray | None] | None = None,
    borrowed: FloatArray | None = None,
    nonsmooth: Callable[[FloatArray], Nonsmoothness | None] | None = None,
    options: GaussNewtonOptions | None = None,
) -> FitResult:
    """Minimise ‖r(θ)‖² within bounds.

    Gauss–Newton with Levenberg's damping after a failed step. Curvature of the residual, estimated from the Jacobians of earlier steps, is added
    to JᵀJ as long as it predicts steps at least as well as the linear model (`core.local_model`). A Jacobian that predicted the last
    step well is reused, corrected by Broyden's update.

    The fit ends when

    - the Jacobian at θ, or a reused one that is `trusted`, predicts no gain and no change of the residual;
    - the misfit is at noise level and the next step, extrapolated from the last two as a geometric series, would be still;
    - two successive steps were idle (`NEARLY`): on a kink of the residual a small gain is always predicted and never obtained;
    - the Jacobian at θ predicts a gain below `LITTLE` × `enough`: the step is taken, and is the last.

    Arguments:
        evaluate: residual and Jacobian; priors are rows of them.
        theta: initial guess, shape (p,).
        low, high: bounds, shape (p,).
        known: residual and Jacobian at the initial guess, if they are known.
        borrowed: a Jacobian from a nearby θ, used for the first step.
        nonsmooth: θ → the kinks of the residual near θ, for the Jacobian that was computed last.
        options: when a Jacobian is reused, and when to end.

    Raises:
        DataError: the residual cannot be evaluated at the initial guess.
    """
    p = len(theta)
    low = np.full(p, -np.inf) if low is None else low
    high = np.full(p, np.inf) if high is None else high
    clipped = np.clip(theta, low, high)
    known = known if np.array_equal(clipped, theta) else None
    theta = clipped
    residual, slope = _first(evaluate, theta, known, borrowed)
    costs = [float(residual @ residual)]
    rule = options or GaussNewtonOptions()
    learning = rule.learning
    damping, status, steps, pace = 0.0, "iterations", 0, learning.pace()
    idle = 0  # successive idle steps
    curvature = learning.curvature()
    while steps < rule.max_iterations or not slope.own:
        bends = None if nonsmooth is None else nonsmooth(theta)
        if slope.own:
            curvature.learn(theta, residual, slope.J, bends)
        near = LocalModel(residual, slope.J, bends, low - theta, high - theta, curvature.S, believed=curvature.believed)
        step = near.step(damping)
        change, predicted_sum = near.change(step), near.predicted_gain(step)
        whole = predicted_sum if damping == 0.0 else near.predicted_gain(near.step(0.0))
        error = (
            max(1.0, costs[-1] / max(len(residual), 1)) ** 0.5
        )  # rms misfit: the unit of changes that matter, at least that of the noise
        gain = rule.enough * error**2
        small = predicted_sum <= rule.tolerance * costs[-1] or np.linalg.norm(change) <= rule.still * error
        at_end = not slope.own and (small or steps >= rule.max_iterations)
        if costs[-1] > rule.worth and (at_end or costs[-1] - 2.0 * whole > rule.worth):
            status = STOPPED_EARLY
            break
        expected_residual = not slope.own and error == 1.0 and pace.next <= rule.still
        if expected_residual or idle > 1 or (small and (slope.own or slope.sure or idle)):
            status = CONVERGED
            break
        if at_end:
            residual, slope = _both(evaluate, theta)
            continue
        steps += 1
        tried = _tried(evaluate, theta + step)
        cost = np.inf if tried is None else float(tried @ tried)
        idle = idle + 1 if whole < NEARLY * gain and not costs[-1] - cost >= gain else 0
        last = slope.own and whole < LITTLE * rule.enough
        if tried is None or not cost <= costs[-1] - 1e-4 * predicted_sum:
            if not slope.own and idle < 2:
                residual, slope = _both(evaluate, theta)
                continue
            if curvature.believed:  # the linear model may predict better than the curved one
                curvature.believed = False
            else:
                damping = _shorter(near, damping, change)
            if last or damping > MOST_DAMPING:
                status = CONVERGED
                break
            continue
        if slope.own:
            pace.took(float(np.linalg.norm(change)) if damping == 0.0 else np.inf)
        damping = damping / 10.0 if damping > 1e-6 else 0.0
        curvature.judge(near, step, costs[-1] - cost)
        missed = tried - residual - change
        off, way = float(np.linalg.norm(missed)), float(np.linalg.norm(change))
        theta, residual = theta + step, tried
        slope = _Slope(
            learning.update(slope.J, step, near.scale, missed), False, off < rule.trusted * way and slope.sure is not False
        )
        ends = idle or last or (error == 1.0 and pace.next <= rule.still)
        if off > max(rule.serves * way, gain**0.5) and not ends:
            residual, slope = _both(evaluate, theta)
        costs.append(float(residual @ residual))
        if last:
            status = CONVERGED
            break
    bends = None if nonsmooth is None or status == STOPPED_EARLY else nonsmooth(theta)
    jacobian = slope.J if bends is None else _at_nonsmooth(slope.J, residual, bends)
    return FitResult(
        freeze(theta), freeze(covariance_of(jacobian)), freeze(residual), freeze(jacobian), tuple(costs), status, slope.own
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Slope:
    """The current Jacobian and its validity."""

    J: FloatArray
    own: bool = True
    """Whether it was computed at θ."""
    sure: bool | None = True
    """Whether it predicted all steps since it was computed; None: it is borrowed, and no step has tested it."""


def _shorter(near: LocalModel, damping: float, change: FloatArray) -> float:
    """Return a damping for which the step changes the residual by at most half as much as `change`."""
    while damping <= MOST_DAMPING:
        damping = max(10.0 * damping, 1e-4)
        if np.linalg.norm(near.change(near.step(damping))) <= 0.5 * np.linalg.norm(change):
            break
    return damping


def _at_nonsmooth(J: FloatArray, r: FloatArray, nonsmooth: Nonsmoothness) -> FloatArray:
    """Return the element of Clarke's generalised Jacobian for which the gradient vanishes, on kinks at which a fit converged, shape (N, p).

    At such a minimum neither one-sided derivative has a zero gradient: the linear model of one side would predict a further gain.
    """
    spread = np.sqrt(np.maximum(np.einsum("gp,pq,gq->g", nonsmooth.slope, _finite(covariance_of(J)), nonsmooth.slope), 0.0))
    here = np.abs(nonsmooth.value) < AT_NONSMOOTH * spread
    if not here.any():
        return J
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    counted = nonsmooth.counted.astype(float)
    pull = (nonsmooth.columns[:, here].T @ r)[:, None] * nonsmooth.slope[here] / scale
    gradient = J.T @ r / scale - counted[here] @ pull
    stay = 1e-6 * float(np.linalg.norm(pull)) * np.eye(len(pull))
    A, b = np.vstack([pull.T, stay]), np.concatenate([-gradient, stay @ counted[here]])
    share = counted.copy()
    share[here] = lsq_linear(A, b, bounds=(0.0, 1.0)).x
    return np.asarray(J + (nonsmooth.columns * (share - counted)) @ nonsmooth.slope)


def _finite(covariance: FloatArray) -> FloatArray:
    return np.where(np.isfinite(covariance), covariance, 0.0)


def _first(
    evaluate: Evaluate, theta: FloatArray, known: tuple[FloatArray, FloatArray | None] | None, borrowed: FloatArray | None
) -> tuple[FloatArray, _Slope]:
    """Return residual and Jacobian at the initial guess."""
    if known is not None and known[1] is not None:
        return known[0], _Slope(known[1])
    if borrowed is not None:
        return evaluate(theta, False)[0], _Slope(borrowed, own=False, sure=None)
    return _both(evaluate, theta)


def _both(evaluate: Evaluate, theta: FloatArray) -> tuple[FloatArray, _Slope]:
    residual, jacobian = evaluate(theta, True)
    assert jacobian is not None
    return residual, _Slope(jacobian)


def _tried(evaluate: Evaluate, theta: FloatArray) -> FloatArray | None:
    """Return the residual, or None if θ cannot be evaluated."""
    try:
        return evaluate(theta, False)[0]
    except DataError:
        return None


def covariance_of(jacobian: FloatArray) -> FloatArray:
    """Return (JᵀJ)⁻¹, with infinite variance of parameters that J does not determine, shape (p, p)."""
    scale = np.linalg.norm(jacobian, axis=0)
    seen = scale > 0
    covariance = np.full((jacobian.shape[1],) * 2, 0.0)
    covariance[~seen, ~seen] = np.inf
    if not seen.any():
        return covariance
    _, s, Vt = np.linalg.svd(jacobian[:, seen] / scale[seen], full_matrices=False)
    weak = s < 1e-9 * s.max()
    inverse = np.where(weak, 0.0, 1.0 / np.where(weak, 1.0, s))
    part = (Vt.T * inverse**2) @ Vt
    blind = (Vt[weak] ** 2).sum(axis=0) > 1e-6 if weak.any() else np.zeros(len(part), dtype=bool)
    part[blind, blind] = np.inf
    covariance[np.ix_(seen, seen)] = part / np.outer(scale[seen], scale[seen])
    return covariance


def basis_of(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis Q of columns J (N, p), and A with A Qᵀ = J⁺, so that A Aᵀ = (JᵀJ)⁻¹ in the row space of J."""
    norm = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    U, s, Vt = np.linalg.svd(columns / norm, full_matrices=False)
    seen = s > max(1e-9 * s.max(initial=0.0), 1e-300)
    return np.asarray(U[:, seen]), np.asarray(Vt[seen].T / s[seen] / norm[:, None])


def beside(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (N, …) projected onto the orthogonal complement of columns (N, p)."""
    Q = basis_of(columns)[0]
    return np.asarray(values - Q @ (Q.T @ values))
