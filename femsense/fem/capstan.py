# mypy: allow-untyped-decorators
"""Capstan friction: what a cable that rubs at its bends hands on from its motor to its far end."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.kernels import njit
from femsense.fem.body_parts import Cable


def capstan_tensions(cable: Cable, angles: FloatArray, before: FloatArray, motor_tension: float) -> FloatArray:
    """Return the tensions along a cable after a change of the motor's tension: capstan friction with stick (Euler, Eytelwein).

    Going outwards from the motor, the tension behind a bend of angle θ stays what it was unless it leaves
    [T e^(−μθ), T e^(+μθ)] of the tension T before the bend; then it is moved to that end.

    Arguments:
        angles: the bends, as `cables.bend_angles` gives them [rad], shape (s,).
        before: the tensions of the segments until now [N], shape (s,).
        motor_tension: [N].
    """
    return np.asarray(_tensions_behind(float(cable.friction), angles, before, float(motor_tension)))


@njit(cache=True)
def _tensions_behind(friction: float, angles: FloatArray, before: FloatArray, motor_tension: float) -> FloatArray:
    tensions = np.empty_like(before)
    inner = motor_tension
    for j in range(len(before) - 1, -1, -1):
        span = np.exp(friction * angles[j])
        tensions[j] = min(max(before[j], inner / span), inner * span)
        inner = tensions[j]
    return tensions
