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

from femsense.core.arrays import BoolArray, FloatArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.fem.assembly import Internal, internal, reduced_values
from femsense.fem.body import BodyModel
from femsense.fem.body_parts import Cable
from femsense.fem.cables import add_cable_stiffness, bend_angles, cable_forces, rub, segments, shortening
from femsense.fem.chambers import add_pressure_stiffness, chamber_volume, volume_changes, volume_gradient
from femsense.fem.clamp import with_turning_plate
from femsense.fem.linalg.factorization import Factorization, Pattern, factorize, factorize_definite, least_shift
from femsense.fem.rotated_step import rotated_step

CONVERGED = "converged"
TRIES, INDEFINITE_TRIES = 30, 6
"""Newton steps of a state that is only tried, and stiffnesses of it that are indefinite: it is too far off where they do not do. Bodies that fold
meet 8 to 11 of these in their 30 steps, those that come to rest 4 at most (a trial on bars of `benchmarks/improve.py`)."""
MOST_STEPS = 1500
"""Newton steps in all, load steps included."""
SMALLEST_PART = 2e-3
"""Load steps smaller than this share of the load are stopped early."""
CHORD = 1e-2
"""A stiffness serves for another step where the last one left less than this share of the residual, or where two more such steps are enough
(unless it was factorised so far off that another one is needed at the end)."""
SURE = 0.1
"""Where a step left less than this share, the next one is likely to leave less than CHORD: no tangent is made for the state it leads to."""
LENT = 0.1
"""So does one that was lent by a state near by."""
RUBS = 0.3
"""So does any where tensions along cables follow the bends, which converge no faster with a stiffness of their own."""
PATIENCE, PATIENCE_TRIED = 5, 8
"""In single precision one serves, too, where so many more steps are enough if each leaves the share that the last one left; the latter, about what a
factor takes, for states that are only tried: others end the farther below their tolerance the better these steps shrink.
Of a first step nothing is known yet: states that are only tried take a second one."""
PAIRS = 8
"""Steps since the last factor that are remembered (`Secants`)."""
ARRIVED = 5e-7
"""A state that is only tried is there when a step was shorter than this share of the body's size."""
FAR = 1e6
"""A stiffness factorised where the residual was more than this times its tolerance says nothing of the stability of the end."""
CLOSED = 1e-12
"""How far a held cable may miss its length [m]."""
FALL_ITERATIONS = 30
"""Inverse iterations towards the softest motion of a state that may be unstable."""
CURVED = 1e-3
"""Steps longer than this share of the body are tried with elements that turn before they are tried straight."""
FOLLOW_FRICTION = 25
"""Newton steps at most in which the tensions along the cables follow the bends; then they stand still until Newton rests."""
ADVICE = {
    CONVERGED: "the unbalanced force is below its tolerance",
    "unstable": "the forces balance, but the slightest disturbance makes the body buckle: (a) add a small force to the side to which it should go; (b) reduce the load",
    "singular": "nothing holds the body: clamp more nodes (three that are not on a line at least)",
    "stalled": "no step lowers the energy any further: (a) the load may be beyond buckling; (b) elements may be inverted; try smaller loads or a better mesh",
    "iterations": "Newton did not settle in its iterations: try smaller steps of the inputs, or start from a nearby equilibrium",
    "cables": "the held cables and chambers contradict each other, or could not agree on which cables are slack: try other displacements",
    "overload": "load steps became too small: (a) the body collapses or buckles under this load; (b) a cable has drawn its point to the next one; reduce the load",
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
    """Largest unbalanced nodal force under the whole load [N]."""
    status: str
    """"converged" or what happened (a key of ADVICE)."""
    iterations: int
    reached: float
    """Share of the load at which the positions stand [1]: 1, or where load steps had to stop."""
    indefinite_steps: int
    """Newton steps at which the stiffness was not positive definite: above 0 the body may have buckled or snapped through on the
    way, and there may be other equilibria."""
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
    """What drives the body (cables, then chambers: a + c drives)."""

    forces: FloatArray  # dead nodal forces [N], (n, 3)
    effort: FloatArray  # tensions [N] and pressures [Pa] that are given, (a + c,)
    target: FloatArray  # shortening [m] or growth [m³] of what is held, (a + c,)
    controlled: BoolArray  # what is held, (a + c,)
    lever: FloatArray  # effort × lever is a force, travel / lever a length: 1, or the surface of a chamber [m²], (a + c,)
    bilateral: bool
    before: tuple[FloatArray, ...]  # tensions along the cables until now [N]
    tolerance: float  # of the residual [N]

    def part_way(self, first: _Loads, part: float) -> _Loads:
        """Return the loads on the straight way from the first ones (part 0) to these (part 1)."""
        mixed = {
            name: (1.0 - part) * getattr(first, name) + part * getattr(self, name) for name in ("forces", "effort", "target")
        }
        return replace(self, **mixed)


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
    shifted: bool = False  # the stiffness was not positive definite where it was last factorised
    shift: float = 0.0  # what made the stiffness positive definite there [N/m]
    single: bool = False  # factors in single precision
    rough: bool = False  # the state is only tried
    indefinite_steps: int = 0
    factored_at: float = 0.0  # residual where the stiffness was last factorised [N]
    here: Internal | None = None  # what Newton saw last, at x
    serves: bool = False  # the factor is likely to serve for the step after this one


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
    along: tuple[FloatArray, ...] | None = None,
    max_iterations: int = 60,
    relative_tolerance: float = 1e-9,
    rough: bool = False,
    single: bool = False,
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
        along: tension of each segment of each cable for a tension of 1 at its motor [1], held still: for laws of friction of one's
            own; cables with friction of theirs move on from it. By default 1 without friction, and with it as `start` left it.
        max_iterations: Newton steps at each load level.
        relative_tolerance: of the unbalanced force against the sum of all loads.
        rough: the state is only tried: factors in single precision, and no way to the loads bit by bit where Newton fails from `start`.
        single: factors in single precision wherever these are positive definite; the residual and its tolerance are as ever.

    Returns:
        the state; `status` says whether it is an equilibrium, `advice` what to do if not.

    Raises:
        InputError: unknown cable or chamber, one named twice, wrong shapes or values.
    """
    given = {"tension": tension, "shortening": shortening, "pressure": pressure, "volume": volume}
    if not (max_iterations >= 1 and 0 < relative_tolerance < 1):
        found = f"{max_iterations}, {relative_tolerance:g}"
        raise InputError("out of range", where="max_iterations, relative_tolerance", found=found, expected="≥ 1, between 0 and 1")
    if start is not None:
        _check_start(body, start)
    loads = _collect_loads(body, given, nodal_forces, start, before, bilateral, relative_tolerance)
    state = _initial_state(body, loads, start, reuse_factor, along)
    rough = rough and start is not None
    state.single, state.rough = rough or single, rough
    shares = [s.copy() for s in state.shares]
    status, reached = _settle(body, loads, state, min(max_iterations, TRIES) if rough else max_iterations), 1.0
    if not rough and status not in (CONVERGED, "singular") and start is not None and start.converged and body.is_held():
        first = _loads_of(body, start, loads)
        state, status, reached = _step_loads(
            body, first, loads, _initial_state(body, first, start, False, along), state, max_iterations
        )
    if not rough and status not in (CONVERGED, "singular") and body.is_held():
        nothing = replace(loads, forces=0.0 * loads.forces, effort=0.0 * loads.effort, target=0.0 * loads.target)
        rest = _State(body.mesh.nodes.copy(), nothing.effort.copy(), _first_taut(body, loads), shares)
        state, status, reached = _step_loads(body, nothing, loads, rest, state, max_iterations)
    if status != CONVERGED or any(c.friction > 0 for c in body.cables):  # friction has moved since Newton looked
        state.residual = _residual(body, loads, state)
    if status != CONVERGED:
        status = status if body.is_held() else "singular"
    elif not body.is_held() and not _holds_itself(body, state):
        status = "singular"
    elif _is_doubtful(loads, state, start) and _can_fall(body, loads, state):
        status = "unstable"
    extra = np.zeros_like(body.mesh.nodes) if nodal_forces is None else np.asarray(nodal_forces, dtype=np.float64)
    return _result(body, state, status, reached, extra)


def _collect_loads(
    body: BodyModel,
    given: Mapping[str, Mapping[str, float] | None],
    nodal_forces: npt.ArrayLike | None,
    start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None,
    bilateral: bool,
    relative_tolerance: float,
) -> _Loads:
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
    if [len(b) for b in before] != [len(c.path) for c in body.cables] or not all(np.isfinite(b).all() for b in before):
        raise InputError(
            "not the tensions along these cables",
            where="before",
            found=[len(b) for b in before],
            expected=f"finite, segments {[len(c.path) for c in body.cables]}",
        )
    areas = [np.linalg.norm(volume_gradient(c, body.mesh.nodes), axis=1).sum() for c in body.chambers]
    lever = np.concatenate([np.ones(len(T)), areas])
    effort, target = np.concatenate([T, p]), np.concatenate([d, grown])
    reach = body.reach
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
    return (
        np.array([tables[effort].get(name, 0.0) for name in names], dtype=float),
        np.array([tables[travel].get(name, 0.0) for name in names], dtype=float),
        np.array([name in tables[travel] for name in names], dtype=bool),
    )


def _check_start(body: BodyModel, start: Equilibrium) -> None:
    if start.positions.shape != body.mesh.nodes.shape:
        raise InputError("belongs to another mesh", where="start", found=start.positions.shape, expected=body.mesh.nodes.shape)
    if set(start.tension) != set(body.cable_names) or set(start.pressure) != set(body.chamber_names):
        raise InputError(
            "belongs to a body with other cables or chambers",
            where="start",
            found=[*start.tension, *start.pressure],
            expected=[*body.cable_names, *body.chamber_names],
        )


def _loads_of(body: BodyModel, start: Equilibrium, loads: _Loads) -> _Loads:
    """Return the loads under which a start was in equilibrium, for drives that are held where these are."""
    effort = np.array([*start.tension.values(), *start.pressure.values()])
    travel = _travel(body, start.positions) + _stretch(body) * effort
    free = ~loads.controlled
    return replace(
        loads,
        forces=body.dead_load() + start.nodal_forces,
        effort=np.where(free, np.maximum(effort, 0.0) if not loads.bilateral else effort, 0.0),
        target=np.where(free, 0.0, travel),
    )


def _first_taut(body: BodyModel, loads: _Loads) -> BoolArray:
    """Return which drives are held at first where nothing is known: cables that are paid out are slack at rest."""
    cable = np.arange(len(loads.effort)) < len(body.cables)
    return loads.controlled & (~cable | (loads.target >= 0.0) | loads.bilateral)


def _initial_state(
    body: BodyModel, loads: _Loads, start: Equilibrium | None, reuse_factor: bool, along: tuple[FloatArray, ...] | None
) -> _State:
    shares = [np.ones(len(c.path)) for c in body.cables] if along is None else [np.array(share) for share in along]
    if start is None:
        return _State(body.mesh.nodes.copy(), loads.effort.copy(), _first_taut(body, loads), shares)
    x = start.positions.copy()
    clamped = _clamped(body)
    x[clamped] = body.mesh.nodes[clamped]
    last = [start.tension[name] for name in body.cable_names] + [start.pressure[name] for name in body.chamber_names]
    T = np.where(loads.controlled, last, loads.effort)
    cable = np.arange(len(T)) < len(body.cables)
    taut = loads.controlled & (start.held | (T > 0) | ~cable)
    if loads.bilateral or not start.held.any():
        taut = _first_taut(body, loads)
    T[loads.controlled & ~taut] = 0.0
    for i, tensions in enumerate(start.segment_tensions):
        motor = start.tension[body.cable_names[i]]
        if motor > 0 and body.cables[i].friction > 0 and along is None:
            shares[i] = tensions / motor
    far = np.inf if start.status == "unstable" else 0.0  # where nothing moves, stability is looked at all the same
    usable = reuse_factor and start.factor is not None and start.factor.size == len(body.free_map.dofs)
    return _State(x, np.asarray(T, dtype=float), taut, shares, start.factor if usable else None, usable, factored_at=far)


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
        if status == "cables" and _let_go(body, loads, state) and state.taut.tobytes() not in seen:
            seen.add(state.taut.tobytes())
            continue
        if status != CONVERGED or state.iterations > MOST_STEPS:
            return status if status != CONVERGED else "iterations"
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


def _let_go(body: BodyModel, loads: _Loads, state: _State) -> bool:
    """Let go the held cable that is shortest against its command, where held cables contradict each other; False where none may go."""
    cable = np.arange(len(state.T)) < len(body.cables)
    candidates = np.flatnonzero(state.taut & cable)
    if loads.bilateral or not len(candidates):
        return False
    over = (_travel(body, state.x) - loads.target)[candidates]
    worst = candidates[np.argmax(over)]
    state.taut[worst], state.T[state.taut | (np.arange(len(state.T)) == worst)] = False, 0.0
    return True


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
    here = state.here = internal(body, state.x, tangent=not state.borrowed)
    last, length, shrinking = np.inf, np.inf, np.inf
    frictional = any(c.friction > 0 for c in body.cables)
    secants = Secants()
    for iteration in range(max_iterations):
        follows = frictional and not len(held) and iteration < FOLLOW_FRICTION
        if follows and (iteration or state.borrowed):  # from a state near by at once: its bends are nearly those of the end
            _update_friction(body, loads, state)
        rows = _rows(body, state)
        H = _kinematic_rows(body, state, rows)[held][:, free] if len(held) else np.zeros((0, len(free)))
        C = rows[held][:, free] if len(held) else H
        force = _unbalanced(loads, state, here, rows)[free]
        gap = loads.target[held] - _travel(body, state.x)[held] - stretch * state.T[held] if len(held) else np.zeros(0)
        state.residual = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
        sound = bool(np.isfinite(state.residual) and np.isfinite(here.energy))
        closed = bool((np.abs(gap) / loads.lever[held]).max(initial=0.0) <= CLOSED)
        arrived = state.rough and not frictional and length <= ARRIVED * body.reach
        if sound and closed and (arrived or state.residual <= loads.tolerance):
            return CONVERGED
        if not sound:
            return "stalled"
        left = state.residual / last if last > 0.0 else np.inf
        enough = RUBS if follows else LENT if state.borrowed else CHORD
        sound_to_the_end = state.factored_at <= FAR * loads.tolerance and state.residual * min(left, 1.0) ** 2 <= loads.tolerance
        patience = PATIENCE_TRIED if state.rough else PATIENCE
        in_sight = state.residual * min(left, 1.0) ** patience <= loads.tolerance
        in_sight |= state.rough and length * min(shrinking, 1.0) ** patience <= ARRIVED * body.reach
        serves = left <= enough or sound_to_the_end or (state.single and in_sight)
        if not frictional and not len(held):
            secants.learn(state.x.ravel()[free], force)
        if state.factor is None or not serves:
            state.factor, state.borrowed = _factor_here(body, here, state, H, C, stretch, loads.lever[held]), False
            if state.factor is None:
                return "singular"
            if state.rough and state.indefinite_steps > INDEFINITE_TRIES:
                return "iterations"
            state.factored_at = state.residual
            secants.pairs.clear()
        last, state.serves = state.residual, state.borrowed or 0.0 < left <= SURE
        if secants.pairs:
            du, dT = secants.step(state.factor, force), gap
        else:
            du, dT = _bordered_step(state.factor, force, gap, H, C, stretch, loads.lever[held])
        longer, length = length, float(np.abs(du).max(initial=0.0))
        shrinking = length / longer if longer > 0.0 else np.inf
        if not closed and _contradicts(H @ du + stretch * dT, gap, loads.lever[held]):
            return "cables"
        if not (np.isfinite(du).all() and np.isfinite(dT).all()):
            return "stalled"
        state.iterations += 1
        moved = _line_search(body, loads, state, held, here, du, dT, gap, force)
        if moved is None and state.borrowed:
            state.factor = None
            continue
        if moved is None:
            return CONVERGED if closed and state.residual <= 1e3 * loads.tolerance else "stalled"
        here = state.here = moved
    return "iterations"


class Secants:
    """What steps since the last factor have shown of the stiffness, where nothing is held: BFGS updates of its inverse (Matthies & Strang 1979)."""

    def __init__(self) -> None:
        self.pairs: list[tuple[FloatArray, FloatArray, float]] = []
        """Steps [m], what they took away from the unbalanced force [N], and one over their product."""
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
        """Return the step that an unbalanced force asks for [m], shape (f,)."""
        shares = []
        for step, fell, weight in reversed(self.pairs):
            shares.append(weight * float(step @ force))
            force = force - shares[-1] * fell
        answer = factor.solve(force)
        for (step, fell, weight), share in zip(self.pairs, reversed(shares)):
            answer = answer + (share - weight * float(fell @ answer)) * step
        return answer


def _unbalanced(loads: _Loads, state: _State, here: Internal, rows: FloatArray) -> FloatArray:
    """Return the unbalanced force of every unknown [N], shape (3n,)."""
    pull = state.T @ rows if len(rows) else 0.0
    return np.asarray(loads.forces.ravel() - here.forces.ravel() + pull)


def _residual(body: BodyModel, loads: _Loads, state: _State) -> float:
    """Return the largest unbalanced nodal force [N]; inf where an element is turned inside out."""
    here = internal(body, state.x, tangent=False) if state.here is None else state.here
    force = _unbalanced(loads, state, here, _rows(body, state))[body.free_map.dofs]
    size = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
    return size if np.isfinite(here.energy) and np.isfinite(size) else np.inf


def _factor_here(
    body: BodyModel, here: Internal, state: _State, H: FloatArray, C: FloatArray, stretch: FloatArray, lever: FloatArray
) -> Factorization | None:
    """Factorise the stiffness, made positive definite where it is not: then steps lead downhill. Held cables and chambers hold too:
    a stiffness that is indefinite only where they do not let the body go stays as it is."""
    values = reduced_values(body, _stiffness_blocks(body, here, state))
    plain = _definite_factor(body.free_map.pattern, values, state)
    whole = with_turning_plate(body, state.x, plain)
    state.shifted = state.shift > 0.0 or whole is None or whole.negative > 0
    if state.shifted and len(H):
        exact = with_turning_plate(body, state.x, factorize(body.free_map.pattern, values))
        state.shifted = exact is None or not _held_definite(exact, H, C, stretch, lever)
        whole = whole if state.shifted else exact
    state.indefinite_steps += state.shifted
    # the plate only ever softens, so that the factor without it leads downhill
    return plain if state.shifted and whole is not None and whole.negative > 0 else whole


def _definite_factor(pattern: Pattern, values: FloatArray, state: _State) -> Factorization | None:
    """Factorise a stiffness with the shift that makes it positive definite, which is near that which served last. Where it is indefinite in single
    precision alone, as a body about to buckle may be, no other factor of this state is."""
    first, plain = state.shift / 4.0, None
    if state.single:
        plain, state.shift = factorize_definite(pattern, values, single=True, tries=0)
    if plain is None and state.single and first < least_shift(pattern, values):
        plain = factorize_definite(pattern, values, tries=0)[0]
        state.single = plain is None
    if plain is None:
        plain, state.shift = factorize_definite(pattern, values, first=first, single=state.single, indefinite=state.single)
    return plain


def _stiffness_blocks(body: BodyModel, here: Internal, state: _State) -> FloatArray:
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


def _holds_itself(body: BodyModel, state: _State) -> bool:
    """Return whether a balanced body whose clamp does not hold it stands all the same (cables may hold it)."""
    blocks = _stiffness_blocks(body, internal(body, state.x), state)
    factor = with_turning_plate(body, state.x, factorize(body.free_map.pattern, reduced_values(body, blocks)))
    return factor is not None and factor.negative == 0


def _is_doubtful(loads: _Loads, state: _State, start: Equilibrium | None) -> bool:
    """Return whether the stiffness at hand leaves open if a balanced state is stable.

    It does where it was not positive definite, and where it was factorised far from the end. A walk from one state to the next is
    spared the latter: the next step, which starts with the stiffness of this state, sees it.
    """
    walks = start is not None and start.converged
    return state.shifted or (not walks and state.factored_at > FAR * loads.tolerance)


def _can_fall(body: BodyModel, loads: _Loads, state: _State) -> bool:
    """Return whether a balanced state has a motion along which its energy falls: the softest one, by inverse iteration.

    The curvature along it is a difference of forces, so that a false alarm needs more than a factor's perturbed pivot.
    """
    held = np.flatnonzero(state.taut)
    rows, free = _rows(body, state), body.free_map.dofs
    H, stretch, lever = rows[held][:, free], _stretch(body)[held], loads.lever[held]
    factor = _factor_here(body, internal(body, state.x), state, H, H, stretch, lever)
    if factor is None or not state.shifted:
        return False
    motion = np.random.default_rng(0).standard_normal(len(free))
    for _ in range(FALL_ITERATIONS):
        motion, _ = _bordered_step(factor, motion, np.zeros(len(held)), H, H, stretch, lever)
        motion /= np.abs(motion).max()
    step = np.zeros(state.x.size)
    step[free] = 1e-6 * body.reach * motion
    forces = []
    for sign in (1.0, -1.0):
        there = replace(state, x=state.x + sign * step.reshape(-1, 3))
        forces.append(_unbalanced(loads, there, internal(body, there.x, tangent=False), _rows(body, there)))
    curvature = float((forces[1] - forces[0]) @ step)
    scale = float(np.abs((forces[1] - forces[0]) * step).sum())
    return curvature < -1e-6 * scale


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
        if (state.shares[i] != 1.0).any():
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


def _contradicts(reached: FloatArray, gap: FloatArray, lever: FloatArray) -> bool:
    """Return whether a step cannot close the gaps of what is held: their rows depend on each other."""
    return bool((np.abs(reached - gap) / lever).max() > 1e-3 * (np.abs(gap) / lever).max() + CLOSED)


def _line_search(
    body: BodyModel,
    loads: _Loads,
    state: _State,
    held: npt.NDArray[np.intp],
    here: Internal,
    du: FloatArray,
    dT: FloatArray,
    gap: FloatArray,
    force: FloatArray,
) -> Internal | None:
    """Go along a Newton step as far as the potential allows (Armijo); return the internal state there, None if nowhere.

    Held cables enter the merit as an exact penalty ρ |gap| with ρ above their tensions.
    """
    free = body.free_map.dofs
    x0, T0 = state.x, state.T
    step = np.zeros(x0.shape)
    step.reshape(-1)[free] = du
    penalty = 2.0 * np.abs(T0[held] + dT) + 1e-3 / loads.lever[held]
    lost = np.zeros(len(T0))  # a held cable with friction is no pure constraint: what its bends take away is a given force
    rubs = np.array([(s != 1.0).any() for s in state.shares] + [False] * len(body.chambers), dtype=bool)
    lost[held] = np.where(rubs[held], T0[held] + dT, 0.0)
    base = _merit(body, loads, state, held, here, penalty, lost)
    slope = -float(force @ du)
    if len(held):
        slope = _slope(body, loads, state, held, here, step, lost) - float(penalty @ np.abs(gap))
    noise = 1e-12 * (abs(here.energy) + abs(float((loads.forces * x0).sum())) + float(np.abs(T0) @ loads.lever) * 1e-2 + 1e-12)
    reach, longest = body.reach, float(np.abs(step).max(initial=1e-300))
    length = min(1.0, 0.5 * reach / longest)
    turned = rotated_step(body, x0, length * step) if longest > CURVED * reach else None
    for trial in range(25):
        state.x = x0 + length * step if turned is None else turned
        state.T = T0.copy()
        state.T[held] = T0[held] + length * dT
        there = internal(body, state.x, tangent=trial == 0 and not state.serves)
        if np.isfinite(there.energy):
            merit = _merit(body, loads, state, held, there, penalty, lost)
            if merit <= base + 1e-4 * length * slope + noise:
                return there
        length, turned = (0.5 * length if turned is None else length), None
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


def _step_loads(
    body: BodyModel, first: _Loads, loads: _Loads, good: _State, failed: _State, max_iterations: int
) -> tuple[_State, str, float]:
    """Go from the first loads to the wanted ones bit by bit; the steps shrink where Newton fails and grow where it succeeds.

    Returns:
        the last equilibrium on the way, its status, and which share of the way it is.
    """
    done, step = 0.0, 0.25
    spent, good.indefinite_steps = failed.iterations, failed.indefinite_steps
    status = _settle(body, first, good, max_iterations)
    while status == CONVERGED and done < 1.0:
        part = min(1.0, done + step)
        there, state = loads.part_way(first, part), _copied(good)
        state.T = np.where(loads.controlled, good.T, there.effort)
        status = _settle(body, there, state, max_iterations)
        spent += state.iterations - good.iterations
        if status == CONVERGED:
            good, done, step = state, part, 1.5 * step
        elif 0.4 * step >= SMALLEST_PART and spent < MOST_STEPS:
            status, step = CONVERGED, 0.4 * step
        else:
            status = status if status in ("singular", "cables") else "overload"
    good.iterations = spent
    return good, status, done


def _copied(state: _State) -> _State:
    """Return a copy that can be moved on without harm to the original, with a factor to come."""
    shares, x = [s.copy() for s in state.shares], state.x.copy()
    return replace(state, x=x, T=state.T.copy(), taut=state.taut.copy(), shares=shares, factor=None, borrowed=False, here=None)


def _result(body: BodyModel, state: _State, status: str, reached: float, nodal_forces: FloatArray) -> Equilibrium:
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
        reached=reached,
        indefinite_steps=state.indefinite_steps,
        segment_tensions=tuple(freeze(T * s) for T, s in zip(state.T, state.shares)),
        held=freeze(state.taut, bool),
        nodal_forces=freeze(nodal_forces),
        factor=state.factor,
    )
