"""Newton with the exact tangent at one load, with its factor kept as long as it serves.

Around it go the sets of taut cables and the tensions along cables with friction, until all of them rest (`settle`).
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.assembly import Internal, internal, reduced_values
from femsense.fem.body import BodyModel
from femsense.fem.cables import add_cable_stiffness
from femsense.fem.chambers import add_pressure_stiffness
from femsense.fem.clamp import with_turning_plate
from femsense.fem.linalg.factorization import Factorization, Pattern, factorize, factorize_definite, least_shift
from femsense.fem.line_search import line_search
from femsense.fem.newton_state import (
    CONVERGED,
    Loads,
    State,
    drive_compliance,
    drive_rows,
    kinematic_rows,
    travel_of,
    unbalanced_force,
)
from femsense.fem.slack_and_friction import let_go, update_friction, update_slack

SURE = 0.1
"""If a step reduces the residual below this fraction, the next one will probably reach `NewtonOptions.chord`, so no tangent is assembled
at the new state."""
LENT = 0.1
"""The same for a factor borrowed from a nearby state."""
RUBS = 0.3
"""So does any where tensions along cables follow the bends, which converge no faster with a stiffness of their own."""
PATIENCE = 5
"""In single precision one serves, too, where so many more steps are enough if each leaves the share that the last one left.
States that are only tried have more of it (`NewtonOptions.patience_tried`):
others end the farther below their tolerance the better these steps shrink. Of a first step nothing is known yet: states that are
only tried take a second one."""
PAIRS = 8
"""Steps since the last factor that are remembered (`Secants`)."""
ARRIVED = 5e-7
"""A state that is only tried is there when a step was shorter than this share of the body's size."""
FAR = 1e6
"""A stiffness factorised at a residual above this multiple of the tolerance does not decide the stability of the final state."""
CLOSED = 1e-12
"""How far a held cable may miss its length [m]."""
FOLLOW_FRICTION = 25
"""Largest number of Newton steps in which cable tensions follow the bends; afterwards they are fixed until Newton converges."""


def settle(body: BodyModel, loads: Loads, state: State, max_iterations: int) -> str:
    """Newton, which held cables are slack, and friction, until all three rest."""
    frictional = any(c.friction > 0 for c in body.cables)
    seen: set[bytes] = set()
    for _ in range(60):
        status = newton(body, loads, state, max_iterations)
        if status == "cables" and let_go(body, loads, state) and state.taut.tobytes() not in seen:
            seen.add(state.taut.tobytes())
            continue
        if status != CONVERGED or state.iterations > state.options.most_steps:
            return status if status != CONVERGED else "iterations"
        changed = update_slack(body, loads, state)
        if changed:
            key = state.taut.tobytes()
            if key in seen:
                return "cables"
            seen.add(key)
            continue
        if not frictional or update_friction(body, loads, state):
            return CONVERGED
        state.borrowed = True  # the tensions change little, so the current factor is reused
    return "iterations"


def newton(body: BodyModel, loads: Loads, state: State, max_iterations: int) -> str:
    """Newton at fixed shares and a fixed set of taut cables."""
    free = body.free_map.dofs
    held = np.flatnonzero(state.taut)
    stretch = drive_compliance(body)[held]
    here = state.here = internal(body, state.x, tangent=not state.borrowed)
    last, length, shrinking = np.inf, np.inf, np.inf
    frictional = any(c.friction > 0 for c in body.cables)
    secants = Secants()
    for iteration in range(max_iterations):
        follows = frictional and not len(held) and iteration < FOLLOW_FRICTION
        if follows and (
            iteration or state.borrowed
        ):  # from a nearby state in one step: its bend angles are nearly the final ones
            update_friction(body, loads, state)
        rows = drive_rows(body, state)
        H = kinematic_rows(body, state, rows)[held][:, free] if len(held) else np.zeros((0, len(free)))
        C = rows[held][:, free] if len(held) else H
        force = unbalanced_force(loads, state, here, rows)[free]
        gap = loads.target[held] - travel_of(body, state.x)[held] - stretch * state.T[held] if len(held) else np.zeros(0)
        state.residual = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
        if state.options.watch is not None:
            state.options.watch(state.residual)
        sound = bool(np.isfinite(state.residual) and np.isfinite(here.energy))
        closed = bool((np.abs(gap) / loads.lever[held]).max(initial=0.0) <= CLOSED)
        arrived = state.rough and not frictional and length <= ARRIVED * body.reach
        if sound and closed and (arrived or state.residual <= loads.tolerance):
            return CONVERGED
        if not sound:
            return "stalled"
        left = state.residual / last if last > 0.0 else np.inf
        enough = RUBS if follows else LENT if state.borrowed else state.options.chord
        sound_to_the_end = state.factored_at <= FAR * loads.tolerance and state.residual * min(left, 1.0) ** 2 <= loads.tolerance
        patience = state.options.patience_tried if state.rough else PATIENCE
        in_sight = state.residual * min(left, 1.0) ** patience <= loads.tolerance
        in_sight |= state.rough and length * min(shrinking, 1.0) ** patience <= ARRIVED * body.reach
        serves = left <= enough or sound_to_the_end or (state.single and in_sight)
        if not frictional and not len(held):
            secants.learn(state.x.ravel()[free], force)
        if state.factor is None or not serves:
            state.factor, state.borrowed = factor_here(body, here, state, H, C, stretch, loads.lever[held]), False
            if state.factor is None:
                return "singular"
            if state.rough and state.indefinite_steps > state.options.indefinite_tried:
                return "iterations"
            state.factored_at = state.residual
            secants.pairs.clear()
        last, state.serves = state.residual, state.borrowed or 0.0 < left <= SURE
        if secants.pairs:
            du, dT = secants.step(state.factor, force), gap
        else:
            du, dT = bordered_step(state.factor, force, gap, H, C, stretch, loads.lever[held])
        longer, length = length, float(np.abs(du).max(initial=0.0))
        shrinking = length / longer if longer > 0.0 else np.inf
        if not closed and _contradicts(H @ du + stretch * dT, gap, loads.lever[held]):
            return "cables"
        if not (np.isfinite(du).all() and np.isfinite(dT).all()):
            return "stalled"
        state.iterations += 1
        moved = line_search(body, loads, state, held, here, du, dT, gap, force)
        if moved is None and state.borrowed:
            state.factor = None
            continue
        if moved is None:
            return CONVERGED if closed and state.residual <= 1e3 * loads.tolerance else "stalled"
        here = state.here = moved
    return "iterations"


class Secants:
    """BFGS updates of the inverse stiffness by the steps since the last factor, without held drives (Matthies & Strang 1979)."""

    def __init__(self) -> None:
        self.pairs: list[tuple[FloatArray, FloatArray, float]] = []
        """Steps s [m], the decreases y of the unbalanced force [N], and 1/(sᵀy)."""
        self.last: tuple[FloatArray, FloatArray] | None = None

    def learn(self, x: FloatArray, force: FloatArray) -> None:
        """See the free positions [m] and the unbalanced force there [N], each (f,)."""
        if self.last is not None:
            step, fell = x - self.last[0], self.last[1] - force
            work = float(step @ fell)
            if work > 0.0:
                self.pairs = [*self.pairs[1 - PAIRS :], (step, fell, 1.0 / work)]
        self.last = x, force

    def step(self, factor: Factorization, force: FloatArray) -> FloatArray:
        """Return the quasi-Newton step of an unbalanced force [m], shape (f,)."""
        shares = []
        for step, fell, weight in reversed(self.pairs):
            shares.append(weight * float(step @ force))
            force = force - shares[-1] * fell
        answer = factor.solve(force)
        for (step, fell, weight), share in zip(self.pairs, reversed(shares)):
            answer = answer + (share - weight * float(fell @ answer)) * step
        return answer


def factor_here(
    body: BodyModel, here: Internal, state: State, H: FloatArray, C: FloatArray, stretch: FloatArray, lever: FloatArray
) -> Factorization | None:
    """Factorise the stiffness, made positive definite where it is not: then steps lead downhill.
    Held cables and chambers hold too:
    a stiffness that is indefinite only where they do not let the body go stays as it is."""
    values = reduced_values(body, stiffness_blocks(body, here, state))
    plain = definite_factor(body.free_map.pattern, values, state)
    whole = with_turning_plate(body, state.x, plain)
    state.shifted = state.shift > 0.0 or whole is None or whole.negative > 0
    if state.shifted and len(H):
        exact = with_turning_plate(body, state.x, factorize(body.free_map.pattern, values))
        state.shifted = exact is None or not _held_definite(exact, H, C, stretch, lever)
        whole = whole if state.shifted else exact
    state.indefinite_steps += state.shifted
    # the plate only softens the stiffness, so the factor without it still gives a descent direction
    return plain if state.shifted and whole is not None and whole.negative > 0 else whole


def definite_factor(pattern: Pattern, values: FloatArray, state: State) -> Factorization | None:
    """Factorise a stiffness with the shift that makes it positive definite, starting from the last one.
    Where it is indefinite in single precision alone, as a body about to buckle may be, no other factor of this state is."""
    first, plain = state.shift / 4.0, None
    if state.single:
        plain, state.shift = factorize_definite(pattern, values, single=True, tries=0)
    if plain is None and state.single and first < least_shift(pattern, values):
        plain, state.shift = factorize_definite(pattern, values, tries=0)
        state.single = plain is None
    if plain is None:
        plain, state.shift = factorize_definite(pattern, values, first=first, single=state.single, indefinite=state.single)
    return plain


def stiffness_blocks(body: BodyModel, here: Internal, state: State) -> FloatArray:
    """Return the blocks of the tangent stiffness of body, cables and chambers at a state [N/m], as `internal` has them."""
    blocks = internal(body, state.x).blocks if here.blocks is None else here.blocks.copy()
    assert blocks is not None
    a = len(body.cables)
    add_cable_stiffness(body, state.x, tuple(T * s for T, s in zip(state.T[:a], state.shares)), blocks)
    add_pressure_stiffness(body, state.x, state.T[a:], blocks)
    return blocks


def _held_definite(factor: Factorization, H: FloatArray, C: FloatArray, stretch: FloatArray, lever: FloatArray) -> bool:
    """Return whether a stiffness is positive definite on all motions that held cables and chambers allow.

    Inertia is additive (Haynsworth 1968): it is so where S = H K⁻¹ Cᵀ + 1/k has as many negative eigenvalues as K.
    """
    S = (H @ factor.solve(C.T) + np.diag(stretch)) / np.outer(lever, lever)
    if not np.isfinite(S).all():
        return False
    return int((np.linalg.eigvalsh((S + S.T) / 2.0) < 0).sum()) == factor.negative


def bordered_step(
    factor: Factorization,
    force: FloatArray,
    gap: FloatArray,
    H: FloatArray,
    C: FloatArray,
    stretch: FloatArray,
    lever: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Solve K du − Cᵀ dT = force, H du + stretch dT = gap."""
    if not len(gap):
        return factor.solve(force), gap
    columns = factor.solve(np.column_stack([force, C.T]))
    free, compliance = columns[:, 0], columns[:, 1:]
    matrix = (H @ compliance + np.diag(stretch)) / np.outer(lever, lever)  # all in m/N
    dT = np.linalg.lstsq(matrix, (gap - H @ free) / lever, rcond=None)[0] / lever
    return free + compliance @ dT, np.asarray(dT, dtype=np.float64)


def _contradicts(reached: FloatArray, gap: FloatArray, lever: FloatArray) -> bool:
    """Return whether a step cannot close the gaps of held drives, because their rows are linearly dependent."""
    return bool((np.abs(reached - gap) / lever).max() > 1e-3 * (np.abs(gap) / lever).max() + CLOSED)
