"""Bounded Gauss–Newton with priors, a covariance, and a statement of what the data do not determine."""

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
"""A step that changes the whitened residual by less than this is none."""


NEARLY = 4.0
"""A step is idle that gained less than what counts as a gain where the predicted gain of a whole step was less than so many times
that."""
LITTLE = 2.0
"""A step is the last whose predicted gain was less than so many times what counts as a gain, by a Jacobian of its own;
not in units of the misfit, which may be large because the fit is far from its end."""
LEAST_SHRINKING = 0.25
"""No step is foretold to be shorter than this share of the one before."""
CONVERGED, STOPPED_EARLY = "converged", "stopped early"
MOST_DAMPING = 1e8
AT_NONSMOOTH = 0.2
"""A fit has converged on a bend that is nearer than so many standard errors."""


@dataclass(frozen=True, eq=False, slots=True)
class FitResult:
    """A least-squares estimate."""

    theta: FloatArray
    """Shape (p,)."""
    covariance: FloatArray
    """Of θ for unit residual variance, shape (p, p); infinite variance where the data say nothing."""
    residual: FloatArray
    """Whitened residual, shape (N,)."""
    jacobian: FloatArray
    """Its derivative, shape (N, p); on a bend the mean of both sides that leaves no gradient."""
    cost: tuple[float, ...]
    """Sum of squares after each iteration, the start first."""
    status: str
    """"converged", "iterations", or "stopped early" (see `worth` of `GaussNewtonOptions`)."""
    own: bool = True
    """Whether the Jacobian is that at θ; else that of a step before."""


class Pace:
    """How long steps with a Jacobian of their own are, and how long the next one will be if they go on shrinking; inf:
    not known."""

    def __init__(self) -> None:
        self.last, self.next = np.inf, np.inf

    def took(self, length: float) -> None:
        """Count a step; inf where it was damped."""
        self.next = length * max(length / self.last, LEAST_SHRINKING) if length < self.last < np.inf else np.inf
        self.last = length


def broyden_update(J: FloatArray, step: FloatArray, scale: FloatArray, missed: FloatArray) -> FloatArray:
    """Return the Jacobian that is nearest to J and has what J missed along a step, shape (N, p).

    Arguments:
        J: a Jacobian, shape (N, p).
        step: the step that was taken, shape (p,).
        scale: size of each column, in whose units steps are short or long, shape (p,).
        missed: what the residual changed by beside J step, shape (N,).

    J + missed (D²s)ᵀ / (sᵀD²s), D = diag(scale).  Source: Broyden, "A class of methods for solving nonlinear simultaneous equations" (1965).
    """
    along = scale**2 * step
    size = float(along @ step)
    return J if size == 0.0 else J + np.outer(missed, along / size)


@dataclass(frozen=True, slots=True)
class Learning:
    """How a fit learns from its own steps."""

    update: Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray] = broyden_update
    """J, step, scale, missed → the Jacobian after a step."""
    pace: Callable[[], Pace] = Pace
    """Makes what foretells the length of the next step."""
    curvature: Callable[[], Curvature] = Curvature
    """Makes what knows of second derivatives."""


@dataclass(frozen=True, slots=True)
class GaussNewtonOptions:
    """When a step and a Jacobian serve, and when a fit ends."""

    max_iterations: int = 30
    """Gauss–Newton steps at most."""
    tolerance: float = 1e-10
    """Relative decrease at which it stops [1]."""
    still: float = STILL
    """Length of a step in whitened residual at which it stops, in units of the misfit where that is more than noise."""
    serves: float = 0.0
    """A Jacobian serves for another step where it missed the change of the residual by less than this share of it,
    or by less than what counts as a gain."""
    worth: float = np.inf
    """A fit whose sum of squares stays above this is stopped early:
    where the predicted gain of a step is less than half of what is missing,
    or a borrowed Jacobian says that nothing is left to gain."""
    trusted: float = 0.0
    """A Jacobian that missed less than this share of every step since it was made is believed, too,
    that nothing is left to gain."""
    enough: float = 0.0
    """What counts as a gain in the sum of squares, in units of the misfit where that is more than noise; 0:
    all that `tolerance` says."""
    learning: Learning = field(default_factory=Learning)
    """How it learns from its own steps."""


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
    """Minimise ‖r(θ)‖² within bounds (Levenberg's damping where a plain step does not pay; how the residual bends,
    as far as its Jacobians have shown it, counts while that foretells steps no worse than straight lines do: `core.local_model`).

    A Jacobian that predicted the last step well serves for the next one too;
    the fit ends only where the Jacobian at θ itself says that there is nothing left to gain (or one that is `trusted`), or, where
    what is left is noise, where it would: steps of a Gauss–Newton fit, each with a Jacobian of its own, shrink like a geometric
    series, so that two of them foretell the next. It ends as well where two steps in turn were idle: their predicted gain was
    little and they brought less (`enough`). On a bend there may always be a little to gain. And a step with next to no predicted
    gain by a Jacobian of its own is the last (`LITTLE`), whatever it brings.

    Arguments:
        evaluate: residual and Jacobian; priors are rows of them.
        theta: the start, shape (p,).
        low, high: bounds, shape (p,).
        known: residual and Jacobian at the start, where they are known.
        borrowed: a Jacobian from near the start to begin with.
        nonsmooth: θ → where the residual bends near by, for the Jacobian that was computed last.
        options: when a step serves, and when to end.
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
    idle = 0  # idle steps in turn
    curvature = learning.curvature()
    while steps < rule.max_iterations or not slope.own:
        bends = None if nonsmooth is None else nonsmooth(theta)
        if slope.own:
            curvature.learn(theta, residual, slope.J, bends)
        near = LocalModel(residual, slope.J, bends, low - theta, high - theta, curvature.S, believed=curvature.believed)
        step = near.step(damping)
        change, predicted_sum = near.change(step), near.predicted_gain(step)
        whole = predicted_sum if damping == 0.0 else near.predicted_gain(near.step(0.0))
        error = max(1.0, costs[-1] / max(len(residual), 1)) ** 0.5  # what a standard error is rule.worth where the model misfits
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
            if curvature.believed:  # straight lines may do better
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
    """The Jacobian at hand, and how far it may be believed."""

    J: FloatArray
    own: bool = True
    """Whether it is that at θ."""
    sure: bool | None = True
    """Whether it foretold all steps since it was made; None: it was made elsewhere, and no step has been taken by it."""


def _shorter(near: LocalModel, damping: float, change: FloatArray) -> float:
    """Return the damping that makes a step change the residual by half as much as `change` or less."""
    while damping <= MOST_DAMPING:
        damping = max(10.0 * damping, 1e-4)
        if np.linalg.norm(near.change(near.step(damping))) <= 0.5 * np.linalg.norm(change):
            break
    return damping


def _at_nonsmooth(J: FloatArray, r: FloatArray, nonsmooth: Nonsmoothness) -> FloatArray:
    """Return the derivative that stands for both sides of the bends on which a fit converged:
    the mean of them that leaves no gradient.

    Straight lines of one side alone would go on down where the other side goes up (Clarke's generalised Jacobian has 0 among its
    gradients).
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
    """Return residual and Jacobian to begin with."""
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
    """Return the residual; None where θ cannot be evaluated."""
    try:
        return evaluate(theta, False)[0]
    except DataError:
        return None


def covariance_of(jacobian: FloatArray) -> FloatArray:
    """Return (JᵀJ)⁻¹, with infinite variance along parameters that J does not see."""
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
    """Return an orthonormal basis Q of columns J (N, p), and A with A Qᵀ = J⁺, so that A Aᵀ = (JᵀJ)⁻¹ over the directions that J sees."""
    norm = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    U, s, Vt = np.linalg.svd(columns / norm, full_matrices=False)
    seen = s > max(1e-9 * s.max(initial=0.0), 1e-300)
    return np.asarray(U[:, seen]), np.asarray(Vt[seen].T / s[seen] / norm[:, None])


def beside(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Return what is left of values (N, …) once columns (N, p) explain what they can."""
    Q = basis_of(columns)[0]
    return np.asarray(values - Q @ (Q.T @ values))
