"""Static equilibrium under dead loads, cables and pressures: Newton's method with the exact tangent, a line search, and load steps
when needed.

The state minimises  Π(x) = W(x) − f·x + Σ t ℓ(x) − Σ p V(x)  over the free nodes, where cables pull with imposed tensions t and
chambers press with imposed pressures p. A drive whose travel is imposed instead is *held*: a cable adds the constraint  δ(x) + T/k = d
with its tension T as multiplier, a chamber  V(x) − V(rest) = ΔV  with its pressure. A held cable never pushes (unless `bilateral`), so its
constraint is *active*, or the cable is *slack*: it becomes slack when T would be negative, and active again when its shortening would fall
below d (complementarity). A held chamber always is active and may pull: it is full of liquid.
Friction changes the tensions along a cable (`capstan.capstan_tensions`); these are updated in and between Newton solves until they
converge.

The way down: `solve_equilibrium` tries all loads at once, then load steps; each attempt calls `newton.settle` (active set and friction),
and that `newton.newton`. `newton_state` defines `Loads`, which a solve does not change, and `State`, which it moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, freeze
from femsense.core.errors import InputError
from femsense.core.work import count
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.imposed_loads import collect_loads
from femsense.fem.linalg.factorization import Factorization
from femsense.fem.newton import settle
from femsense.fem.newton_state import (
    Loads,
    NewtonOptions,
    SolveStatus,
    State,
    drive_compliance,
    drive_rows,
    is_cable,
    travel_of,
    unbalanced_force,
)
from femsense.fem.stability import can_fall, holds_itself, is_doubtful

SMALLEST_STEP = 2e-3
"""Smallest load step, as a share of the load: a path that needs smaller steps ends as `overload`."""
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
    """Cables that are held at a shortening and not slack, then chambers that are held at a volume, shape (a + c,)."""
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
    loads = collect_loads(
        body,
        given,
        nodal_forces,
        before=start.segment_tensions if how.before is None and start is not None else how.before,
        bilateral=bilateral,
        relative_tolerance=how.relative_tolerance,
    )
    state, status, reached = _solve(body, loads, start, how)
    if status is not SolveStatus.CONVERGED or any(c.friction > 0 for c in body.cables):
        state.residual = _residual(
            body, loads, state
        )  # the last one is of other loads, or of the tensions before the last update
    status = _checked(body, loads, state, status, follows_path=start is not None and start.converged)
    extra = np.zeros_like(body.mesh.nodes) if nodal_forces is None else np.asarray(nodal_forces, dtype=np.float64)
    return _result(body, state, status, reached, extra)


# --- attempts: all loads at once, or in steps ---


class _Attempt(NamedTuple):
    """How far an attempt came: a state, how its last Newton solve ended, and the share of the load that the state balances."""

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
    if (options.rough and start is not None) or attempt.is_final or not body.is_clamped():
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
    first = _loads_at(body, start, loads)
    state = _initial_state(body, first, start, False, options.along)
    return _step_loads(body, first, loads, state, failed, options.max_iterations)


def _in_steps_from_rest(
    body: BodyModel, loads: Loads, start: Equilibrium | None, options: SolveOptions, failed: State
) -> _Attempt:
    """Go from no loads to the wanted loads. Only the friction along cables is taken from the start."""
    nothing = replace(loads, forces=0.0 * loads.forces, effort=0.0 * loads.effort, target=0.0 * loads.target)
    shares = _initial_shares(body, start, options.along)
    rest = State(body.mesh.nodes.copy(), nothing.effort.copy(), _active_at_rest(body, loads), shares)
    return _step_loads(body, nothing, loads, rest, failed, options.max_iterations)


def _step_loads(body: BodyModel, first: Loads, loads: Loads, good: State, failed: State, max_iterations: int) -> _Attempt:
    """Go from the first loads to the wanted loads in load steps, which shrink after a failure and grow after a success.

    Arguments:
        good: a state near the equilibrium under the first loads. It is replaced by that of each step that succeeds.
        failed: the state of the attempt before, whose Newton steps count.
    """
    done, step = 0.0, 0.25
    spent, good.indefinite_steps, good.options = failed.iterations, failed.indefinite_steps, failed.options
    status = settle(body, first, good, max_iterations)
    while status is SolveStatus.CONVERGED and done < 1.0:
        part = min(1.0, done + step)
        there, state = loads.part_way(first, part), _copied(good)
        state.T = np.where(loads.held, good.T, there.effort)
        ended = settle(body, there, state, max_iterations)
        count(equilibria=1)
        spent += state.iterations - good.iterations
        if ended is SolveStatus.CONVERGED:
            good, done, step = state, part, 1.5 * step
        elif 0.4 * step >= SMALLEST_STEP and spent < good.options.most_steps:
            step = 0.4 * step
        else:
            status = ended if ended in (SolveStatus.SINGULAR, SolveStatus.CABLES) else SolveStatus.OVERLOAD
    good.iterations = spent
    return _Attempt(good, status, done)


def _copied(state: State) -> State:
    """Return a copy of a state without its factor, which Newton's method may move."""
    shares, x = [s.copy() for s in state.shares], state.x.copy()
    return replace(
        state, x=x, T=state.T.copy(), active=state.active.copy(), shares=shares, factor=None, borrowed=False, here=None
    )


# --- where an attempt starts ---


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


def _initial_state(
    body: BodyModel, loads: Loads, start: Equilibrium | None, reuse_factor: bool, along: tuple[FloatArray, ...] | None
) -> State:
    """Return the state from which Newton's method starts: the body at rest, or `start` with the imposed efforts of `loads`."""
    shares = _initial_shares(body, start, along)
    if start is None:
        return State(body.mesh.nodes.copy(), loads.effort.copy(), _active_at_rest(body, loads), shares)
    x = start.positions.copy()
    clamped = _clamped(body)
    x[clamped] = body.mesh.nodes[clamped]  # the start may belong to a body with another rest shape
    last = [start.tension[name] for name in body.cable_names] + [start.pressure[name] for name in body.chamber_names]
    T = np.where(loads.held, last, loads.effort)
    active = _active_at_rest(body, loads)
    if start.held.any() and not loads.bilateral:
        active = loads.held & (start.held | (T > 0) | ~is_cable(body))
    T[loads.held & ~active] = 0.0
    far = np.inf if start.status == SolveStatus.UNSTABLE else 0.0  # stability is checked even if nothing moves
    usable = reuse_factor and start.factor is not None and start.factor.size == len(body.free_map.dofs)
    return State(x, np.asarray(T, dtype=float), active, shares, start.factor if usable else None, usable, factored_at=far)


def _initial_shares(body: BodyModel, start: Equilibrium | None, along: tuple[FloatArray, ...] | None) -> list[FloatArray]:
    """Return the tension of each segment relative to its motor [1]: as given, as in the start for cables with friction, else 1."""
    if along is not None:
        return [np.array(share) for share in along]
    shares = [np.ones(len(c.path)) for c in body.cables]
    if start is not None:
        for i, (cable, tensions) in enumerate(zip(body.cables, start.segment_tensions)):
            motor = start.tension[cable.name]
            if motor > 0 and cable.friction > 0:
                shares[i] = tensions / motor
    return shares


def _active_at_rest(body: BodyModel, loads: Loads) -> BoolArray:
    """Return the active set at rest, shape (a + c,): all held drives but cables that are paid out."""
    return loads.held & (~is_cable(body) | (loads.target >= 0.0) | loads.bilateral)


def _clamped(body: BodyModel) -> BoolArray:
    free = np.zeros(body.mesh.nodes.size, dtype=bool)
    free[body.free_map.dofs] = True
    return ~free.reshape(-1, 3)[:, 0]


def _loads_at(body: BodyModel, start: Equilibrium, loads: Loads) -> Loads:
    """Return the loads under which `start` was in equilibrium, with the same drives held as in `loads`."""
    effort = np.array([*start.tension.values(), *start.pressure.values()])
    travel = travel_of(body, start.positions) + drive_compliance(body) * effort
    return replace(
        loads,
        forces=body.dead_load() + start.nodal_forces,
        effort=np.where(loads.held, 0.0, effort if loads.bilateral else np.maximum(effort, 0.0)),
        target=np.where(loads.held, travel, 0.0),
    )


# --- what a solve returns ---


def _residual(body: BodyModel, loads: Loads, state: State) -> float:
    """Return the largest unbalanced nodal force [N]; inf where an element is turned inside out."""
    here = internal(body, state.x, tangent=False) if state.here is None else state.here
    force = unbalanced_force(loads, state, here, drive_rows(body, state))[body.free_map.dofs]
    size = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
    return size if np.isfinite(here.energy) and np.isfinite(size) else np.inf


def _checked(body: BodyModel, loads: Loads, state: State, status: SolveStatus, *, follows_path: bool) -> SolveStatus:
    """Return the status with what Newton's method does not see: a body that nothing holds, and a balance that is unstable."""
    if status is not SolveStatus.CONVERGED:
        return status if body.is_clamped() else SolveStatus.SINGULAR
    if not body.is_clamped() and not holds_itself(body, state):
        return SolveStatus.SINGULAR
    if is_doubtful(loads, state, follows_path) and can_fall(body, loads, state):
        return SolveStatus.UNSTABLE
    return status


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
        held=freeze(state.active, bool),
        nodal_forces=freeze(nodal_forces),
        factor=state.factor,
    )
