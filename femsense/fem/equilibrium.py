"""Static equilibrium under dead loads, cables and pressures: Newton's method with the exact tangent, a line search, and load steps
when needed.

The state minimises  Π(x) = W(x) − f·x + Σ t ℓ(x) − Σ p V(x)  over the free nodes, where cables pull with given tensions t and
chambers press with given pressures p; a held cable adds the constraint  δ(x) + T/k = d  with its tension T as multiplier, a held
chamber  V(x) − V(rest) = ΔV  with its pressure. A held cable never pushes (unless `bilateral`): it becomes slack when T would be
negative, and taut again when its shortening would fall below d (complementarity). A held chamber may pull: it is full of liquid.
Friction changes the tensions along a cable (`capstan.capstan_tensions`); these are updated in and between Newton solves until they
converge. `Loads` and `State` (in `newton_state`) name the quantities of cables and chambers: effort, travel, target, lever, shares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.core.work import count
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.chambers import volume_gradient
from femsense.fem.linalg.factorization import Factorization
from femsense.fem.newton import settle
from femsense.fem.newton_state import (
    Loads,
    NewtonOptions,
    SolveStatus,
    State,
    drive_compliance,
    drive_rows,
    travel_of,
    unbalanced_force,
)
from femsense.fem.stability import can_fall, holds_itself, is_doubtful

SMALLEST_STEP = 2e-3
"""Smallest load step, as a share of the load: a path that needs smaller steps ends as `overload`."""
SOFTNESS = 1e-2
"""Stiffness of a body relative to its modulus times its size: the order of magnitude for slender bodies. It converts travels to forces."""
LEAST_TRAVEL = 1e-6
"""A load counts at least as the force that moves a body by this share of its size: a body without loads has a tolerance, too."""
ROUNDING = 1e-13
"""Rounding errors of the internal forces relative to modulus times size²."""
ADVICE = {
    SolveStatus.CONVERGED: "the unbalanced force is below its tolerance",
    SolveStatus.UNSTABLE: (
        "the forces balance, but the slightest disturbance makes the body buckle: (a) add a small force to the side to which "
        "it should go; (b) reduce the load"
    ),
    SolveStatus.SINGULAR: "nothing holds the body: clamp more nodes (three that are not on a line at least)",
    SolveStatus.STALLED: (
        "no step lowers the energy any further: (a) the load may be beyond buckling; (b) elements may be inverted; try "
        "smaller loads or a better mesh"
    ),
    SolveStatus.ITERATIONS: "Newton did not settle in its iterations: try smaller steps of the inputs, or start from a nearby equilibrium",
    SolveStatus.CABLES: (
        "the held cables and chambers contradict each other, or could not agree on which cables are slack: try other "
        "displacements"
    ),
    SolveStatus.OVERLOAD: (
        "load steps became too small: (a) the body collapses or buckles under this load; (b) a cable has drawn its point to "
        "the next one; reduce the load"
    ),
}


@dataclass(frozen=True, eq=False, slots=True)
class Equilibrium:
    """Result of `solve_equilibrium`: node positions, cable tensions, chamber pressures, and the residual force that shows whether it is an equilibrium.

    The body has n nodes, a cables and c chambers; a cable has s segments.
    """

    positions: FloatArray
    """Node positions [m], shape (n, 3)."""
    tension: dict[str, float]
    """Tension of each cable at its motor [N]."""
    shortening: dict[str, float]
    """Shortening of each cable relative to rest [m]."""
    pressure: dict[str, float]
    """Pressure in each chamber above the surroundings [Pa]."""
    volume: dict[str, float]
    """Increase of the volume of each chamber since rest [m³]."""
    residual_n: float
    """Largest unbalanced nodal force under the whole load [N]."""
    status: SolveStatus
    """`SolveStatus.CONVERGED`, or the reason of the failure; members equal their texts, such as "converged"."""
    iterations: int
    """Number of Newton steps."""
    reached: float
    """Share of the load that `positions` balance [1]: 1, or the last successful load step."""
    indefinite_steps: int
    """Newton steps at which the stiffness was not positive definite: above 0 the body may have buckled or snapped through on the
    way, and there may be other equilibria."""
    segment_tensions: tuple[FloatArray, ...]
    """Tension along each cable, far end first [N], one array (s,) a cable."""
    held: BoolArray
    """Cables that are held at a displacement and taut, then chambers that are held at a volume, shape (a + c,)."""
    nodal_forces: FloatArray
    """Nodal forces in addition to the body's own dead load [N], shape (n, 3)."""
    factor: Factorization | None
    """The last factor of the stiffness, at this state or an earlier iterate; a start for nearby solves."""

    def __repr__(self) -> str:
        return (
            f"Equilibrium({self.status}: {len(self.positions)} nodes, residual {self.residual_n:.1e} N, {self.iterations} steps)"
        )

    @property
    def converged(self) -> bool:
        return self.status == SolveStatus.CONVERGED

    @property
    def advice(self) -> str:
        """Cause of the status and its remedy."""
        return ADVICE[self.status]


@dataclass(frozen=True, eq=False, slots=True)
class SolveOptions:
    """Options of `solve_equilibrium`: tolerances, number of steps, precision, and the cable tensions before the motion, on which friction depends."""

    before: tuple[FloatArray, ...] | None = None
    """Tensions along the cables before the motion [N], one array (s,) a cable, on which friction depends. None: the tensions of `start`,
    or 0 without a start."""
    along: tuple[FloatArray, ...] | None = None
    """Tension of each segment of each cable for a motor tension of 1 [1], one array (s,) a cable, kept constant: for user-defined
    friction laws. A cable with own friction only starts from these values. None: the values of `start` for a cable with friction, else 1."""
    reuse_factor: bool = False
    """Begin with the factor of the start, for changes so small that its stiffness is nearly the new one."""
    max_iterations: int = 60
    """Newton steps at each load level."""
    relative_tolerance: float = 1e-9
    """Largest unbalanced force relative to the sum of all loads [1]."""
    rough: bool = False
    """The state is a trial of a search, near `start`: factors in single precision, and no load steps if Newton's method fails."""
    single: bool = False
    """Factors in single precision if these are positive definite; the residual and its tolerance stay in double precision."""
    newton: NewtonOptions = field(default_factory=NewtonOptions)
    """When Newton's method makes a new factor, uses rotated steps, or gives up a trial state."""


def solve_equilibrium(
    body: BodyModel,
    *,
    tension: Mapping[str, float] | None = None,
    shortening: Mapping[str, float] | None = None,
    pressure: Mapping[str, float] | None = None,
    volume: Mapping[str, float] | None = None,
    nodal_forces: npt.ArrayLike | None = None,
    start: Equilibrium | None = None,
    bilateral: bool = False,
    options: SolveOptions | None = None,
) -> Equilibrium:
    """Solve for the static equilibrium of a body under cable, chamber and nodal loads, by Newton's method with load steps.

    Arguments:
        body: the body with its weight and dead forces.
        tension: dict, name of a cable → its tension at the motor [N]. A cable in neither `tension` nor `shortening` is slack.
        shortening: dict, name of a cable → its imposed shortening since rest [m]. Such a cable never pushes unless `bilateral`.
        pressure: dict, name of a chamber → its pressure above the surroundings [Pa]. A chamber in neither `pressure` nor `volume` has 0 Pa.
        volume: dict, name of a chamber → its imposed increase of volume since rest [m³], as by a liquid pump; its pressure can be negative.
        nodal_forces: forces on the n nodes in addition to the weight [N], shape (n, 3). Default: none.
        start: an equilibrium from which the iteration starts; its node positions, tensions and factorised stiffness are reused. Default: rest.
        bilateral: whether cables with an imposed shortening can push. Default: no.
        options: a `femsense.fem.equilibrium.SolveOptions`: tolerance, number of steps, and the tensions before the motion, on which friction
            depends. Default: `SolveOptions()`.

    Returns:
        the state: node positions [m], tensions [N], pressures [Pa]. `converged` is True if it is an equilibrium; otherwise `status` holds the
        reason and `advice` the remedy.

    Raises:
        InputError: an unknown cable or chamber, one with two inputs, or arrays with other shapes or non-finite values.

    Example:
        >>> import femsense as fs
        >>> body = fs.load_robot("finger").body
        >>> pulled = fs.solve_equilibrium(body, tension={"flexor": 1.0})
        >>> pulled.converged, round(1e3 * pulled.shortening["flexor"], 1)  # mm
        (True, 4.5)
    """
    given = {"tension": tension, "shortening": shortening, "pressure": pressure, "volume": volume}
    how = options or SolveOptions()
    if not (how.max_iterations >= 1 and 0 < how.relative_tolerance < 1):
        found = f"{how.max_iterations}, {how.relative_tolerance:g}"
        raise InputError("out of range", where="max_iterations, relative_tolerance", found=found, expected="≥ 1, between 0 and 1")
    if start is not None:
        _check_start(body, start)
    loads = _collect_loads(body, given, nodal_forces, start, how.before, bilateral, how.relative_tolerance)
    state, status, reached = _solve(body, loads, start, how)
    has_friction = any(c.friction > 0 for c in body.cables)
    if (
        status is not SolveStatus.CONVERGED or has_friction
    ):  # the tensions have changed since the last residual of Newton's method
        state.residual = _residual(body, loads, state)
    if status is not SolveStatus.CONVERGED:
        status = status if body.is_held() else SolveStatus.SINGULAR
    elif not body.is_held() and not holds_itself(body, state):
        status = SolveStatus.SINGULAR
    elif is_doubtful(loads, state, start is not None and start.converged) and can_fall(body, loads, state):
        status = SolveStatus.UNSTABLE
    extra = np.zeros_like(body.mesh.nodes) if nodal_forces is None else np.asarray(nodal_forces, dtype=np.float64)
    return _result(body, state, status, reached, extra)


class _Attempt(NamedTuple):
    """How far an attempt came: a state, how its last Newton solve ended, and which share of the load the state balances."""

    state: State
    status: SolveStatus
    reached: float

    @property
    def is_final(self) -> bool:
        """Whether load steps would not help."""
        return self.status in (SolveStatus.CONVERGED, SolveStatus.SINGULAR)


def _solve(body: BodyModel, loads: Loads, start: Equilibrium | None, options: SolveOptions) -> _Attempt:
    """Solve directly; if that fails, in load steps from the start; if that fails, in load steps from rest. A trial state is only solved
    directly."""
    attempt = _directly(body, loads, start, options)
    if (options.rough and start is not None) or attempt.is_final or not body.is_held():
        return attempt
    if start is not None and start.converged:
        attempt = _in_steps_from_start(body, loads, start, options, attempt.state)
    return attempt if attempt.is_final else _in_steps_from_rest(body, loads, start, options, attempt.state)


def _directly(body: BodyModel, loads: Loads, start: Equilibrium | None, options: SolveOptions) -> _Attempt:
    """Apply all loads at once to the start, or to the body at rest."""
    state, newton = _initial_state(body, loads, start, options.reuse_factor, options.along), options.newton
    state.rough = options.rough and start is not None
    state.single, state.options = state.rough or options.single, newton
    most = min(options.max_iterations, newton.steps_tried) if state.rough else options.max_iterations
    return _Attempt(state, settle(body, loads, state, most), 1.0)


def _in_steps_from_start(body: BodyModel, loads: Loads, start: Equilibrium, options: SolveOptions, failed: State) -> _Attempt:
    """Go from the loads of the start to the wanted loads."""
    first = _loads_of(body, start, loads)
    state = _initial_state(body, first, start, False, options.along)
    return _step_loads(body, first, loads, state, failed, options.max_iterations)


def _in_steps_from_rest(
    body: BodyModel, loads: Loads, start: Equilibrium | None, options: SolveOptions, failed: State
) -> _Attempt:
    """Go from no loads to the wanted loads. Only the friction along cables is taken from the start."""
    nothing = replace(loads, forces=0.0 * loads.forces, effort=0.0 * loads.effort, target=0.0 * loads.target)
    shares = _initial_state(body, loads, start, False, options.along).shares
    rest = State(body.mesh.nodes.copy(), nothing.effort.copy(), _first_taut(body, loads), shares)
    return _step_loads(body, nothing, loads, rest, failed, options.max_iterations)


def _collect_loads(
    body: BodyModel,
    given: Mapping[str, Mapping[str, float] | None],
    nodal_forces: npt.ArrayLike | None,
    start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None,
    bilateral: bool,
    relative_tolerance: float,
) -> Loads:
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
    tolerance = _tolerance(body, forces, np.abs(effort) * lever, np.abs(target) / lever, relative_tolerance)
    return Loads(forces, effort, target, np.concatenate([pulled, filled]), lever, bilateral, before, tolerance)


def _tolerance(body: BodyModel, forces: FloatArray, pulls: FloatArray, travels: FloatArray, relative_tolerance: float) -> float:
    """Return the largest unbalanced nodal force of an equilibrium [N].

    The tolerance is a share of the sum of all loads, plus rounding errors of the internal forces.

    Arguments:
        forces: dead nodal forces [N], shape (n, 3).
        pulls: forces of the drives with imposed efforts [N], shape (a + c,).
        travels: imposed travels as lengths [m], shape (a + c,), which count as the forces that they cause in a body of typical stiffness.
        relative_tolerance: the share [1].
    """
    size, modulus = body.reach, float(np.median(body.material.young_modulus))
    stiffness = SOFTNESS * modulus * size  # [N/m]
    total = np.linalg.norm(forces, axis=1).sum() + pulls.sum() + stiffness * travels.sum()
    return float(relative_tolerance * max(total, stiffness * LEAST_TRAVEL * size) + ROUNDING * modulus * size**2)


def _drive_values(
    names: tuple[str, ...], kind: str, effort: str, travel: str, given: Mapping[str, Mapping[str, float] | None]
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the inputs of cables or chambers: efforts, travels, and which travels are imposed."""
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


def _loads_of(body: BodyModel, start: Equilibrium, loads: Loads) -> Loads:
    """Return the loads under which a start was in equilibrium, with imposed travels for the same drives as in `loads`."""
    effort = np.array([*start.tension.values(), *start.pressure.values()])
    travel = travel_of(body, start.positions) + drive_compliance(body) * effort
    free = ~loads.controlled
    return replace(
        loads,
        forces=body.dead_load() + start.nodal_forces,
        effort=np.where(free, np.maximum(effort, 0.0) if not loads.bilateral else effort, 0.0),
        target=np.where(free, 0.0, travel),
    )


def _first_taut(body: BodyModel, loads: Loads) -> BoolArray:
    """Return which held drives carry load at rest, shape (a + c,): all but cables that are paid out."""
    cable = np.arange(len(loads.effort)) < len(body.cables)
    return loads.controlled & (~cable | (loads.target >= 0.0) | loads.bilateral)


def _initial_state(
    body: BodyModel, loads: Loads, start: Equilibrium | None, reuse_factor: bool, along: tuple[FloatArray, ...] | None
) -> State:
    shares = [np.ones(len(c.path)) for c in body.cables] if along is None else [np.array(share) for share in along]
    if start is None:
        return State(body.mesh.nodes.copy(), loads.effort.copy(), _first_taut(body, loads), shares)
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
    far = np.inf if start.status == SolveStatus.UNSTABLE else 0.0  # stability is checked even if nothing moves
    usable = reuse_factor and start.factor is not None and start.factor.size == len(body.free_map.dofs)
    return State(x, np.asarray(T, dtype=float), taut, shares, start.factor if usable else None, usable, factored_at=far)


def _clamped(body: BodyModel) -> BoolArray:
    free = np.zeros(body.mesh.nodes.size, dtype=bool)
    free[body.free_map.dofs] = True
    return ~free.reshape(-1, 3)[:, 0]


def _residual(body: BodyModel, loads: Loads, state: State) -> float:
    """Return the largest unbalanced nodal force [N]; inf where an element is turned inside out."""
    here = internal(body, state.x, tangent=False) if state.here is None else state.here
    force = unbalanced_force(loads, state, here, drive_rows(body, state))[body.free_map.dofs]
    size = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
    return size if np.isfinite(here.energy) and np.isfinite(size) else np.inf


def _step_loads(body: BodyModel, first: Loads, loads: Loads, good: State, failed: State, max_iterations: int) -> _Attempt:
    """Go from the first loads to the wanted loads in load steps, which shrink after a failure and grow after a success.

    Arguments:
        good: the state under the first loads, or near it.
        failed: the state of the attempt before, whose Newton steps count.
    """
    done, step = 0.0, 0.25
    spent, good.indefinite_steps, good.options = failed.iterations, failed.indefinite_steps, failed.options
    status = settle(body, first, good, max_iterations)
    while status is SolveStatus.CONVERGED and done < 1.0:
        part = min(1.0, done + step)
        there, state = loads.part_way(first, part), _copied(good)
        state.T = np.where(loads.controlled, good.T, there.effort)
        status = settle(body, there, state, max_iterations)
        count(equilibria=1)
        spent += state.iterations - good.iterations
        if status is SolveStatus.CONVERGED:
            good, done, step = state, part, 1.5 * step
        elif 0.4 * step >= SMALLEST_STEP and spent < good.options.most_steps:
            status, step = SolveStatus.CONVERGED, 0.4 * step
        elif status not in (SolveStatus.SINGULAR, SolveStatus.CABLES):
            status = SolveStatus.OVERLOAD
    good.iterations = spent
    return _Attempt(good, status, done)


def _copied(state: State) -> State:
    """Return a copy of a state without its factor, which Newton's method may move."""
    shares, x = [s.copy() for s in state.shares], state.x.copy()
    return replace(state, x=x, T=state.T.copy(), taut=state.taut.copy(), shares=shares, factor=None, borrowed=False, here=None)


def _result(body: BodyModel, state: State, status: SolveStatus, reached: float, nodal_forces: FloatArray) -> Equilibrium:
    names, a = body.cable_names, len(body.cables)
    travel = travel_of(body, state.x)
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
