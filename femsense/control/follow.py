"""Inputs for a moving target, such as a dragged point: each result continues from the previous one.

`reach` starts a new search for each target and runs it to its end. Here state, tangent, trust region and curvature persist, and each call solves one more
equilibrium, or as many as its time allows; the status states whether it is still converging.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.control.found import found
from femsense.control.goal import Goal, Target, make_goal
from femsense.control.limits import make_limits, true_input
from femsense.control.motion import CONVERGING, REACHED, Motion
from femsense.control.search import Pace, ReachOptions, Search
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.model.robot import Robot

PACE = Pace(farthest=0.02, by_body=True, sure_gain=1e-3, faithful=0.5, tolerance=1e-4, least_m=1e-5)
"""Step parameters while a hand drags. Steps of 0.05 take twice the processor time on the four-leg robot (47 instead of 24 ms), because each needs
its own stiffness. Without `least_m` the gripper pulls its other finger to the limit for micrometres."""


class Follower:
    """Inputs that move points of a robot towards changing targets, one step per call, within limits."""

    def __init__(
        self,
        robot: Robot,
        *,
        control: str = "tension",
        limits: Mapping[str, tuple[float, float]] | None = None,
        calibration: Calibration | None = None,
        options: ReachOptions | None = None,
    ) -> None:
        """Start at rest.

        Arguments:
            robot: with its effects; its cables' and chambers' limits hold.
            control: kind of the cable commands: "tension" [N] or "displacement" [m].
            limits: cable → (least, largest) command [N or m], chamber → pressure [Pa], in addition to those of the robot.
            calibration: its initial inputs are subtracted from the commands.
            options: criteria to end a search; an empirical correction is ignored.

        Raises:
            InputError: an unknown cable or control, or reversed limits.
        """
        self.robot, self.control, self.calibration = robot, control, calibration
        self.options = options or ReachOptions()
        self._bounds = make_limits(robot, control, limits or {}, calibration)
        self._start: Equilibrium | None = None
        self._search: Search | None = None
        self._other: Search | None = None
        self._compared = False  # whether a search from rest was compared

    def begin(self, inputs: Mapping[str, float]) -> None:
        """Restart at the equilibrium under given inputs: commands of all cables [N or m] and chambers [Pa].

        If they have no equilibrium, nothing changes.
        """
        body = self.robot.body
        true = {
            name: max(true_input(self.robot, self.control, i, inputs[name], self.calibration), 0.0)
            for i, name in enumerate(body.cable_names)
        }
        zeros = {} if self.calibration is None else self.calibration.chamber_pressure_pa
        state = solve_equilibrium(
            body,
            tension=true if self.control == "tension" else None,
            shortening=true if self.control == "displacement" else None,
            pressure={name: inputs[name] + zeros.get(name, 0.0) for name in body.chamber_names},
            start=None if self._search is None else self._search.state,
        )
        if state.converged:
            self._start, self._search = state, None

    @property
    def ended(self) -> bool:
        """Whether the search has ended: further steps change nothing, except with `stays`, which also searches from rest."""
        return self._search is not None and bool(self._search.status)

    @property
    def resting(self) -> bool:
        """Whether further steps towards the same target change nothing, with `stays` too."""
        search = self._search
        return search is not None and bool(search.status) and (search.status == REACHED or self._compared)

    def step(self, target: Target, *, seconds: float = 0.0, stays: bool = False) -> Motion:
        """Continue towards a target, and return the motion so far.

        Arguments:
            target: as `reach` takes it.
            seconds: time after which no further equilibrium is started [s], except to solve the final state to full tolerance; at least one
                is solved.
            stays: the target will not move. If the search has ended elsewhere, further steps also search from rest, and a closer
                result is taken.

        Returns:
            the motion; its status is "converging" while further steps reduce the error.

        Raises:
            InputError: an unknown marker, or an invalid target.
        """
        end = time.perf_counter() + seconds
        search = self._advanced(self._aimed(make_goal(self.robot, target, (), ())), stays)
        while not (self.resting if stays else self.ended) and (time.perf_counter() < end or self._is_there(search)):
            search = self._advanced(search, stays)
        return found(self.robot, self.control, search, search.status or CONVERGING, self.calibration)

    def _is_there(self, search: Search) -> bool:
        """Return whether the target is reached within the tolerance, by a state that may not be solved to full tolerance yet."""
        return search.state.converged and search.goal.error(search.state.positions) <= self.options.tolerance_m

    def _aimed(self, goal: Goal) -> Search:
        """Return the search for a goal: the current one with new targets if the points are the same, else a new one."""
        last = self._search
        if last is not None and last.state.converged and last.serves(goal):
            if not np.array_equal(last.goal.wanted, goal.wanted):
                last.aim(goal)
                self._other, self._compared = None, False
            return last
        start = last.state if last is not None and last.state.converged else self._start
        self._search = Search(self.robot.body, goal, self._bounds, start, self.options, pace=PACE)
        self._other, self._compared = None, start is None
        return self._search

    def _advanced(self, search: Search, stays: bool) -> Search:
        """Solve one more equilibrium; after the search has ended, one of the search from rest."""
        if not search.status:
            search.advance()
            return search
        if self.resting or not stays:
            return search
        other = self._other = self._other or Search(self.robot.body, search.goal, self._bounds, None, self.options, pace=PACE)
        other.advance()
        self._compared = bool(other.status)
        nearer = search.goal.error(search.state.positions) - search.goal.error(other.state.positions)
        if self._compared and nearer > self.options.tolerance_m:
            self._search = search = other
        return search
