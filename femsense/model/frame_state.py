"""The equilibrium of one frame under its inputs, loads and gravity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.model.drive import DrivenRobot, body_in, frame_loads


def solve_frame(
    driven: DrivenRobot,
    frame: int,
    *,
    start: Equilibrium | None = None,
    nodal_forces: FloatArray | None = None,
    options: SolveOptions | None = None,
) -> Equilibrium:
    """Return the equilibrium of one frame.

    Arguments:
        driven: robot and drive.
        frame: index of the frame.
        start: initial guess.
        nodal_forces: forces in addition to the known loads [N], shape (n, 3).
        options: as of `solve_equilibrium`; without them friction has no history.
    """
    drive, body = driven.drive, body_in(driven, frame)
    loads = frame_loads(driven, frame)
    if nodal_forces is not None:
        loads = nodal_forces if loads is None else loads + nodal_forces
    values = {name: float(v) for name, v in zip(body.cable_names, drive.inputs[frame])}
    how = options or SolveOptions()
    if how.before is None:
        how = replace(how, before=tuple(np.zeros(len(c.path)) for c in body.cables))
    tension, held = (values, None) if drive.control == "tension" else (None, values)
    return solve_equilibrium(
        body,
        tension=tension,
        shortening=held,
        pressure=dict(zip(body.chamber_names, drive.pressures[frame].tolist())),
        nodal_forces=loads,
        start=start,
        options=how,
    )


def require_converged(state: Equilibrium, frame: int) -> Equilibrium:
    """Return a converged state. Raises DataError with the frame and the unbalanced force if it did not converge."""
    if not state.converged:
        raise DataError(f"no equilibrium in frame {frame}: {state.status}: {state.advice} (unbalanced {state.residual_n:.2g} N)")
    return state
