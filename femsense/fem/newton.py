"""Newton's method with the exact tangent at one load, with a factor that is kept as long as it converges fast enough.

`newton` solves for a fixed active set: the held drives whose imposed travels are constraints (`State.active`). `settle` repeats it until no
active cable pushes, no slack cable is longer than its imposed travel allows, and the tensions along the cables obey friction.

`State.borrowed` says that the factor was made at another state. It is set by whoever passes such a factor on (a solve that starts from a
solved state, and `settle` after a change of friction), and reset when `FactorKeeper` makes a new one.
"""

from __future__ import annotations

import numpy as np

from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.line_search import line_search
from femsense.fem.newton_equations import equations_at
from femsense.fem.newton_state import Loads, SolveStatus, State
from femsense.fem.slack_and_friction import release_one, update_active_set, update_friction
from femsense.fem.stiffness_factor import ARRIVED, FactorKeeper

FOLLOW_FRICTION = 25
"""Newton steps in which tensions along cables follow the bends; after these steps they are fixed until Newton has converged."""
MOST_ROUNDS = 60
"""Largest number of Newton solves of `settle`."""
ROUNDING = 1e3
"""A state from which no step lowers the potential has converged if its residual is below this multiple of the tolerance: rounding
errors of the potential then hide any decrease."""


def settle(body: BodyModel, loads: Loads, state: State, max_iterations: int) -> SolveStatus:
    """Repeat Newton's method until the active set and the friction along cables no longer change."""
    seen: set[bytes] = set()  # active sets: one that comes back would come back for ever
    for _ in range(MOST_ROUNDS):
        status = newton(body, loads, state, max_iterations)
        if status is SolveStatus.CONVERGED:
            if state.iterations > state.options.most_steps:
                return SolveStatus.ITERATIONS
            if not update_active_set(body, loads, state):
                if not update_friction(body, loads, state):
                    return SolveStatus.CONVERGED
                state.borrowed = True  # the tensions change little, so the current factor is tried again
                continue
        elif status is not SolveStatus.CABLES or not release_one(body, loads, state):
            return status
        if state.active.tobytes() in seen:
            return SolveStatus.CABLES
        seen.add(state.active.tobytes())
    return SolveStatus.ITERATIONS


def newton(body: BodyModel, loads: Loads, state: State, max_iterations: int) -> SolveStatus:
    """Move `state` to the equilibrium for a fixed active set.

    A step changes the node positions by du [m] and the efforts T of the active drives by dT (`NewtonEquations`). Tensions along cables with
    friction follow the bends in the first FOLLOW_FRICTION steps if no drive is active; otherwise they are fixed.

    Returns CONVERGED; SINGULAR without a factor; CABLES if the equations of active cables contradict each other; STALLED if no step lowers
    the potential or a number is not finite; ITERATIONS after `max_iterations` steps, or for a trial state whose stiffness is indefinite too
    often.
    """
    keeper, length = FactorKeeper(body, loads, state), np.inf
    here = state.here = internal(body, state.x, tangent=not state.borrowed)
    has_friction = any(c.friction > 0 for c in body.cables)
    can_follow = has_friction and not state.active.any()
    for iteration in range(max_iterations):
        follows = can_follow and iteration < FOLLOW_FRICTION
        if follows and (iteration or state.borrowed):  # at a cold start the bends are still those at rest
            update_friction(body, loads, state)
        # residual
        equations = equations_at(body, loads, state, here)
        residual = state.residual = equations.residual
        if state.options.watch is not None:
            state.options.watch(residual)
        if not (np.isfinite(residual) and np.isfinite(here.energy)):
            return SolveStatus.STALLED
        is_short = state.rough and not has_friction and length <= ARRIVED * body.reach  # friction needs the exact bends
        if equations.is_closed and (is_short or residual <= loads.tolerance):
            return SolveStatus.CONVERGED
        # step
        factor = keeper.factor(here, equations, length, follows=follows)
        if factor is None:
            return SolveStatus.SINGULAR
        if state.rough and state.indefinite_steps > state.options.indefinite_tried:
            return SolveStatus.ITERATIONS
        du, dT = equations.step(factor)
        if equations.is_contradicted_by(du, dT):
            return SolveStatus.CABLES
        if not (np.isfinite(du).all() and np.isfinite(dT).all()):
            return SolveStatus.STALLED
        state.iterations += 1
        length = float(np.abs(du).max(initial=0.0))
        # line search
        moved = line_search(body, loads, state, here, equations, du, dT, tangent=keeper.expects_new_factor)
        if moved is not None:
            here = state.here = moved
        elif state.borrowed:  # the step of another state's factor may lead uphill: repeat it with a new factor
            state.factor = None
        elif equations.is_closed and residual <= ROUNDING * loads.tolerance:
            return SolveStatus.CONVERGED
        else:
            return SolveStatus.STALLED
    return SolveStatus.ITERATIONS
