"""How a body answers near a state to small forces, to its modulus and to its pulls; lent to states so near that it hardly differs."""

from __future__ import annotations

import numpy as np

from femsense.fem.compliance import tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.sensing.nuisance import sag_at
from femsense.sensing.types import Response, Sensor

LENT = 1e-4
"""A response serves for states whose nodes are nearer than this share of the body's diagonal. What the modulus moves is then off by less than the
same share of it, and the misfit by less than one; at 3e-3 it was off by 24, and steps were refused that were good."""


def response_at(sensor: Sensor, state: Equilibrium, near: Response | None = None) -> Response:
    """Return the response at a state, or the one at hand where that was made near by."""
    if near is not None and np.abs(near.positions - state.positions).max() < LENT * sensor.size:
        return near
    tangent = tangent_at(sensor.robot.body, state)
    return Response(tangent, sag_at(sensor, state, tangent), state.positions)
