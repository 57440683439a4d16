"""Updates between Newton solves: the active set of held cables, and the tensions along cables with friction."""

from __future__ import annotations

import numpy as np

from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles
from femsense.fem.capstan import capstan_tensions
from femsense.fem.newton_state import Loads, State, is_cable, travel_of


def release_one(body: BodyModel, loads: Loads, state: State) -> bool:
    """Make one of several contradicting cables slack: the one that exceeds its imposed shortening most. Return whether there was one."""
    candidates = np.flatnonzero(state.active & is_cable(body))
    if loads.bilateral or not len(candidates):
        return False
    over = (travel_of(body, state.x) - loads.target)[candidates]
    state.T[state.active] = 0.0  # the efforts that contradicted each other are no start for the next solve
    state.active[candidates[np.argmax(over)]] = False
    return True


def update_active_set(body: BodyModel, loads: Loads, state: State) -> bool:
    """Release the active cable that pushes most, else tighten the slack cable that became too long by most; return whether there was one."""
    if loads.bilateral or not loads.held.any():
        return False
    held_cable = loads.held & is_cable(body)
    pushes = held_cable & state.active & (state.T < -1e-12)
    if pushes.any():
        worst = np.flatnonzero(pushes)[np.argmin(state.T[pushes])]
        state.active[worst], state.T[worst] = False, 0.0
        return True
    gap = travel_of(body, state.x) - loads.target
    too_long = held_cable & ~state.active & (gap < -1e-9)
    if too_long.any():
        state.active[np.flatnonzero(too_long)[np.argmin(gap[too_long])]] = True
        return True
    return False


def update_friction(body: BodyModel, loads: Loads, state: State) -> bool:
    """Update the tensions along cables by capstan friction; return whether anything changed."""
    changed = False
    for i, cable in enumerate(body.cables):
        if cable.friction == 0:
            continue
        T = max(state.T[i], 0.0)
        tensions = capstan_tensions(cable, bend_angles(cable, state.x), loads.before[i], T)
        share = tensions / T if T > 0 else np.zeros_like(tensions)
        if np.abs(share - state.shares[i]).max() * T > 1e-8 * max(1.0, T):
            changed = True
        state.shares[i] = share
    return changed
