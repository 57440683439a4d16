"""Line search of Newton's method on the potential (Armijo). Long steps are first tried with elements that rotate (`rotated_step`)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import Internal, internal
from femsense.fem.body import BodyModel
from femsense.fem.body_parts import Cable
from femsense.fem.cables import segments
from femsense.fem.chambers import chamber_volume
from femsense.fem.newton_equations import NewtonEquations
from femsense.fem.newton_state import Loads, State, drive_compliance, drive_rows, kinematic_rows, travel_of
from femsense.fem.rotated_step import rotated_step

MOST_TRIALS = 25
"""Largest number of step lengths that are tried; each is half of the length before."""
SUFFICIENT = 1e-4
"""A step is accepted if the potential decreases by this share of the decrease that its slope predicts (Armijo)."""


def line_search(
    body: BodyModel,
    loads: Loads,
    state: State,
    here: Internal,
    equations: NewtonEquations,
    du: FloatArray,
    dT: FloatArray,
    *,
    tangent: bool,
) -> Internal | None:
    """Move `state` along a Newton step until the potential decreases sufficiently (Armijo); return the internal forces there,
    or None where no step length does, and `state` stays.

    Active drives enter the merit as an exact penalty ρ |gap| with ρ above their tensions. `tangent`: assemble the tangent stiffness at the
    first trial, which is accepted in most cases.
    """
    active, gap, force = equations.active, equations.gap, equations.force
    free = body.free_map.dofs
    x0, T0 = state.x, state.T
    step = np.zeros(x0.shape)
    step.reshape(-1)[free] = du
    penalty = 2.0 * np.abs(T0[active] + dT) + 1e-3 / equations.lever
    # an active cable with friction is no pure constraint: the friction at its bends is a given force, the tension that is lost there
    lost = np.zeros(len(T0))
    rubs = np.array([(s != 1.0).any() for s in state.shares] + [False] * len(body.chambers), dtype=bool)
    lost[active] = np.where(rubs[active], T0[active] + dT, 0.0)
    base = _merit(body, loads, state, active, here, penalty, lost)
    slope = -float(force @ du)
    if len(active):
        slope = _slope(body, loads, state, active, here, step, lost) - float(penalty @ np.abs(gap))
    # rounding errors of the potential
    noise = 1e-12 * (abs(here.energy) + abs(float((loads.forces * x0).sum())) + float(np.abs(T0) @ loads.lever) * 1e-2 + 1e-12)
    reach, longest = body.reach, float(np.abs(step).max(initial=1e-300))
    length = min(1.0, 0.5 * reach / longest)  # no node moves farther than half of the body's size
    turned = rotated_step(body, x0, length * step) if longest > state.options.curved * reach else None
    for trial in range(MOST_TRIALS):
        state.x = x0 + length * step if turned is None else turned
        state.T = T0.copy()
        state.T[active] = T0[active] + length * dT
        there = internal(body, state.x, tangent=trial == 0 and tangent)
        if np.isfinite(there.energy):
            merit = _merit(body, loads, state, active, there, penalty, lost)
            if merit <= base + SUFFICIENT * length * slope + noise:
                return there
        if turned is None:
            length *= 0.5
        turned = None  # the same length is tried straight next
    state.x, state.T = x0, T0
    return None


def _merit(
    body: BodyModel,
    loads: Loads,
    state: State,
    active: npt.NDArray[np.intp],
    here: Internal,
    penalty: FloatArray,
    lost: FloatArray,
) -> float:
    value = here.energy - float((loads.forces * (state.x - body.mesh.nodes)).sum())
    for i, cable in enumerate(body.cables):
        if not state.active[i] and state.T[i] != 0.0:
            value += state.T[i] * _weighted_length(cable, state.x, state.shares[i])
        if lost[i] != 0.0:
            value += lost[i] * _weighted_length(cable, state.x, state.shares[i] - 1.0)
    for i, chamber in enumerate(body.chambers, len(body.cables)):
        if not state.active[i] and state.T[i] != 0.0:
            value -= state.T[i] * (chamber_volume(chamber, state.x) - chamber_volume(chamber, body.mesh.nodes))
    if len(active):
        stretch = drive_compliance(body)[active]
        gap = loads.target[active] - travel_of(body, state.x)[active] - stretch * state.T[active]
        value += float(penalty @ np.abs(gap)) + 0.5 * float(stretch @ state.T[active] ** 2)
    return value


def _weighted_length(cable: Cable, x: FloatArray, share: FloatArray) -> float:
    return float(share @ segments(cable, x)[1])


def _slope(
    body: BodyModel, loads: Loads, state: State, active: npt.NDArray[np.intp], here: Internal, step: FloatArray, lost: FloatArray
) -> float:
    """Return the derivative of the potential along a step; active drives contribute their friction only."""
    gradient = here.forces - loads.forces
    rows = drive_rows(body, state)
    loose = state.T.copy()
    loose[active] = 0.0
    if not len(rows):
        return float((gradient * step).sum())
    pull = loose @ rows + lost @ (rows - kinematic_rows(body, state, rows))
    return float((gradient * step).sum() - pull @ step.ravel())
