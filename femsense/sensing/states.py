"""The equilibrium of a frame under its inputs, alone or with forces at some places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.model.frame_state import solve_frame
from femsense.sensing.touches import nodal_forces
from femsense.sensing.types import SensedFrame, Sensor, Touch

EXACT = 1e-9
"""Unbalanced force, relative to all loads, of a state that is a result."""
ROUGH = 1e-6
"""The same of the states on the way to the forces."""


def free_state(sensor: Sensor, k: int, start: Equilibrium | None, before: tuple[FloatArray, ...] | None) -> Equilibrium:
    """Return the state under the inputs alone. Raises DataError."""
    return _solve(sensor, k, None, start, before, False)


def foretold(previous: SensedFrame | None, alone: Equilibrium) -> Equilibrium:
    """Return about the state of a frame: that of the frame before, moved as the inputs alone (`alone`) have moved since; for rays, not for forces."""
    if previous is None or not previous.touches:
        return alone
    return replace(previous.state, positions=previous.state.positions + alone.positions - previous.free_state.positions)


def solve_with(
    sensor: Sensor,
    k: int,
    touches: Sequence[Touch],
    forces: FloatArray,
    start: Equilibrium,
    *,
    before: tuple[FloatArray, ...] | None = None,
    tried: bool = False,
) -> Equilibrium:
    """Return the state of frame k under forces (m, 3) [N] at some places. Raises DataError.

    Arguments:
        start: a state near by.
        before: tensions along the cables until now (friction).
        tried: the state is on the way to the forces: rough, in single precision, and stopped where it is far from its start.
    """
    return _solve(sensor, k, nodal_forces(touches, forces, len(start.positions)), start, before, tried)


def _solve(
    sensor: Sensor,
    k: int,
    loads: FloatArray | None,
    start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None,
    tried: bool,
) -> Equilibrium:
    tolerance = ROUGH if tried else EXACT
    options = SolveOptions(before=before, reuse_factor=start is not None, relative_tolerance=tolerance, rough=tried)
    state = solve_frame(sensor.driven, k, start=start, nodal_forces=loads, options=options)
    if not state.converged:
        raise DataError(f"no equilibrium: {state.status}: {state.advice}")
    return state
