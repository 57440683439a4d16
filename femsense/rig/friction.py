"""Friction of a cable at its bends, in rate form: what each bend remembers is the logarithm of its tension ratio.

Behind a bend of angle θ the tension is t_out = t_in e^φ with |φ| ≤ μθ. As long as the cable sticks there, t_out stays, so
that φ falls as ln t_in rises; where φ would leave its interval the cable slides and φ stays at the end (capstan with
stick). This is the estimator's rule in other variables, written apart from it so that truth and estimate share no code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Grip:
    """What the bends of a cable remember, from the motor outwards."""

    ratio: FloatArray
    """φ = ln(t_out / t_in) of each bend [1], shape (b,)."""
    inner: FloatArray
    """Tension before each bend when that was [N], shape (b,)."""


def new_grip(bends: int) -> Grip:
    """Return the memory of a cable that has never been pulled."""
    return Grip(np.zeros(bends), np.zeros(bends))


def pull(grip: Grip, motor_tension: float, bends: FloatArray, coefficient: float) -> tuple[FloatArray, Grip]:
    """Pull a cable at its motor.

    Arguments:
        grip: what the bends remember.
        motor_tension: [N], ≥ 0.
        bends: angles from the motor outwards [rad], shape (b,).
        coefficient: μ [1].

    Returns:
        the tension behind each bend from the motor outwards [N], shape (b,), and what the bends remember then.
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
    """Return ln(after / before); a cable that comes from rest slides outwards, one that goes to rest slides back."""
    if before > 0 and after > 0:
        return float(np.log(after / before))
    return 0.0 if before == after else float(np.copysign(np.inf, after - before))
