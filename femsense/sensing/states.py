"""The equilibrium of a frame under its inputs, alone or with forces at some places."""

from __future__ import annotations

from collections.abc import Sequence

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.model.frame_state import solve_frame
from femsense.sensing.touches import nodal_forces
from femsense.sensing.types import Sensor, Touch

EXACT, ROUGH = 1e-9, 1e-5
"""Unbalanced force relative to all loads: of a result, and of a state on the way."""


def free_state(sensor: Sensor, k: int, start: Equilibrium | None, before: tuple[FloatArray, ...] | None) -> Equilibrium:
    """Return the state of frame k under its inputs alone. Raises DataError.

    Arguments:
        start: a state near by.
        before: tensions along the cables until now (friction).
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
    """Return the state of frame k under its inputs and forces (m, 3) [N] at some places; None where there is none near the start."""
    options = SolveOptions(before=before, reuse_factor=True, relative_tolerance=EXACT if exact else ROUGH, rough=not exact)
    loads = nodal_forces(touches, forces, len(start.positions)) if len(touches) else None
    state = solve_frame(sensor.driven, k, start=start, nodal_forces=loads, options=options)
    return state if state.converged else None
