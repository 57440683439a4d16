# mypy: allow-untyped-decorators
"""Capstan friction: the tension along a cable from its motor to its far end, with stick at each bend."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.kernels import njit
from femsense.fem.body_parts import Cable


def capstan_tensions(cable: Cable, angles: FloatArray, before: FloatArray, motor_tension: float) -> FloatArray:
    """Return the tensions along a cable after a change of the motor's tension: capstan friction with stick (Euler, Eytelwein).

    Outwards from the motor, let T be the tension before a bend of angle θ. The tension behind the bend keeps its previous value (stick)
    if that lies in [T e^(−μθ), T e^(+μθ)], and is moved to the nearest end of this interval (slip) otherwise.

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
