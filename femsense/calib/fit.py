"""Bounded Gauss–Newton with priors, a covariance, and a statement of what the data do not determine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from femsense.arrays import BoolArray, FloatArray, freeze
from femsense.errors import DataError

Evaluate = Callable[[FloatArray, bool], tuple[FloatArray, FloatArray | None]]
"""(θ, with derivative) → whitened residual (N,), Jacobian (N, p) or None. A θ that cannot be evaluated raises DataError."""


STILL = 1e-2
"""A step that changes the whitened residual by less than this is none."""


NEARLY = 4.0
"""A step is idle that gained less than what counts as a gain where a whole step promised less than so many times that."""
LITTLE = 2.0
"""A step is the last that promised less than so many times what counts as a gain, by a Jacobian of its own; not in units of the misfit, which
may be large because the fit is far from its end."""
LEAST_SHRINKING = 0.25
"""No step is foretold to be shorter than this share of the one before."""
CONVERGED, GIVEN_UP = "converged", "given up"
MOST_DAMPING = 1e8
WIDTHS = 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-5
"""How far kinks are rounded, in shares of the way that a plain step goes past them; one after the other."""
TURNS = 4
"""Gauss–Newton steps for each of these, of a problem that costs nothing to evaluate."""
ON_KINK = 0.2
"""A fit rests on a kink that is nearer than so many standard errors."""


@dataclass(frozen=True, eq=False, slots=True)
class Kinks:
    """Where the residual bends, although what makes it bend is known:  r(θ + s) ≈ r + J₀ s + W (max(v + U s, 0) − max(v, 0)).

    A cable that is not pulled does not push, so that the tension that its zero and its log make together ends at 0.
    """

    columns: FloatArray
    """W: change of the whitened residual by each value that is cut off at 0, shape (N, g)."""
    value: FloatArray
    """v: what it would be at θ if it were not cut off, shape (g,)."""
    slope: FloatArray
    """U: its derivative by θ, shape (g, p)."""
    counted: BoolArray
    """Whether the Jacobian counts it as not cut off, shape (g,)."""


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
    """Its derivative, shape (N, p); on a kink the mean of both sides that leaves no gradient."""
    cost: tuple[float, ...]
    """Sum of squares after each iteration, the start first."""
    status: str
    """"converged", "iterations", or "given up" (see `worth` of `gauss_newton`)."""
    own: bool = True
    """Whether the Jacobian is that at θ; else that of a step before."""


def gauss_newton(
    evaluate: Evaluate,
    theta: FloatArray,
    *,
    low: FloatArray | None = None,
    high: FloatArray | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-10,
    still: float = STILL,
    known: tuple[FloatArray, FloatArray | None] | None = None,
    borrowed: FloatArray | None = None,
    serves: float = 0.0,
    worth: float = np.inf,
    trusted: float = 0.0,
    enough: float = 0.0,
    kinks: Callable[[FloatArray], Kinks | None] | None = None,
) -> FitResult:
    """Minimise ‖r(θ)‖² within bounds (Levenberg's damping where a plain step does not pay).

    A Jacobian that predicted the last step well serves for the next one too; the fit ends only where the Jacobian at θ itself says that
    there is nothing left to gain (or one that is `trusted`), or, where what is left is noise, where it would: steps of a Gauss–Newton fit, each
    with a Jacobian of its own, shrink like a geometric series, so that two of them foretell the next. It ends as well where two steps in turn
    were idle, promised little and brought less (`enough`), or one and the next would move by nothing: on a kink there may always be a little to gain. And a step
    that promises next to nothing by a Jacobian of its own is the last (`LITTLE`), whatever it brings.

    Arguments:
        evaluate: residual and Jacobian; priors are rows of them.
        theta: the start, shape (p,).
        low, high: bounds, shape (p,).
        max_iterations: Gauss–Newton steps.
        tolerance: relative decrease at which it stops.
        still: length of a step in whitened residual at which it stops, in units of the misfit where that is more than noise.
        known: residual and Jacobian at the start, where they are known.
        borrowed: a Jacobian from near the start to begin with.
        serves: a Jacobian serves for another step where it missed the change of the residual by less than this share of it, or by less than what
            counts as a gain.
        worth: a fit whose sum of squares stays above this is given up: where a step promises less than half of what is missing, or a
            borrowed Jacobian says that nothing is left to gain.
        trusted: a Jacobian that missed less than this share of every step since it was made is believed, too, that nothing is left to gain.
        enough: what counts as a gain in the sum of squares, in units of the misfit where that is more than noise; 0: all that `tolerance` says.
        kinks: θ → where the residual bends near by, for the Jacobian that was computed last.
    """
    p = len(theta)
    low = np.full(p, -np.inf) if low is None else low
    high = np.full(p, np.inf) if high is None else high
    clipped = np.clip(theta, low, high)
    known = known if np.array_equal(clipped, theta) else None
    theta = clipped
    residual, slope = _first(evaluate, theta, known, borrowed)
    costs = [float(residual @ residual)]
    damping, status, steps, pace = 0.0, "iterations", 0, _Pace()
    idle = 0  # idle steps in turn
    while steps < max_iterations or not slope.own:
        near = _Near(residual, slope.J, None if kinks is None else kinks(theta), low - theta, high - theta)
        step = near.step(damping)
        change, promised = near.change(step), near.promise(step)
        whole = promised if damping == 0.0 else near.promise(near.step(0.0))
        error = max(1.0, costs[-1] / max(len(residual), 1)) ** 0.5  # what a standard error is worth where the model misfits
        gain = enough * error**2
        small = promised <= tolerance * costs[-1] or np.linalg.norm(change) <= still * error
        at_end = not slope.own and (small or steps >= max_iterations)
        if costs[-1] > worth and (at_end or costs[-1] - 2.0 * whole > worth):
            status = GIVEN_UP
            break
        foretold = not slope.own and error == 1.0 and pace.next <= still
        if foretold or idle > 1 or (small and (slope.own or slope.sure or idle)):
            status = CONVERGED
            break
        if at_end:
            residual, slope = _both(evaluate, theta)
            continue
        steps += 1
        tried = _tried(evaluate, theta + step)
        cost = np.inf if tried is None else float(tried @ tried)
        idle = idle + 1 if whole < NEARLY * gain and not costs[-1] - cost >= gain else 0
        last = slope.own and whole < LITTLE * enough
        if tried is None or not cost <= costs[-1] - 1e-4 * promised:
            if not slope.own and idle < 2:
                residual, slope = _both(evaluate, theta)
                continue
            damping = _shorter(near, damping, change)
            if last or damping > MOST_DAMPING:
                status = CONVERGED
                break
            continue
        if slope.own:
            pace.took(float(np.linalg.norm(change)) if damping == 0.0 else np.inf)
        damping = damping / 10.0 if damping > 1e-6 else 0.0
        missed = tried - residual - change
        off, way = float(np.linalg.norm(missed)), float(np.linalg.norm(change))
        theta, residual, slope = theta + step, tried, slope.after(step, near.scale, missed, off < trusted * way)
        ends = idle or last or (error == 1.0 and pace.next <= still)
        if off > max(serves * way, gain**0.5) and not ends:
            residual, slope = _both(evaluate, theta)
        costs.append(float(residual @ residual))
        if last:
            status = CONVERGED
            break
    bends = None if kinks is None or status == GIVEN_UP else kinks(theta)
    jacobian = slope.J if bends is None else _on_kinks(slope.J, residual, bends)
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

    def after(self, step: FloatArray, scale: FloatArray, missed: FloatArray, foretold: bool) -> _Slope:
        """Return it with what it missed along a step."""
        return _Slope(_as_seen(self.J, step, scale, missed), False, foretold and self.sure is not False)


class _Pace:
    """How long steps with a Jacobian of their own are, and how long the next one will be if they go on shrinking; inf: not known."""

    def __init__(self) -> None:
        self.last, self.next = np.inf, np.inf

    def took(self, length: float) -> None:
        """Count a step; inf where it was damped."""
        self.next = length * max(length / self.last, LEAST_SHRINKING) if length < self.last < np.inf else np.inf
        self.last = length


def _as_seen(J: FloatArray, step: FloatArray, scale: FloatArray, missed: FloatArray) -> FloatArray:
    """Return the Jacobian that is nearest to J and has what J missed along a step (Broyden 1965)."""
    along = scale**2 * step
    size = float(along @ step)
    return J if size == 0.0 else J + np.outer(missed, along / size)


def _shorter(near: _Near, damping: float, change: FloatArray) -> float:
    """Return the damping that makes a step change the residual by half as much as `change` or less."""
    while damping <= MOST_DAMPING:
        damping = max(10.0 * damping, 1e-4)
        if np.linalg.norm(near.change(near.step(damping))) <= 0.5 * np.linalg.norm(change):
            break
    return damping


class _Near:
    """What the residual is near θ: linear, but for kinks."""

    def __init__(self, r: FloatArray, J: FloatArray, kinks: Kinks | None, low: FloatArray, high: FloatArray) -> None:
        self.kinks, self.low, self.high = kinks, low, high
        self.plain = J if kinks is None else J - (kinks.columns * kinks.counted) @ kinks.slope
        """J₀"""
        self.scale = np.linalg.norm(J, axis=0)
        self.scale[self.scale == 0] = 1.0
        self.r, self.J = r, J
        if kinks is not None:  # of all rows, these are what sums of squares depend on
            p, g = len(self.scale), len(kinks.value)
            R = np.asarray(np.linalg.qr(np.column_stack([self.plain, kinks.columns, r]), mode="r"))
            self.J0, self.W, self.r0 = R[:, :p], R[:, p : p + g], R[:, -1]
            self.J = self.plain + (kinks.columns * (kinks.value >= 0)) @ kinks.slope

    def change(self, step: FloatArray) -> FloatArray:
        """Return by how much a step changes the residual, shape (N,)."""
        k = self.kinks
        if k is None:
            return np.asarray(self.J @ step)
        return np.asarray(self.plain @ step + k.columns @ (_cut(k.value + k.slope @ step, 0.0)[0] - _cut(k.value, 0.0)[0]))

    def promise(self, step: FloatArray) -> float:
        """Return by how much a step lowers the sum of squares."""
        return float(np.sum(self.r**2) - np.sum((self.r + self.change(step)) ** 2))

    def step(self, damping: float) -> FloatArray:
        """Return the step that minimises the sum of squares + damping ‖scale · s‖² within bounds."""
        straight = _bounded_step(self.J, self.r, self.scale, damping, self.low, self.high)
        k = self.kinks
        if k is None:
            return straight
        best, best_cost = straight, self._cost(straight, damping)
        past = float(np.abs(k.slope @ straight).max(initial=0.0))
        s = np.zeros_like(straight)
        for width in WIDTHS:
            for _ in range(TURNS):
                s, moved = self._turn(s, damping, width * past)
                if not moved:
                    break
            cost = self._cost(s, damping)
            if cost < best_cost:
                best, best_cost = s, cost
        return best

    def _turn(self, s: FloatArray, damping: float, width: float) -> tuple[FloatArray, bool]:
        """Return a better step, and whether there was one, where kinks are rounded to a width."""
        k = self.kinks
        assert k is not None
        root = np.sqrt(damping) * self.scale
        r = np.concatenate([self._reduced(s, width), root * s])
        J = np.vstack([self.J0 + (self.W * _cut(k.value + k.slope @ s, width)[1]) @ k.slope, np.diag(root)])
        turn = _bounded_step(J, r, self.scale, 0.0, self.low - s, self.high - s)
        cost, part = float(r @ r), 1.0
        while part > 1e-3:
            new = s + part * turn
            if float(np.sum(self._reduced(new, width) ** 2) + np.sum((root * new) ** 2)) < cost * (1.0 - 1e-9):
                return new, True
            part *= 0.5
        return s, False

    def _reduced(self, s: FloatArray, width: float) -> FloatArray:
        k = self.kinks
        assert k is not None
        return np.asarray(self.r0 + self.J0 @ s + self.W @ (_cut(k.value + k.slope @ s, width)[0] - _cut(k.value, width)[0]))

    def _cost(self, s: FloatArray, damping: float) -> float:
        return float(np.sum(self._reduced(s, 0.0) ** 2) + damping * np.sum((self.scale * s) ** 2))


def _on_kinks(J: FloatArray, r: FloatArray, kinks: Kinks) -> FloatArray:
    """Return the derivative that stands for both sides of the kinks on which a fit came to rest: the mean of them that leaves no gradient.

    Straight lines of one side alone would go on down where the other side goes up (Clarke's generalised Jacobian has 0 among its gradients).
    """
    spread = np.sqrt(np.maximum(np.einsum("gp,pq,gq->g", kinks.slope, _finite(covariance_of(J)), kinks.slope), 0.0))
    here = np.abs(kinks.value) < ON_KINK * spread
    if not here.any():
        return J
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    counted = kinks.counted.astype(float)
    pull = (kinks.columns[:, here].T @ r)[:, None] * kinks.slope[here] / scale
    gradient = J.T @ r / scale - counted[here] @ pull
    stay = 1e-6 * float(np.linalg.norm(pull)) * np.eye(len(pull))
    A, b = np.vstack([pull.T, stay]), np.concatenate([-gradient, stay @ counted[here]])
    share = counted.copy()
    share[here] = lsq_linear(A, b, bounds=(0.0, 1.0)).x
    return np.asarray(J + (kinks.columns * (share - counted)) @ kinks.slope)


def _finite(covariance: FloatArray) -> FloatArray:
    return np.where(np.isfinite(covariance), covariance, 0.0)


def _cut(value: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Return max(value, 0), rounded to a width, and its derivative."""
    length = np.sqrt(value**2 + width**2)
    return 0.5 * (value + length), 0.5 * (1.0 + value / np.maximum(length, 1e-300))


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


def _bounded_step(
    J: FloatArray, r: FloatArray, scale: FloatArray, damping: float, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Return the step that minimises ‖r + J s‖² + damping ‖scale · s‖² within bounds."""
    p = J.shape[1]
    A = np.vstack([J / scale, np.sqrt(damping) * np.eye(p)]) if damping > 0 else J / scale
    b = np.concatenate([-r, np.zeros(p)]) if damping > 0 else -r
    step = np.linalg.lstsq(A, b, rcond=1e-12)[0] / scale
    if (step >= low).all() and (step <= high).all():
        return np.asarray(step)
    open_low, open_high = np.minimum(low * scale, -1e-15), np.maximum(high * scale, 1e-15)
    bounded = lsq_linear(A, b, bounds=(open_low, open_high), method="bvls", max_iter=10 * p + 50)
    return np.clip(np.asarray(bounded.x) / scale, low, high)


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
