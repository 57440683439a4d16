"""The inverse problem of motion: cable inputs and pressures that bring points of the body to wanted places.

The unknowns are the tensions of the cables and the pressures of the chambers, u. Each round linearises the equilibrium,

    p(u + du) ≈ p(u) + W_pa du,    s(u + du) ≈ s(u) + W_aa du,

(W of the exact tangent, p the wanted coordinates, s the shortening of the cables) and solves the quadratic problem

    min ½ |p + W_pa du − p*|² + ½ duᵀ S du + ½ λ |du|²   with  u_min ≤ u + du ≤ u_max,  s_min ≤ s + W_aa du ≤ s_max,

as Duriez (2013) and Coevoet et al. (2017) pose it, within a trust region that the next equilibrium widens or narrows.
S is the second-order part, which counts where the target is out of reach (`curvature`).
The damping λ acts on the step, not on the input, so that it moves no answer. A wanted contact force is applied to the body,
and the place of the wall becomes one more target: both hold where the robot presses the wall with that force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.control.corrected import reach_corrected
from femsense.control.curvature import Seen, convex, learned
from femsense.control.goal import Goal, Target, make_goal
from femsense.control.limits import CONTROLS, Limits, command, make_limits
from femsense.control.motion import NEAREST, REACHED, STOPPED, Certificate, Motion, WallContact
from femsense.control.slopes import Slopes, exact_slopes, lent_slopes, may_be_lent
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.model.robot import Robot
from femsense.qp.problem import Problem
from femsense.qp.solve import solve

WEAKEST = 1e-3
"""An actuator that moves the points less than this share of the strongest is not pulled harder for it."""
PENALTY = 50.0
"""A limit of length that is missed by so much weighs like an error so many times as large."""
ACTIVE = 1e-9
"""A limit holds a step back if its multiplier is larger than this, in units of the scaled problem."""
FIRST_RADIUS, SMALLEST_STEP, NEAR = 0.3, 1e-9, 1e-5
"""Trust region at first and the step at which a search is over, in units of the body's reach;
error from which states are solved finely [m]."""
COARSE, FINE = 1e-9, 1e-13
"""Relative tolerance of equilibria on the way, and within a hundredth of a millimetre of the target."""

KEPT = 0.1
"""Slopes serve for another step where the last one left no more than this share of the error."""
SURE_GAIN = 0.5
"""Slopes that are not exact are made anew where they promise to take less than this share of the squared error."""


@dataclass(frozen=True, slots=True)
class ReachOptions:
    """When a search for inputs ends."""

    tolerance_m: float = 1e-10
    """A target is reached that is missed by less than this [m]."""
    max_iterations: int = 60
    """Equilibria at most."""
    least_gain: float = 1e-9
    """The search ends where the predicted gain of a step is below this share of the squared error."""
    correct: bool = False
    """Use the robot's empirical correction: markers are wanted where it has them."""
    damping: float = 1e-10
    """λ, in units of the largest eigenvalue of W_paᵀ W_pa; actuators that do the same share their work by it."""


def reach(
    robot: Robot,
    target: Target,
    *,
    control: str = "tension",
    limits: Mapping[str, tuple[float, float]] | None = None,
    forces: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]] | None = None,
    start: Equilibrium | Motion | None = None,
    calibration: Calibration | None = None,
    contacts: Sequence[WallContact] = (),
    options: ReachOptions | None = None,
) -> Motion:
    """Find the inputs that bring points of the body to wanted places, within limits.

    Arguments:
        robot: the robot with its effects; its cables' and chambers' limits hold.
        target: a marker's name, or a point of the body at rest [m] → where it is wanted, robot frame [m], shape (3,); NaN leaves
            a direction free.
        control: what is commanded of the cables: "tension" [N] or "displacement" [m].
        limits: cable → (least, largest) command [N or m], chamber → pressure [Pa], beside those of the robot.
        forces: known or sensed contact forces: (place on the body at rest [m], force on the body [N]), each of shape (3,).
        start: where the robot is now; by default at rest without inputs. Where no way leads on from there,
            one from rest is tried.
        calibration: its initial inputs are taken off the commands.
        contacts: walls to press against with a wanted force.
        options: when to end.

    Returns:
        the motion; a target out of reach is a status with the nearest state and what limits it, no exception.

    Raises:
        InputError: an unknown marker, cable or control, limits the wrong way round, or no correction where one is asked for.
    """
    known = options or ReachOptions()
    if control not in CONTROLS:
        raise InputError("unknown control", where="control", found=control, expected=" or ".join(CONTROLS))
    bounds = make_limits(robot, control, limits or {}, calibration)

    def find(aims: Target, near: Equilibrium | Motion | None) -> Motion:
        goal = make_goal(robot, aims, forces or (), contacts)
        first = near.equilibrium if isinstance(near, Motion) else near
        motion = _searched(robot, control, goal, bounds, _begin(robot.body, goal, bounds, first), known, calibration)
        if motion.status == REACHED or first is None:
            return motion
        again = _searched(robot, control, goal, bounds, _begin(robot.body, goal, bounds, None), known, calibration)
        return again if again.error_m < motion.error_m else motion

    return reach_corrected(robot, target, control, find, start) if known.correct else find(target, start)


def _searched(
    robot: Robot,
    control: str,
    goal: Goal,
    bounds: Limits,
    state: Equilibrium,
    options: ReachOptions,
    calibration: Calibration | None,
) -> Motion:
    """Step by step to the inputs: each step is taken if the error falls, else the trust region shrinks."""
    body, before = robot.body, state.segment_tensions
    radius, count, status, last, beyond = FIRST_RADIUS, 1, STOPPED, _Step(np.zeros(len(bounds.low)), 0.0, 0.0), ""
    slopes, settled = lent_slopes(body, goal, state) if state.converged else None, False
    curvature, seen = np.zeros((len(bounds.low),) * 2), None
    while state.converged and count < options.max_iterations:
        error, miss2 = goal.error(state.positions), float((goal.miss(state.positions) ** 2).sum())
        within = bounds.violation(_wound(body, state)) <= options.tolerance_m
        end = REACHED if within and error <= options.tolerance_m else ""
        if slopes is None:
            slopes, state = exact_slopes(body, goal, state)
            before_it, seen = seen, Seen(_effort(state), slopes.points, goal.miss(state.positions))
            curvature = curvature if before_it is None else learned(curvature, before_it, seen)
        if not end:
            bend = curvature if slopes.exact else 0.0 * curvature
            last = _step(body, goal, bounds, state, slopes, radius, options, bend)
            if not slopes.exact and (last.size < SMALLEST_STEP or last.gain <= SURE_GAIN * miss2):
                slopes = None
                continue
            end = NEAREST if within and last.gain <= options.least_gain * miss2 else ""
        if end and settled:
            status = end
            break
        fine = bool(end) or error < NEAR
        change = 0.0 if end else last.change
        tried = _solved(
            body, goal, np.clip(_effort(state) + change, bounds.low, bounds.high), state, before, fine=fine, tried=True
        )
        count += 1
        if end:
            state, settled = tried if tried.converged else state, True
        elif tried.converged and _is_better(body, goal, bounds, tried, state):
            serves = goal.error(tried.positions) <= KEPT * error
            slopes = _learned(body, goal, slopes, state, tried) if serves else None
            state, radius, beyond, settled = tried, 4.0 * radius, "", fine
        elif not slopes.exact:
            slopes = None
        elif last.size < SMALLEST_STEP:
            status = NEAREST if within and last.gain <= np.sqrt(options.least_gain) * miss2 else STOPPED
            break
        else:
            radius, beyond = 0.25 * min(radius, last.size), "" if tried.converged else tried.status
    return _motion(robot, control, goal, bounds, state, last, status, count, calibration, beyond)


@dataclass(frozen=True, eq=False, slots=True)
class _Step:
    """The answer of one quadratic problem."""

    change: FloatArray
    """Of the efforts [N, Pa], shape (a + c,)."""
    size: float
    """Largest change, in units of what would move the points by the body's reach [1]."""
    gain: float
    """By how much the squared error falls to first order [m²]."""
    active: tuple[tuple[float, int, str], ...] = ()
    """Limits that hold it back: (multiplier, index of the effort, "least", "largest", "shortest" or "longest"),
    the largest first."""


def _step(
    body: BodyModel,
    goal: Goal,
    bounds: Limits,
    state: Equilibrium,
    slopes: Slopes,
    radius: float,
    options: ReachOptions,
    curvature: FloatArray,
) -> _Step:
    """Return the best step of the linearised problem, with what is known of its curvature, in a trust region."""
    u, miss = _effort(state), goal.miss(state.positions)
    J, W = slopes.points, slopes.wound
    moved = np.linalg.norm(J, axis=0)
    unit = body.reach / np.maximum(moved, WEAKEST * max(float(moved.max(initial=0.0)), 1e-300))
    scaled = J * unit
    top = max(float(np.linalg.norm(scaled, 2)) ** 2, 1e-300) if scaled.size else 1.0
    low, high = np.minimum((bounds.low - u) / unit, 0.0), np.maximum((bounds.high - u) / unit, 0.0)
    G, h, names = bounds.rows(W * unit, _wound(body, state), np.maximum(low, -radius), np.minimum(high, radius))
    squares = convex(scaled.T @ scaled + curvature * np.outer(unit, unit))
    problem = Problem(
        P=squares / top + options.damping * np.eye(len(u)),
        q=-scaled.T @ miss / top,
        G=G,
        h=h,
        lb=np.maximum(low, -radius),
        ub=np.minimum(high, radius),
    )
    answer = solve(problem)
    if answer.x is None or answer.multipliers is None:
        return _Step(np.zeros(len(u)), 0.0, 0.0)
    change = np.asarray(answer.x)
    box = zip(answer.multipliers.z_box, low, high)
    active = [
        (abs(float(z)), i, "least" if z < 0 else "largest") for i, (z, a, b) in enumerate(box) if abs(a if z < 0 else b) < radius
    ]
    active += [(float(z), i, which) for z, (i, which) in zip(answer.multipliers.z, names)]
    gain = float(2.0 * miss @ scaled @ change - change @ squares @ change)
    shown = tuple(sorted((limit for limit in active if limit[0] > ACTIVE), reverse=True))
    return _Step(unit * change, float(np.abs(change).max(initial=0.0)), gain, shown)


def _learned(body: BodyModel, goal: Goal, slopes: Slopes, state: Equilibrium, tried: Equilibrium) -> Slopes:
    """Return what the way from one state to another shows of the slopes."""
    moved = goal.miss(state.positions) - goal.miss(tried.positions)
    return slopes.learned(_effort(tried) - _effort(state), moved, _wound(body, tried) - _wound(body, state))


def _effort(state: Equilibrium) -> FloatArray:
    """Return tensions [N], then pressures [Pa], shape (a + c,)."""
    return np.array([*state.tension.values(), *state.pressure.values()])


def _wound(body: BodyModel, state: Equilibrium) -> FloatArray:
    """Return what each motor has wound up [m], shape (a,): the cable's shortening and its stretch."""
    stretch = [state.tension[cable.name] / cable.stretch_stiffness for cable in body.cables]
    return np.asarray(np.array(list(state.shortening.values())) + np.array(stretch))


def _solved(
    body: BodyModel,
    goal: Goal,
    effort: FloatArray,
    start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None,
    *,
    fine: bool = False,
    tried: bool = False,
) -> Equilibrium:
    """Return the equilibrium under efforts (a + c,);
    `before` are the tensions along the cables before the robot began to move."""
    a, lent = len(body.cables), start is not None and may_be_lent(body, start)
    return solve_equilibrium(
        body,
        tension=dict(zip(body.cable_names, effort[:a].tolist())),
        pressure=dict(zip(body.chamber_names, effort[a:].tolist())),
        nodal_forces=goal.nodal_forces,
        start=start,
        bilateral=True,
        options=SolveOptions(
            before=before,
            relative_tolerance=FINE if fine else COARSE,
            rough=tried and not fine,
            single=fine,
            reuse_factor=lent,
        ),
    )


def _begin(body: BodyModel, goal: Goal, bounds: Limits, start: Equilibrium | None) -> Equilibrium:
    """Return the state to begin with, within the limits of efforts."""
    effort = np.zeros(len(bounds.low)) if start is None else _effort(start)
    before = None if start is None else start.segment_tensions
    return _solved(body, goal, np.clip(effort, bounds.low, bounds.high), start, before)


def _is_better(body: BodyModel, goal: Goal, bounds: Limits, tried: Equilibrium, state: Equilibrium) -> bool:
    """Return whether a state is nearer, limits of length that are violated included (an exact penalty: the more is missed,
    the more they count)."""
    weight = PENALTY * float(np.linalg.norm(goal.miss(state.positions)))

    def merit(one: Equilibrium) -> float:
        return float((goal.miss(one.positions) ** 2).sum()) + weight * bounds.violation(_wound(body, one))

    return merit(tried) < merit(state)


def _motion(
    robot: Robot,
    control: str,
    goal: Goal,
    bounds: Limits,
    state: Equilibrium,
    last: _Step,
    status: str,
    count: int,
    calibration: Calibration | None,
    beyond: str,
) -> Motion:
    body = robot.body
    effort, wound, miss = _effort(state), _wound(body, state), goal.miss(state.positions)
    true = effort[: len(wound)] if control == "tension" else wound
    inputs = {name: command(robot, control, i, float(true[i]), calibration) for i, name in enumerate(body.cable_names)}
    zeros = {} if calibration is None else calibration.chamber_pressure_pa
    inputs.update({name: pressure - zeros.get(name, 0.0) for name, pressure in state.pressure.items()})
    places = goal.ties.positions(state.positions)
    share = last.gain / max(float(miss @ miss), 1e-300) if status != REACHED else 0.0
    certificate = Certificate(state.residual_n, max(share, 0.0), bounds.violation(wound) + bounds.outside(effort))
    return Motion(
        inputs=inputs,
        positions=state.positions,
        reached_m={name: freeze(place) for name, place in zip(goal.names, places)},
        error_m=goal.error(state.positions),
        status=status,
        limits=() if status == REACHED else _words(body, bounds, last, beyond),
        certificate=certificate,
        iterations=count,
        equilibrium=state,
    )


def _words(body: BodyModel, bounds: Limits, last: _Step, beyond: str) -> tuple[str, ...]:
    """Return what stops a motion in words: limits that are active, and equilibria that end."""
    active = tuple(bounds.text(i, which, body) for _, i, which in last.active)
    return (*active, f"no equilibrium further on ({beyond})") if beyond else active
