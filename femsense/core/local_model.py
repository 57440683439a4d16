"""A local model of ‖r‖²: linear residual, known kinks, and curvature estimated from earlier steps.

Half the second derivative of ‖r‖² is JᵀJ + S with S = Σᵢ rᵢ ∇²rᵢ. Gauss–Newton neglects S. In a curved valley with a large residual S cancels most
of JᵀJ, and Gauss–Newton steps cover a small share of the way; the change of J from one iterate to the next determines S along that step.

Source: Dennis, Gay & Welsch, "An adaptive nonlinear least-squares algorithm" (1981). S is updated and sized as there: among all S that satisfy the
secant condition of the last step it is the one closest to the previous S, in the norm of JᵀJ. (They use the norm of the change of the gradient, which
can be almost zero.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from femsense.core.arrays import BoolArray, FloatArray

WIDTHS = 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-5
"""Widths to which kinks are smoothed in turn, as shares of the distance by which the unsmoothed step passes them."""
TURNS = 4
"""Gauss–Newton steps for each width; evaluating the local model is cheap."""
LEAST = 0.2
"""JᵀJ + S keeps at least this share of JᵀJ in every direction: S is estimated from few steps and may be wrong in other directions."""


@dataclass(frozen=True, eq=False, slots=True)
class Nonsmoothness:
    """Kinks of the residual: r(θ + s) ≈ r + J₀ s + W (max(v + U s, 0) − max(v, 0)).

    Example: a cable does not push, so its tension, the logged value plus a fitted zero, is cut off at 0.
    """

    columns: FloatArray
    """W: derivative of the whitened residual by each value that is cut off at 0, shape (N, g)."""
    value: FloatArray
    """v: the values at θ before the cut-off, shape (g,)."""
    slope: FloatArray
    """U: its derivative by θ, shape (g, p)."""
    counted: BoolArray
    """Whether the Jacobian was computed with the value above the cut-off, shape (g,)."""


@dataclass(frozen=True, eq=False, slots=True)
class _Point:
    """An iterate with its Jacobian."""

    theta: FloatArray
    J: FloatArray
    nonsmooth: Nonsmoothness | None

    def as_counted_at(self, other: _Point) -> FloatArray | None:
        """Return the Jacobian here with the active kinks of another point, so that a jump of the derivative is not taken for curvature;
        None if the points have different kinks."""
        here, there = self.nonsmooth, other.nonsmooth
        if here is None or there is None:
            return self.J if here is there else None
        if here.counted.shape != there.counted.shape:
            return None
        return np.asarray(self.J + (here.columns * (there.counted.astype(float) - here.counted)) @ here.slope)


class Curvature:
    """The estimate of S from the Jacobians of a fit."""

    def __init__(self) -> None:
        self.S: FloatArray | None = None
        """Shape (p, p); None: no estimate yet."""
        self.believed = True
        """Whether it predicted the last step at least as well as the linear model; initially True."""
        self.last: _Point | None = None

    def learn(self, theta: FloatArray, r: FloatArray, J: FloatArray, nonsmooth: Nonsmoothness | None) -> None:
        """Update S from residual and Jacobian at a point of the fit."""
        here, before = _Point(theta, J, nonsmooth), self.last
        if before is not None and np.array_equal(theta, before.theta):
            return
        self.last = here
        J_before = None if before is None else before.as_counted_at(here)
        if before is None or J_before is None:
            return
        step, bend = theta - before.theta, (J - J_before).T @ r
        along = J.T @ (J @ step)
        size = float(along @ step)
        if size == 0.0:
            return
        S = np.zeros((len(step),) * 2) if self.S is None else self.S
        old = float(step @ S @ step)
        S = S if old == 0.0 else S * min(1.0, abs(float(step @ bend) / old))
        missed = bend - S @ step
        outer = np.outer(missed, along) / size
        self.S = S + outer + outer.T - float(step @ missed) / size**2 * np.outer(along, along)

    def judge(self, near: LocalModel, step: FloatArray, gain: float) -> None:
        """Keep using S if it predicts the gain of a step at least as well as the linear model."""
        straight, curved = (abs(near.predicted_gain(step, curved=curved) - gain) for curved in (False, True))
        self.believed = curved <= straight


def with_curvature(J: FloatArray, S: FloatArray, scale: FloatArray) -> FloatArray:
    """Return C with CᵀC = JᵀJ + S, with S bounded so that at least the share LEAST of JᵀJ remains, and zero in the null space of J.

    Arguments:
        J: the Jacobian, shape (N, p).
        S: curvature term, symmetric, shape (p, p).
        scale: norm of each column of J, shape (p,).
    """
    _, size, Vt = np.linalg.svd(J / scale, full_matrices=False)
    seen = size > 1e-9 * size.max()
    root = size[seen, None] * Vt[seen]
    inverse = Vt[seen].T / size[seen]
    share, turn = np.linalg.eigh(inverse.T @ (S / np.outer(scale, scale)) @ inverse)
    return np.asarray(np.sqrt(np.maximum(1.0 + share, LEAST))[:, None] * (turn.T @ root) * scale)


class LocalModel:
    """The local model of ‖r‖² near θ."""

    def __init__(
        self,
        r: FloatArray,
        J: FloatArray,
        nonsmooth: Nonsmoothness | None,
        low: FloatArray,
        high: FloatArray,
        S: FloatArray | None = None,
        *,
        believed: bool = True,
    ) -> None:
        self.nonsmooth, self.low, self.high = nonsmooth, low, high
        self.plain = J if nonsmooth is None else J - (nonsmooth.columns * nonsmooth.counted) @ nonsmooth.slope
        """J₀"""
        self.scale = np.linalg.norm(J, axis=0)
        self.scale[self.scale == 0] = 1.0
        self.r, self.J = r, J
        if nonsmooth is not None:  # sums of squares depend on the R factor alone: far fewer rows
            p, g = len(self.scale), len(nonsmooth.value)
            R = np.asarray(np.linalg.qr(np.column_stack([self.plain, nonsmooth.columns, r]), mode="r"))
            self.J0, self.W, self.r0 = R[:, :p], R[:, p : p + g], R[:, -1]
            self.J = self.plain + (nonsmooth.columns * (nonsmooth.value >= 0)) @ nonsmooth.slope
        self.S, self.curved = np.zeros((len(self.scale),) * 2), S is not None and believed
        if S is not None:
            C = with_curvature(self.J, S, self.scale)
            self.S = C.T @ C - self.J.T @ self.J

    def change(self, step: FloatArray) -> FloatArray:
        """Return the change of the residual by a step, shape (N,)."""
        k = self.nonsmooth
        if k is None:
            return np.asarray(self.J @ step)
        return np.asarray(self.plain @ step + k.columns @ (_cut(k.value + k.slope @ step, 0.0)[0] - _cut(k.value, 0.0)[0]))

    def predicted_gain(self, step: FloatArray, *, curved: bool | None = None) -> float:
        """Return the predicted decrease of the sum of squares by a step, with or without S; by default with S if it is in use."""
        bend = self.bend(step) if curved is None else curved * float(step @ self.S @ step)
        return float(np.sum(self.r**2) - np.sum((self.r + self.change(step)) ** 2)) - bend

    def bend(self, step: FloatArray) -> float:
        """Return the contribution sᵀ S s to the sum of squares; 0 if S is not in use."""
        return float(step @ self.S @ step) if self.curved else 0.0

    def step(self, damping: float) -> FloatArray:
        """Return the step that minimises the sum of squares + damping ‖scale · s‖² within bounds."""
        J, r = self._squares(self.J, self.r, np.zeros(len(self.scale)))
        straight = _bounded_step(J, r, self.scale, damping, self.low, self.high)
        k = self.nonsmooth
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
        """Return an improved step for kinks smoothed to a width, and whether one was found."""
        k = self.nonsmooth
        assert k is not None
        root = np.sqrt(damping) * self.scale
        r = np.concatenate([self._reduced(s, width), root * s])
        J = np.vstack([self.J0 + (self.W * _cut(k.value + k.slope @ s, width)[1]) @ k.slope, np.diag(root)])
        J, r = self._squares(J, r, s)
        turn = _bounded_step(J, r, self.scale, 0.0, self.low - s, self.high - s)
        cost, part = self._cost(s, damping, width), 1.0
        while part > 1e-3:
            new = s + part * turn
            if self._cost(new, damping, width) < cost - 1e-9 * abs(cost):
                return new, True
            part *= 0.5
        return s, False

    def _squares(self, J: FloatArray, r: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return C, c with ‖c + C t‖² = ‖r + J t‖² + (s + t)ᵀ S (s + t) up to a constant."""
        if not self.curved:
            return J, r
        C = with_curvature(J, self.S, self.scale)
        slope = (J.T @ r + self.S @ s) / self.scale
        return C, np.asarray(np.linalg.lstsq((C / self.scale).T, slope, rcond=None)[0])

    def _reduced(self, s: FloatArray, width: float) -> FloatArray:
        k = self.nonsmooth
        assert k is not None
        return np.asarray(self.r0 + self.J0 @ s + self.W @ (_cut(k.value + k.slope @ s, width)[0] - _cut(k.value, width)[0]))

    def _cost(self, s: FloatArray, damping: float, width: float = 0.0) -> float:
        return float(np.sum(self._reduced(s, width) ** 2) + damping * np.sum((self.scale * s) ** 2)) + self.bend(s)


def _cut(value: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """Return max(value, 0), smoothed to a width, and its derivative."""
    length = np.sqrt(value**2 + width**2)
    return 0.5 * (value + length), 0.5 * (1.0 + value / np.maximum(length, 1e-300))


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
