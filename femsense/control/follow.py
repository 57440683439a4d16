"""Inputs for a target that moves, such as a point that a hand drags: each answer goes on where the last one ended.

A search of `reach` starts anew with each target, and ends at its answer. Here state, slopes, trust region and curvature stay.
An answer is one equilibrium further on, or as many as its time allows; it says whether it still converges.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.control.found import found
from femsense.control.goal import Goal, Target, make_goal
from femsense.control.limits import make_limits
from femsense.control.motion import CONVERGING, REACHED, Motion
from femsense.control.search import ReachOptions, Search
from femsense.model.robot import Robot


class Follower:
    """Brings points of a robot towards places that change, within limits."""

    def __init__(
        self,
        robot: Robot,
        *,
        control: str = "tension",
        limits: Mapping[str, tuple[float, float]] | None = None,
        calibration: Calibration | None = None,
        options: ReachOptions | None = None,
    ) -> None:
        """Begin at rest.

        Arguments:
            robot: with its effects; its cables' and chambers' limits hold.
            control: what is commanded of the cables: "tension" [N] or "displacement" [m].
            limits: cable → (least, largest) command [N or m], chamber → pressure [Pa], beside those of the robot.
            calibration: its initial inputs are taken off the commands.
            options: when a search ends; an empirical correction is left out.

        Raises:
            InputError: an unknown cable or control, limits the wrong way round.
        """
        self.robot, self.control, self.calibration = robot, control, calibration
        self.options = options or ReachOptions()
        self._bounds = make_limits(robot, control, limits or {}, calibration)
        self._search: Search | None = None
        self._other: Search | None = None
        self._compared = False  # with what a search from rest finds

    @property
    def resting(self) -> bool:
        """Whether further steps towards the same target change nothing."""
        search = self._search
        return search is not None and bool(search.status) and (search.status == REACHED or self._compared)

    def step(self, target: Target, *, seconds: float = 0.0) -> Motion:
        """Go on towards a target, and return where that has led so far.

        Where the way has ended elsewhere than at the target, and the target stays, further steps seek it from rest too;
        what they find is taken where it is nearer.

        Arguments:
            target: as `reach` takes it.
            seconds: no further equilibrium is begun after so long [s]; one is solved in any case.

        Returns:
            the motion; "converging" where more steps come nearer.

        Raises:
            InputError: an unknown marker, or a target that is no place.
        """
        end = time.perf_counter() + seconds
        search = self._advanced(self._aimed(make_goal(self.robot, target, (), ())))
        while not self.resting and time.perf_counter() < end:
            search = self._advanced(search)
        return found(self.robot, self.control, search, search.status or CONVERGING, self.calibration)

    def _aimed(self, goal: Goal) -> Search:
        """Return the search for a goal: the last one, turned to it where the same points are wanted."""
        last = self._search
        if last is not None and last.state.converged and last.serves(goal):
            if not np.array_equal(last.goal.wanted, goal.wanted):
                last.aim(goal)
                self._other, self._compared = None, False
            return last
        start = last.state if last is not None and last.state.converged else None
        self._search = Search(self.robot.body, goal, self._bounds, start, self.options)
        self._other, self._compared = None, start is None
        return self._search

    def _advanced(self, search: Search) -> Search:
        """Solve one equilibrium further on, from rest where the search itself is over."""
        if not search.status:
            search.advance()
            return search
        if self.resting:
            return search
        other = self._other = self._other or Search(self.robot.body, search.goal, self._bounds, None, self.options)
        other.advance()
        self._compared = bool(other.status)
        nearer = search.goal.error(search.state.positions) - search.goal.error(other.state.positions)
        if self._compared and nearer > self.options.tolerance_m:
            self._search = search = other
        return search
