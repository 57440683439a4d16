"""Friction of a cable at its bends, in rate form: the state of each bend is the logarithm of its tension ratio.

Behind a bend of angle θ the tension is t_out = t_in e^φ with |φ| ≤ μθ. While the cable sticks, t_out is constant, so that
φ falls as ln t_in rises; at the ends of its interval the cable slides and φ stays (capstan with stick). This is the
estimator's rule in other variables, implemented independently so that truth and estimate share no code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Grip:
    """The friction state of the bends of a cable, from the motor outwards."""

    ratio: FloatArray
    """φ = ln(t_out / t_in) of each bend [1], shape (b,)."""
    inner: FloatArray
    """Tension before each bend in that state [N], shape (b,)."""


def new_grip(bends: int) -> Grip:
    """Return the state of a cable that was never pulled."""
    return Grip(np.zeros(bends), np.zeros(bends))


def pull(grip: Grip, motor_tension: float, bends: FloatArray, coefficient: float) -> tuple[FloatArray, Grip]:
    """Pull a cable at its motor.

    Arguments:
        grip: the friction state.
        motor_tension: [N], ≥ 0.
        bends: angles from the motor outwards [rad], shape (b,).
        coefficient: μ [1].

    Returns:
        the tension behind each bend from the motor outwards [N], shape (b,), and the new friction state.
    """
    ratio, inner, behind = np.zeros(len(bends)), np.zeros(len(bends)), np.zeros(len(bends))
    tension = float(motor_tension)
    for b, angle in enumerate(bends):
        limit = coefficient * float(angle)
        stuck = grip.ratio[b] - _log_growth(float(grip.inner[b]), tension)
        inner[b] = tension
        ratio[b] = min(max(stuck, -limit), limit)
        tension = behind[b] = tension * np.exp(ratio[b])
    return behind, Grip(ratio, inner)


def _log_growth(before: float, after: float) -> float:
    """Return ln(after / before): −∞ or ∞ if one of them is zero, so that the cable slides; 0 if both are."""
    if before > 0 and after > 0:
        return float(np.log(after / before))
    return 0.0 if before == after else float(np.copysign(np.inf, after - before))
