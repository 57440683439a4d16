"""Static equilibrium under dead loads, cables and pressures: Newton with the exact tangent, a line search, and load steps when needed.

The state minimises  Π(x) = W(x) − f·x + Σ t ℓ(x) − Σ p V(x)  over the free nodes, where cables pull with given tensions t and
chambers press with given pressures p; a held cable adds the constraint  δ(x) + T/k = d  with its tension T as multiplier, a held
chamber  V(x) − V(rest) = ΔV  with its pressure. A held cable never pushes (unless asked): it goes slack where T would be
negative, and taut again where its shortening would fall below d (complementarity). A held chamber may pull: it is full of liquid.
Friction moves the tensions along a cable (see `cables.rub`); they are updated between Newton solves until they rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from femsense.arrays import BoolArray, FloatArray, as_points, freeze
from femsense.errors import InputError
from femsense.fem.assembly import Internal, internal, reduced_values
from femsense.fem.body import BodyModel, Cable
from femsense.fem.cables import add_cable_stiffness, bend_angles, cable_forces, cable_length, rub, segments, shortening
from femsense.fem.chambers import add_pressure_stiffness, chamber_volume, volume_changes, volume_gradient
from femsense.fem.clamp import with_turning_plate
from femsense.fem.linear import Factorization, factorize_definite

CONVERGED = "converged"
FOLLOW_FRICTION = 25
"""Newton steps at most in which the tensions along the cables follow the bends; then they stand still until Newton rests."""
ADVICE = {
    CONVERGED: "the unbalanced force is below its tolerance",
    "singular": "nothing holds the body: clamp more nodes (three that are not on a line at least)",
    "stalled": "no step lowers the energy any further: (a) the load may be beyond buckling; (b) elements may be inverted; try smaller loads or a better mesh",
    "iterations": "Newton did not settle in its iterations: try smaller steps of the inputs, or start from a nearby equilibrium",
    "cables": "the held cables could not agree on which of them are slack: try other displacements",
    "overload": "load steps became too small: the body collapses or buckles under this load; reduce it",
}


@dataclass(frozen=True, eq=False, slots=True)
class Equilibrium:
    """A static state with its certificate."""

    positions: FloatArray
    """Node positions [m], shape (n, 3)."""
    tension: dict[str, float]
    """Tension of each cable at its motor [N]."""
    shortening: dict[str, float]
    """Shortening of each cable against rest [m]."""
    pressure: dict[str, float]
    """Pressure in each chamber above the surroundings [Pa]."""
    volume: dict[str, float]
    """How much each chamber has grown since rest [m³]."""
    residual_n: float
    """Largest unbalanced nodal force [N]."""
    status: str
    """"converged" or what happened (a key of ADVICE)."""
    iterations: int
    segment_tensions: tuple[FloatArray, ...]
    """Tension along each cable, far end first [N], one array (s,) a cable."""
    held: BoolArray
    """Cables that are held at a displacement and taut, then chambers that are held at a volume, shape (a + c,)."""
    nodal_forces: FloatArray
    """Nodal forces beside the body's own dead load [N], shape (n, 3)."""
    factor: Factorization | None
    """The last factorised stiffness (of the last Newton step but one); a start for nearby solves."""

    @property
    def converged(self) -> bool:
        return self.status == CONVERGED

    @property
    def advice(self) -> str:
        """Cause of the status and what to try."""
        return ADVICE[self.status]


@dataclass(frozen=True, eq=False, slots=True)
class _Loads:
    """What drives the body (cables, then chambers: a + c drives); `scaled` gives a part of it for load steps."""

    forces: FloatArray  # dead nodal forces [N], (n, 3)
    effort: FloatArray  # tensions [N] and pressures [Pa] that are given, (a + c,)
    target: FloatArray  # shortening [m] or growth [m³] of what is held, (a + c,)
    controlled: BoolArray  # what is held, (a + c,)
    lever: FloatArray  # effort × lever is a force, travel / lever a length: 1, or the surface of a chamber [m²], (a + c,)
    bilateral: bool
    before: tuple[FloatArray, ...]  # tensions along the cables until now [N]
    tolerance: float  # of the residual [N]

    def scaled(self, part: float) -> _Loads:
        return replace(self, forces=part * self.forces, effort=part * self.effort, target=part * self.target)


@dataclass(eq=False, slots=True)
class _State:
    """Where the iteration stands."""

    x: FloatArray  # (n, 3)
    T: FloatArray  # motor tensions [N], then pressures [Pa], (a + c,)
    taut: BoolArray  # held cables that carry load, and held chambers, (a + c,)
    shares: list[FloatArray]  # segment tension / motor tension
    factor: Factorization | None = None
    borrowed: bool = False  # the factor belongs to another state; it serves as long as the residual falls fast
    iterations: int = 0
    residual: float = np.inf


def solve_equilibrium(
    body: BodyModel,
    *,
    tension: Mapping[str, float] | None = None,
    shortening: Mapping[str, float] | None = None,
    pressure: Mapping[str, float] | None = None,
    volume: Mapping[str, float] | None = None,
    nodal_forces: npt.ArrayLike | None = None,
    start: Equilibrium | None = None,
    before: tuple[FloatArray, ...] | None = None,
    bilateral: bool = False,
    reuse_factor: bool = False,
    max_iterations: int = 60,
    relative_tolerance: float = 1e-9,
) -> Equilibrium:
    """Find the static equilibrium of a body.

    Arguments:
        body: the body with its weight and dead forces.
        tension: name → tension at the motor [N]; cables that are not named anywhere are slack.
        shortening: name → shortening that a cable is held at [m]; such a cable never pushes unless `bilateral`.
        pressure: name → pressure in a chamber above the surroundings [Pa]; chambers that are not named anywhere have none.
        volume: name → growth of a chamber since rest [m³] that it is held at, as a pump of liquid does; it may suck.
        nodal_forces: further nodal forces [N], shape (n, 3).
        start: an equilibrium to start from (its positions, tensions and factor).
        before: tensions along the cables until now [N], for friction; by default those of `start`, else none.
        bilateral: held cables may push.
        reuse_factor: begin with the factor of `start` (for changes so small that its stiffness still serves).
        max_iterations: Newton steps at each load level.
        relative_tolerance: of the unbalanced force against the sum of all loads.

    Returns:
        the state; `status` says whether it is an equilibrium, `advice` what to do if not.

    Raises:
        InputError: unknown cable or chamber, one named twice, wrong shapes or values.
    """
    given = {"tension": tension, "shortening": shortening, "pressure": pressure, "volume": volume}
    loads = _collect_loads(body, given, nodal_forces, start, before, bilateral, relative_tolerance)
    state = _initial_state(body, loads, start, reuse_factor)
    status = _settle(body, loads, state, max_iterations)
    if status != CONVERGED and not body.is_held():
        status = "singular"
    if status not in (CONVERGED, "singular"):
        state, status = _step_loads(body, loads, state.iterations, max_iterations)
    extra = np.zeros_like(body.mesh.nodes) if nodal_forces is None else np.asarray(nodal_forces, dtype=np.float64)
    return _result(body, loads, state, status, extra)


def _collect_loads(
    body: BodyModel, given: Mapping[str, Mapping[str, float] | None], nodal_forces: npt.ArrayLike | None, start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None, bilateral: bool, relative_tolerance: float,
) -> _Loads:  # fmt: skip
    n = len(body.mesh.nodes)
    T, d, pulled = _drive_values(body.cable_names, "a cable", "tension", "shortening", given)
    p, grown, filled = _drive_values(body.chamber_names, "a chamber", "pressure", "volume", given)
    pushes = np.flatnonzero(T < 0)
    if len(pushes) and not bilateral:
        name = body.cable_names[pushes[0]]
        raise InputError("a cable cannot push", where=f"tension[{name}]", found=f"{T[pushes[0]]:g} N", expected="≥ 0")
    forces = body.dead_load()
    if nodal_forces is not None:
        extra = as_points(nodal_forces, "nodal_forces")
        if extra.shape != (n, 3):
            raise InputError("wrong shape", where="nodal_forces", found=extra.shape, expected=(n, 3))
        forces = forces + extra
    if before is None:
        before = start.segment_tensions if start is not None else tuple(np.zeros(len(c.path)) for c in body.cables)
    areas = [np.linalg.norm(volume_gradient(c, body.mesh.nodes), axis=1).sum() for c in body.chambers]
    lever = np.concatenate([np.ones(len(T)), areas])
    effort, target = np.concatenate([T, p]), np.concatenate([d, grown])
    reach = np.ptp(body.mesh.nodes, axis=0).max()
    stiffness = float(np.median(body.material.young_modulus)) * reach
    scale = np.linalg.norm(forces, axis=1).sum() + np.abs(effort) @ lever + (np.abs(target) / lever).sum() * stiffness * 1e-2
    tolerance = relative_tolerance * max(scale, 1e-6 * stiffness * reach * 1e-2) + 1e-13 * stiffness * reach
    return _Loads(forces, effort, target, np.concatenate([pulled, filled]), lever, bilateral, before, float(tolerance))


def _drive_values(
    names: tuple[str, ...], kind: str, effort: str, travel: str, given: Mapping[str, Mapping[str, float] | None]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return what cables or chambers are given: efforts, travels, and which are held at their travel."""
    tables = {where: dict(given[where] or {}) for where in (effort, travel)}
    for where, values in tables.items():
        for name, value in values.items():
            if name not in names:
                raise InputError(
                    f"unknown {kind.split()[1]}",
                    where=where,
                    found=name,
                    expected=", ".join(names) or f"a body with {kind.split()[1]}s",
                )
            if not np.isfinite(value):
                raise InputError("must be finite", where=f"{where}[{name}]", found=value)
    twice = set(tables[effort]) & set(tables[travel])
    if twice:
        what = "pulled or held" if effort == "tension" else "under pressure or held"
        raise InputError(f"{kind} is either {what}", where=travel, found=f"{sorted(twice)} in {effort} too")
    return (np.array([tables[effort].get(name, 0.0) for name in names], dtype=float),
            np.array([tables[travel].get(name, 0.0) for name in names], dtype=float),
            np.array([name in tables[travel] for name in names], dtype=bool))  # fmt: skip


def _initial_state(body: BodyModel, loads: _Loads, start: Equilibrium | None, reuse_factor: bool) -> _State:
    shares = [np.ones(len(c.path)) for c in body.cables]
    if start is None:
        return _State(body.mesh.nodes.copy(), loads.effort.copy(), loads.controlled.copy(), shares)
    if start.positions.shape != body.mesh.nodes.shape:
        raise InputError("belongs to another mesh", where="start", found=start.positions.shape, expected=body.mesh.nodes.shape)
    x = start.positions.copy()
    clamped = _clamped(body)
    x[clamped] = body.mesh.nodes[clamped]
    last = [start.tension.get(name, 0.0) for name in body.cable_names] + [
        start.pressure.get(name, 0.0) for name in body.chamber_names
    ]
    T = np.where(loads.controlled, last, loads.effort)
    cable = np.arange(len(T)) < len(body.cables)
    taut = loads.controlled & (start.held | (T > 0) | ~cable)
    if not start.held.any():
        taut = loads.controlled.copy()
    for i, tensions in enumerate(start.segment_tensions):
        motor = start.tension[body.cable_names[i]]
        if motor > 0:
            shares[i] = tensions / motor
    usable = reuse_factor and start.factor is not None and start.factor.size == len(body.free_map.dofs)
    return _State(x, np.asarray(T, dtype=float), taut, shares, start.factor if usable else None, usable)


def _clamped(body: BodyModel) -> BoolArray:
    free = np.zeros(body.mesh.nodes.size, dtype=bool)
    free[body.free_map.dofs] = True
    return ~free.reshape(-1, 3)[:, 0]


def _settle(body: BodyModel, loads: _Loads, state: _State, max_iterations: int) -> str:
    """Newton, which held cables are slack, and friction, until all three rest."""
    frictional = any(c.friction > 0 for c in body.cables)
    seen: set[bytes] = set()
    for _ in range(60):
        status = _newton(body, loads, state, max_iterations)
        if status != CONVERGED:
            return status
        changed = _update_slack(body, loads, state)
        if changed:
            key = state.taut.tobytes()
            if key in seen:
                return "cables"
            seen.add(key)
            continue
        if not frictional or _update_friction(body, loads, state):
            return CONVERGED
        state.borrowed = True  # the tensions move by little: the factor at hand serves
    return "iterations"


def _update_slack(body: BodyModel, loads: _Loads, state: _State) -> bool:
    """Let go what would push and tighten what became too long; return whether anything changed."""
    if loads.bilateral or not loads.controlled.any():
        return False
    cable = np.arange(len(state.T)) < len(body.cables)
    push = state.taut & cable & (state.T < -1e-12)
    if push.any():
        worst = np.flatnonzero(push)[np.argmin(state.T[push])]
        state.taut[worst], state.T[worst] = False, 0.0
        return True
    gap = _travel(body, state.x) - loads.target
    loose = loads.controlled & cable & ~state.taut & (gap < -1e-9)
    if loose.any():
        state.taut[np.flatnonzero(loose)[np.argmin(gap[loose])]] = True
        return True
    return False


def _update_friction(body: BodyModel, loads: _Loads, state: _State) -> bool:
    """Move the tensions along the cables to where friction lets them rest; return whether they rested already."""
    still = True
    for i, cable in enumerate(body.cables):
        if cable.friction == 0:
            continue
        T = max(state.T[i], 0.0)
        tensions = rub(cable, bend_angles(cable, state.x), loads.before[i], T)
        share = tensions / T if T > 0 else np.zeros_like(tensions)
        if np.abs(share - state.shares[i]).max() * T > 1e-8 * max(1.0, T):
            still = False
        state.shares[i] = share
    return still


def _newton(body: BodyModel, loads: _Loads, state: _State, max_iterations: int) -> str:
    """Newton at fixed shares and a fixed set of taut cables."""
    free = body.free_map.dofs
    held = np.flatnonzero(state.taut)
    stretch = _stretch(body)[held]
    here = internal(body, state.x, tangent=not state.borrowed)
    last, saved = np.inf, (state.x, state.T)
    frictional = any(c.friction > 0 for c in body.cables)
    for iteration in range(max_iterations):
        if frictional and not len(held) and 0 < iteration < FOLLOW_FRICTION:
            _update_friction(body, loads, state)
        rows = _rows(body, state)
        H = _kinematic_rows(body, state, rows)[held][:, free] if len(held) else np.zeros((0, len(free)))
        C = rows[held][:, free] if len(held) else H
        pull = state.T @ rows if len(rows) else 0.0
        force = (loads.forces.ravel() - here.forces.ravel() + pull)[free]
        gap = loads.target[held] - _travel(body, state.x)[held] - stretch * state.T[held] if len(held) else np.zeros(0)
        state.residual = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
        if state.residual <= loads.tolerance and (np.abs(gap) / loads.lever[held]).max(initial=0.0) <= 1e-12:
            return CONVERGED
        if not np.isfinite(state.residual):
            return "stalled"
        if state.borrowed and state.residual > 0.5 * last:  # the borrowed factor does not serve: back, and a factor of its own
            state.x, state.T = saved
            state.factor, state.borrowed, last = None, False, np.inf
            here = internal(body, state.x)
            continue
        if state.factor is None or (not state.borrowed and state.residual > max(loads.tolerance, 1e-2 * last)):
            state.factor = _factor_here(body, here, state)
            if state.factor is None:
                return "singular"
        last, saved = state.residual, (state.x, state.T)
        du, dT = _bordered_step(state.factor, force, gap, H, C, stretch, loads.lever[held])
        state.iterations += 1
        if state.borrowed:
            here = _full_step(body, state, held, du, dT)
            continue
        moved = _line_search(body, loads, state, held, here, du, dT, gap)
        if moved is None:
            return CONVERGED if state.residual <= 1e3 * loads.tolerance else "stalled"
        here = moved
    return "iterations"


def _factor_here(body: BodyModel, here: Internal, state: _State) -> Factorization | None:
    blocks = internal(body, state.x).blocks if here.blocks is None else here.blocks.copy()
    assert blocks is not None
    add_cable_stiffness(body, state.x, tuple(np.maximum(T, 0.0) * s for T, s in zip(state.T, state.shares)), blocks)
    add_pressure_stiffness(body, state.x, state.T[len(body.cables) :], blocks)
    plain = factorize_definite(body.free_map.pattern, reduced_values(body, blocks))[0]
    whole = with_turning_plate(body, state.x, plain)
    return whole if whole is None or whole.negative == 0 else plain  # the plate only ever softens, so that plain leads downhill


def _rows(body: BodyModel, state: _State) -> FloatArray:
    """Return the nodal forces of unit motor tensions, with the loss along each cable, and of unit pressures, shape (a + c, 3n)."""
    n = len(body.mesh.nodes)
    rows = [cable_forces(c, state.x, s, n).ravel() for c, s in zip(body.cables, state.shares)]
    rows += [volume_gradient(c, state.x).ravel() for c in body.chambers]
    return np.array(rows) if rows else np.zeros((0, 3 * n))


def _kinematic_rows(body: BodyModel, state: _State, rows: FloatArray) -> FloatArray:
    """Return dδ/dx and dV/dx, shape (a + c, 3n): the rows without the loss along the cables."""
    n = len(body.mesh.nodes)
    result = rows.copy()
    for i, cable in enumerate(body.cables):
        if cable.friction > 0:
            result[i] = cable_forces(cable, state.x, np.ones(len(cable.path)), n).ravel()
    return result


def _travel(body: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the shortening of each cable [m] and the growth of each chamber [m³] since rest, shape (a + c,)."""
    return np.concatenate([shortening(body, positions), volume_changes(body, positions)])


def _stretch(body: BodyModel) -> FloatArray:
    """Return the compliance of each cable itself [m/N], and 0 for each chamber, shape (a + c,)."""
    return np.array([1.0 / c.stretch_stiffness for c in body.cables] + [0.0] * len(body.chambers))


def _bordered_step(
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


def _full_step(body: BodyModel, state: _State, held: npt.NDArray[np.intp], du: FloatArray, dT: FloatArray) -> Internal:
    x = state.x.ravel().copy()
    x[body.free_map.dofs] += du
    state.x, state.T = x.reshape(-1, 3), state.T.copy()
    state.T[held] += dT
    return internal(body, state.x, tangent=False)


def _line_search(
    body: BodyModel, loads: _Loads, state: _State, held: npt.NDArray[np.intp], here: Internal, du: FloatArray, dT: FloatArray, gap: FloatArray,
) -> Internal | None:  # fmt: skip
    """Go along a Newton step as far as the potential allows (Armijo); return the internal state there, None if nowhere.

    Held cables enter the merit as an exact penalty ρ |gap| with ρ above their tensions.
    """
    free = body.free_map.dofs
    x0, T0 = state.x, state.T
    step = np.zeros(x0.shape)
    step.reshape(-1)[free] = du
    penalty = 2.0 * np.abs(T0[held] + dT) + 1e-3 / loads.lever[held]
    lost = np.zeros(len(T0))  # a held cable with friction is no pure constraint: what its bends take away is a given force
    rubs = np.array([c.friction > 0 for c in body.cables] + [False] * len(body.chambers), dtype=bool)
    lost[held] = np.where(rubs[held], T0[held] + dT, 0.0)
    base = _merit(body, loads, state, held, here, penalty, lost)
    slope = _slope(body, loads, state, held, here, step, lost) - float(penalty @ np.abs(gap))
    noise = 1e-12 * (abs(here.energy) + abs(float((loads.forces * x0).sum())) + float(np.abs(T0) @ loads.lever) * 1e-2 + 1e-12)
    length = 1.0
    limit = 0.5 * np.ptp(body.mesh.nodes, axis=0).max() / max(np.abs(step).max(), 1e-300)
    length = min(1.0, limit)
    for trial in range(25):
        state.x = x0 + length * step
        state.T = T0.copy()
        state.T[held] = T0[held] + length * dT
        there = internal(body, state.x, tangent=trial == 0 and not state.borrowed)
        if np.isfinite(there.energy):
            merit = _merit(body, loads, state, held, there, penalty, lost)
            if merit <= base + 1e-4 * length * slope + noise:
                return there
        length *= 0.5
    state.x, state.T = x0, T0
    return None


def _merit(
    body: BodyModel,
    loads: _Loads,
    state: _State,
    held: npt.NDArray[np.intp],
    here: Internal,
    penalty: FloatArray,
    lost: FloatArray,
) -> float:
    value = here.energy - float((loads.forces * (state.x - body.mesh.nodes)).sum())
    for i, cable in enumerate(body.cables):
        if not state.taut[i] and state.T[i] != 0.0:
            value += state.T[i] * _weighted_length(cable, state.x, state.shares[i])
        if lost[i] != 0.0:
            value += lost[i] * _weighted_length(cable, state.x, state.shares[i] - 1.0)
    for i, chamber in enumerate(body.chambers, len(body.cables)):
        if not state.taut[i] and state.T[i] != 0.0:
            value -= state.T[i] * (chamber_volume(chamber, state.x) - chamber_volume(chamber, body.mesh.nodes))
    if len(held):
        stretch = _stretch(body)[held]
        gap = loads.target[held] - _travel(body, state.x)[held] - stretch * state.T[held]
        value += float(penalty @ np.abs(gap)) + 0.5 * float(stretch @ state.T[held] ** 2)
    return value


def _weighted_length(cable: Cable, x: FloatArray, share: FloatArray) -> float:
    return float(share @ segments(cable, x)[1])


def _slope(
    body: BodyModel, loads: _Loads, state: _State, held: npt.NDArray[np.intp], here: Internal, step: FloatArray, lost: FloatArray
) -> float:
    """Return the derivative of the potential (of held cables only what friction takes away) along a step."""
    gradient = here.forces - loads.forces
    rows = _rows(body, state)
    loose = state.T.copy()
    loose[held] = 0.0
    if not len(rows):
        return float((gradient * step).sum())
    pull = loose @ rows + lost @ (rows - _kinematic_rows(body, state, rows))
    return float((gradient * step).sum() - pull @ step.ravel())


def _step_loads(body: BodyModel, loads: _Loads, iterations: int, max_iterations: int) -> tuple[_State, str]:
    """Apply the loads bit by bit from rest; the steps shrink where Newton fails and grow where it succeeds."""
    state = _initial_state(body, loads, None, False)
    good = state
    done, step = 0.0, 0.25
    spent = iterations
    while done < 1.0:
        part = min(1.0, done + step)
        state = _copied(good)
        part_loads = loads.scaled(part)
        state.T = np.where(loads.controlled, good.T, part_loads.effort)
        status = _settle(body, part_loads, state, max_iterations)
        spent += state.iterations - good.iterations
        if status == CONVERGED:
            good, done, step = state, part, 1.5 * step
            continue
        step *= 0.4
        if step < 2e-3 or spent > 600:
            good.iterations = spent
            good.residual = state.residual
            return good, status if status == "singular" else "overload"
    good.iterations = spent
    return good, CONVERGED


def _copied(state: _State) -> _State:
    """Return a copy that can be moved on without harm to the original."""
    return _State(
        state.x.copy(),
        state.T.copy(),
        state.taut.copy(),
        [s.copy() for s in state.shares],
        None,
        False,
        state.iterations,
        state.residual,
    )


def _result(body: BodyModel, loads: _Loads, state: _State, status: str, nodal_forces: FloatArray) -> Equilibrium:
    names, a = body.cable_names, len(body.cables)
    travel = _travel(body, state.x)
    return Equilibrium(
        positions=freeze(state.x),
        tension={name: float(T) for name, T in zip(names, state.T)},
        shortening={name: float(d) for name, d in zip(names, travel)},
        pressure={name: float(p) for name, p in zip(body.chamber_names, state.T[a:])},
        volume={name: float(v) for name, v in zip(body.chamber_names, travel[a:])},
        residual_n=state.residual,
        status=status,
        iterations=state.iterations,
        segment_tensions=tuple(freeze(T * s) for T, s in zip(state.T, state.shares)),
        held=freeze(state.taut, bool),
        nodal_forces=freeze(nodal_forces),
        factor=state.factor,
    )


__all__ = ["ADVICE", "Equilibrium", "cable_length", "solve_equilibrium"]
