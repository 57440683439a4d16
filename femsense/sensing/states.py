"""The equilibrium of a frame under its inputs, without or with contact forces."""

from __future__ import annotations

from collections.abc import Sequence

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.model.frame_state import solve_frame
from femsense.sensing.touches import nodal_forces
from femsense.sensing.types import Sensor, Touch

EXACT, ROUGH = 1e-9, 1e-5
"""Equilibrium residual relative to all loads: of a result, and of an intermediate state."""


def free_state(sensor: Sensor, k: int, start: Equilibrium | None, before: tuple[FloatArray, ...] | None) -> Equilibrium:
    """Return the predicted state of frame k: the equilibrium under its inputs without contacts. Raises DataError.

    Arguments:
        start: an initial guess.
        before: previous tensions along the cables (friction).
    """
    options = SolveOptions(before=before, reuse_factor=start is not None, relative_tolerance=EXACT)
    state = solve_frame(sensor.driven, k, start=start, options=options)
    if not state.converged:
        raise DataError(f"no equilibrium under the inputs: {state.status}: {state.advice}")
    return state


def loaded_state(
    sensor: Sensor,
    k: int,
    touches: Sequence[Touch],
    forces: FloatArray,
    start: Equilibrium,
    before: tuple[FloatArray, ...] | None,
    *,
    exact: bool = False,
) -> Equilibrium | None:
    """Return the equilibrium of frame k under its inputs and contact forces (m, 3) [N]; None if none is found from the start."""
    options = SolveOptions(before=before, reuse_factor=True, relative_tolerance=EXACT if exact else ROUGH, rough=not exact)
    loads = nodal_forces(touches, forces, len(start.positions)) if len(touches) else None
    state = solve_frame(sensor.driven, k, start=start, nodal_forces=loads, options=options)
    return state if state.converged else None
