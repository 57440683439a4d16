"""The search for inputs, one equilibrium at a time; the module docstring of `reach` states the problem of each iteration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from femsense.control.curvature import Seen, convex, learned
from femsense.control.goal import Goal
from femsense.control.limits import Limits
from femsense.control.motion import NEAREST, REACHED, STOPPED
from femsense.control.slopes import Slopes, approximate_slopes, exact_slopes, has_factorisation
from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.qp.problem import Problem
from femsense.qp.solve import solve

WEAKEST = 1e-3
"""An actuator that moves the points by less than this share of the strongest one is scaled as if it moved them by that share."""
PENALTY = 50.0
"""Weight of the violation of length limits in the exact penalty, relative to the distance from the target."""
ACTIVE = 1e-9
"""A limit is active if its multiplier exceeds this, in units of the scaled problem."""
FIRST_RADIUS, SMALLEST_STEP, NEAR = 0.3, 1e-9, 1e-5
"""Initial trust region and step at which a search ends, relative to the body's reach;
error below which states are solved to full tolerance [m]."""
EDGE = 1e-4
"""A search ends if there is no equilibrium within a step of this size: the body collapses or buckles there. Continuing to
SMALLEST_STEP took 10 more solves on data/diamond and reduced the error of 49.6 mm by 0.03 mm."""
COARSE, FINE = 1e-9, 1e-13
"""Relative tolerance of equilibria on the way, and within a hundredth of a millimetre of the target."""

KEPT = 0.1
"""The tangent is kept for another step if the last one left less than this share of the error."""
SURE_GAIN = 0.5
"""A tangent that is not exact is recomputed if its predicted gain is below this share of the squared error."""


@dataclass(frozen=True, slots=True)
class ReachOptions:
    """Options of `reach`: tolerances and numbers of steps at which the search for inputs ends."""

    tolerance_m: float = 1e-10
    """Largest error of a reached target [m]."""
    max_iterations: int = 60
    """Maximum number of equilibria."""
    least_gain: float = 1e-9
    """The search ends if the predicted gain of a step is below this share of the squared error."""
    correct: bool = False
    """Use the robot's empirical correction for the positions of markers."""
    damping: float = 1e-10
    """λ, relative to the largest eigenvalue of W_paᵀ W_pa; it distributes the effort over redundant actuators."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Size of a single step, and effort spent on it."""

    farthest: float = np.inf
    """Largest displacement of a node by one input in a step, relative to the body's reach [1]."""
    by_body: bool = False
    """Whether step lengths measure the displacement of the farthest node; else that of the controlled points."""
    sure_gain: float = SURE_GAIN
    """A tangent that is not exact is recomputed if its predicted gain is below this share of the squared error."""
    faithful: float = np.inf
    """The tangent is also kept if the last step achieved this share of its predicted gain."""
    tolerance: float = COARSE
    """Relative tolerance of the equilibrium after a step whose predicted gain exceeds the tolerance of the search."""
    least_m: float = 0.0
    """The search ends if a step is predicted to reduce the distance by less than this [m]."""


class Search:
    """Trust-region iteration: a step is accepted if the error falls, otherwise the trust region shrinks."""

    def __init__(
        self,
        body: BodyModel,
        goal: Goal,
        bounds: Limits,
        start: Equilibrium | None,
        options: ReachOptions,
        *,
        pace: Pace | None = None,
    ) -> None:
        """Begin at an equilibrium within the limits of efforts; without `start` at rest."""
        self.pace = pace or Pace()
        self.body, self.goal, self.bounds, self.options = body, goal, bounds, options
        self.state = _begin(body, goal, bounds, start)
        self.before = self.state.segment_tensions
        self.count = 1
        """Number of equilibria solved for this goal."""
        self.status = "" if self.state.converged else STOPPED
        """Result of the search; empty while it continues."""
        self.last, self.beyond = Step(np.zeros(len(bounds.low)), 0.0, 0.0), ""
        self._radius, self._settled = min(FIRST_RADIUS, self.pace.farthest), False
        self._edge = np.inf  # upper bound of the step after one that had no equilibrium
        self._slopes = approximate_slopes(body, goal, self.state) if self.state.converged else None
        self._curvature: FloatArray = np.zeros((len(bounds.low),) * 2)
        self._seen: tuple[Seen, FloatArray] | None = None  # the last exact tangent, and the positions there

    def serves(self, goal: Goal) -> bool:
        """Return whether a goal has the same coordinates of the same points, with any targets."""
        return self.goal.names == goal.names and np.array_equal(self.goal.directions, goal.directions)

    def aim(self, goal: Goal) -> None:
        """Continue from the current state to new targets of the same points; tangent and curvature are kept."""
        moved = float(np.abs(goal.wanted - self.goal.wanted).max(initial=0.0))
        self.goal, self.count, self._settled = goal, 0, False
        self._edge = np.inf
        self.before, self.status, self.beyond = self.state.segment_tensions, "" if self.state.converged else STOPPED, ""
        self._radius = min(max(self._radius, 2.0 * moved / self.body.reach), FIRST_RADIUS, self.pace.farthest)
        if self._seen is not None:
            seen, positions = self._seen
            self._seen = replace(seen, miss=goal.miss(positions)), positions

    def advance(self) -> None:
        """Solve one more equilibrium, or end the search."""
        if self.status or self.count >= self.options.max_iterations:
            self.status = self.status or STOPPED
            return
        error = self.goal.error(self.state.positions)
        within = self.bounds.violation(wound_up(self.body, self.state)) <= self.options.tolerance_m
        end = REACHED if within and error <= self.options.tolerance_m else ""
        slopes, end = self._plan(end, within)
        if end and self._settled:
            self.status = end
            return
        fine = bool(end) or error < NEAR
        change = 0.0 if end else self.last.change
        effort = np.clip(efforts_of(self.state) + change, self.bounds.low, self.bounds.high)
        tried = _solved(self.body, self.goal, effort, self.state, self.before, self._fineness(fine), tried=True)
        self.count += 1
        if end:
            self.state, self._settled = tried if tried.converged else self.state, True
        elif tried.converged and _is_better(self.body, self.goal, self.bounds, tried, self.state):
            learns = self._serve(tried)
            self._slopes = _learned(self.body, self.goal, slopes, self.state, tried) if learns else None
            self._radius = min(4.0 * self._radius, self._edge, self.pace.farthest)
            self._edge *= 2.0
            self.state, self.beyond, self._settled = tried, "", fine
        elif not slopes.exact:
            self._slopes = None
        else:
            self._fall_back(tried, within)

    def _fineness(self, fine: bool) -> float:
        """Return the relative tolerance of the next equilibrium."""
        if fine:
            return FINE
        return self.pace.tolerance if self._gained() > self.options.tolerance_m else COARSE

    def _gained(self) -> float:
        """Return the predicted reduction of the distance by the last step [m]."""
        miss2 = float((self.goal.miss(self.state.positions) ** 2).sum())
        return float(np.sqrt(miss2) - np.sqrt(max(miss2 - self.last.gain, 0.0)))

    def _serve(self, tried: Equilibrium) -> bool:
        """Return whether to keep the tangent after this step."""
        before, after = (self.goal.miss(state.positions) for state in (self.state, tried))
        took = float((before**2).sum() - (after**2).sum())
        near = self.goal.error(tried.positions) <= KEPT * self.goal.error(self.state.positions)
        return near or took >= self.pace.faithful * self.last.gain

    def _plan(self, end: str, within: bool) -> tuple[Slopes, str]:
        """Return the tangent to use, and the result if the search ends; the planned step is stored in `last`."""
        miss2 = float((self.goal.miss(self.state.positions) ** 2).sum())
        if self._slopes is not None and not end:
            self._step(self._slopes)
            doubtful = self.last.gain <= self.pace.sure_gain * miss2 or self._gained() <= self.pace.least_m
            if not self._slopes.exact and (self.last.size < SMALLEST_STEP or doubtful):
                self._slopes = None
        if self._slopes is None:
            self._slopes = self._exact()
            if not end:
                self._step(self._slopes)
        over = self.last.gain <= self.options.least_gain * miss2 or self._gained() <= self.pace.least_m
        if not end and within and over:
            end = NEAREST
        return self._slopes, end

    def _exact(self) -> Slopes:
        """Return the exact tangent at this state, and update the curvature."""
        slopes, self.state = exact_slopes(self.body, self.goal, self.state)
        seen = Seen(efforts_of(self.state), slopes.points, self.goal.miss(self.state.positions))
        if self._seen is not None:
            self._curvature = learned(self._curvature, self._seen[0], seen)
        self._seen = seen, self.state.positions
        return slopes

    def _step(self, slopes: Slopes) -> None:
        bend = self._curvature if slopes.exact else 0.0 * self._curvature
        self.last = _best_step(
            self.body, self.goal, self.bounds, self.state, slopes, self._radius, self.options, bend, self.pace.by_body
        )

    def _fall_back(self, tried: Equilibrium, within: bool) -> None:
        """Shrink the trust region after a rejected step, or end the search if it is too small."""
        self.beyond = "" if tried.converged else tried.status
        if self.last.size >= (SMALLEST_STEP if tried.converged else EDGE):
            self._radius = 0.25 * min(self._radius, self.last.size)
            self._edge = self._edge if tried.converged else 0.5 * self.last.size
            return
        miss2 = float((self.goal.miss(self.state.positions) ** 2).sum())
        small = self.last.gain <= np.sqrt(self.options.least_gain) * miss2
        self.status = NEAREST if within and (small or self.beyond) else STOPPED


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """The solution of one quadratic programme."""

    change: FloatArray
    """Of the efforts [N, Pa], shape (a + c,)."""
    size: float
    """Largest change, in units of the effort that would move the points by the body's reach [1]."""
    gain: float
    """Predicted decrease of the squared error [m²]."""
    active: tuple[tuple[float, int, str], ...] = ()
    """Active limits: (multiplier, index of the effort, "least", "largest", "shortest" or "longest"), the largest
    multiplier first."""


def _best_step(
    body: BodyModel,
    goal: Goal,
    bounds: Limits,
    state: Equilibrium,
    slopes: Slopes,
    radius: float,
    options: ReachOptions,
    curvature: FloatArray,
    by_body: bool,
) -> Step:
    """Return the step that minimises the quadratic model, with the estimated curvature, in the trust region."""
    u, miss = efforts_of(state), goal.miss(state.positions)
    J, W = slopes.points, slopes.wound
    moved = slopes.body if by_body else np.linalg.norm(J, axis=0)
    farthest = float(moved.max(initial=0.0))
    if not farthest > 0.0:  # the points are clamped
        return Step(np.zeros(len(u)), 0.0, 0.0)
    unit = body.reach / np.maximum(moved, WEAKEST * farthest)
    scaled = J * unit
    top = max(float(np.linalg.norm(scaled, 2)) ** 2, 1e-300) if scaled.size else 1.0
    low, high = np.minimum((bounds.low - u) / unit, 0.0), np.maximum((bounds.high - u) / unit, 0.0)
    G, h, names = bounds.rows(W * unit, wound_up(body, state), np.maximum(low, -radius), np.minimum(high, radius))
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
        return Step(np.zeros(len(u)), 0.0, 0.0)
    change = np.asarray(answer.x)
    box = zip(answer.multipliers.z_box, low, high)
    active = [
        (abs(float(z)), i, "least" if z < 0 else "largest") for i, (z, a, b) in enumerate(box) if abs(a if z < 0 else b) < radius
    ]
    active += [(float(z), i, which) for z, (i, which) in zip(answer.multipliers.z, names)]
    gain = float(2.0 * miss @ scaled @ change - change @ squares @ change)
    shown = tuple(sorted((limit for limit in active if limit[0] > ACTIVE), reverse=True))
    return Step(unit * change, float(np.abs(change).max(initial=0.0)), gain, shown)


def _learned(body: BodyModel, goal: Goal, slopes: Slopes, state: Equilibrium, tried: Equilibrium) -> Slopes:
    """Return the tangent updated with the step between two states."""
    moved = goal.miss(state.positions) - goal.miss(tried.positions)
    return slopes.learned(efforts_of(tried) - efforts_of(state), moved, wound_up(body, tried) - wound_up(body, state))


def efforts_of(state: Equilibrium) -> FloatArray:
    """Return tensions [N], then pressures [Pa], shape (a + c,)."""
    return np.array([*state.tension.values(), *state.pressure.values()])


def wound_up(body: BodyModel, state: Equilibrium) -> FloatArray:
    """Return the length wound up by each motor [m], shape (a,): the cable's shortening and its stretch."""
    stretch = [state.tension[cable.name] / cable.stretch_stiffness for cable in body.cables]
    return np.asarray(np.array(list(state.shortening.values())) + np.array(stretch))


def _solved(
    body: BodyModel,
    goal: Goal,
    effort: FloatArray,
    start: Equilibrium | None,
    before: tuple[FloatArray, ...] | None,
    tolerance: float = COARSE,
    *,
    tried: bool = False,
) -> Equilibrium:
    """Return the equilibrium under efforts (a + c,);
    `before` are the tensions along the cables before the motion, for friction."""
    a, fine, lent = len(body.cables), tolerance <= FINE, start is not None and has_factorisation(body, start)
    return solve_equilibrium(
        body,
        tension=dict(zip(body.cable_names, effort[:a].tolist())),
        pressure=dict(zip(body.chamber_names, effort[a:].tolist())),
        nodal_forces=goal.nodal_forces,
        start=start,
        bilateral=True,
        options=SolveOptions(
            before=before,
            relative_tolerance=tolerance,
            rough=tried and not fine,
            single=fine,
            reuse_factor=lent,
        ),
    )


def _begin(body: BodyModel, goal: Goal, bounds: Limits, start: Equilibrium | None) -> Equilibrium:
    """Return the initial state, within the limits of efforts."""
    effort = np.zeros(len(bounds.low)) if start is None else efforts_of(start)
    before = None if start is None else start.segment_tensions
    return _solved(body, goal, np.clip(effort, bounds.low, bounds.high), start, before)


def _is_better(body: BodyModel, goal: Goal, bounds: Limits, tried: Equilibrium, state: Equilibrium) -> bool:
    """Return whether a state has a smaller merit: squared error plus an exact penalty on violated length limits, proportional to
    the current distance."""
    weight = PENALTY * float(np.linalg.norm(goal.miss(state.positions)))

    def merit(one: Equilibrium) -> float:
        return float((goal.miss(one.positions) ** 2).sum()) + weight * bounds.violation(wound_up(body, one))

    return merit(tried) < merit(state)
