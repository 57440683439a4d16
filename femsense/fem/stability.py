"""Whether a balanced state is stable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.fem.assembly import internal, reduced_values
from femsense.fem.body import BodyModel
from femsense.fem.clamp import with_turning_plate
from femsense.fem.linalg.factorization import factorize
from femsense.fem.newton_equations import equations_at
from femsense.fem.newton_state import Loads, State, drive_rows, unbalanced_force
from femsense.fem.stiffness_factor import FAR, factor_here, stiffness_blocks

FALL_ITERATIONS = 30
"""Inverse iterations towards the softest motion of a state that may be unstable."""


def holds_itself(body: BodyModel, state: State) -> bool:
    """Return whether a balanced body without a sufficient clamp is stable (cables may hold it)."""
    blocks = stiffness_blocks(body, internal(body, state.x), state)
    factor = with_turning_plate(body, state.x, factorize(body.free_map.pattern, reduced_values(body, blocks)))
    return factor is not None and factor.negative == 0


def is_doubtful(loads: Loads, state: State, follows_path: bool) -> bool:
    """Return whether the current stiffness leaves the stability of a balanced state undecided.

    It does where it was not positive definite, and where it was factorised far from the end. A path from one state to the next is
    spared the latter (`follows_path`): the next step, which starts with the stiffness of this state, sees it.
    """
    return state.shifted or (not follows_path and state.factored_at > FAR * loads.tolerance)


def can_fall(body: BodyModel, loads: Loads, state: State) -> bool:
    """Return whether the energy of a balanced state decreases along some motion; the softest one is found by inverse iteration.

    The curvature along that motion is a difference of forces: a perturbed pivot of a factor alone cannot raise a false alarm.
    """
    here, free = internal(body, state.x), body.free_map.dofs
    equations = equations_at(body, loads, state, here)
    equations = replace(equations, H=equations.C, gap=np.zeros(len(equations.active)))  # a self-adjoint problem without friction
    factor = factor_here(body, here, state, equations)
    if factor is None or not state.shifted:
        return False
    motion = np.random.default_rng(0).standard_normal(len(free))
    for _ in range(FALL_ITERATIONS):
        motion, _ = replace(equations, force=motion).step(factor)
        motion /= np.abs(motion).max()
    step = np.zeros(state.x.size)
    step[free] = 1e-6 * body.reach * motion
    forces = []
    for sign in (1.0, -1.0):
        there = replace(state, x=state.x + sign * step.reshape(-1, 3))
        forces.append(unbalanced_force(loads, there, internal(body, there.x, tangent=False), drive_rows(body, there)))
    curvature = float((forces[1] - forces[0]) @ step)
    scale = float(np.abs((forces[1] - forces[0]) * step).sum())
    return curvature < -1e-6 * scale
