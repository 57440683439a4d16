"""Updates between Newton steps: which held cables are slack, and the tensions along cables with friction."""

from __future__ import annotations

import numpy as np

from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles
from femsense.fem.capstan import capstan_tensions
from femsense.fem.newton_state import Loads, State, travel_of


def let_go(body: BodyModel, loads: Loads, state: State) -> bool:
    """Make one of several contradicting held cables slack: the one that exceeds its imposed shortening most. Return whether there was one."""
    cable = np.arange(len(state.T)) < len(body.cables)
    candidates = np.flatnonzero(state.taut & cable)
    if loads.bilateral or not len(candidates):
        return False
    over = (travel_of(body, state.x) - loads.target)[candidates]
    worst = candidates[np.argmax(over)]
    state.taut[worst], state.T[state.taut | (np.arange(len(state.T)) == worst)] = False, 0.0
    return True


def update_slack(body: BodyModel, loads: Loads, state: State) -> bool:
    """Release held cables that would push and tighten slack ones that became too long; return whether anything changed."""
    if loads.bilateral or not loads.controlled.any():
        return False
    cable = np.arange(len(state.T)) < len(body.cables)
    push = state.taut & cable & (state.T < -1e-12)
    if push.any():
        worst = np.flatnonzero(push)[np.argmin(state.T[push])]
        state.taut[worst], state.T[worst] = False, 0.0
        return True
    gap = travel_of(body, state.x) - loads.target
    loose = loads.controlled & cable & ~state.taut & (gap < -1e-9)
    if loose.any():
        state.taut[np.flatnonzero(loose)[np.argmin(gap[loose])]] = True
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
