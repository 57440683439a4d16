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
    """Inverse kinematics in real time: inputs with which points of a soft robot follow moving targets.

    Each call of `step` improves the commands of cables and chambers by one or more equilibria (a trust-region method with the compliance
    of the current state as Jacobian), within the limits of the inputs. The search for a target ends when the target is reached or when no
    step reduces the distance any more. The last state is the warm start for the next target.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> follower = fs.Follower(robot)
        >>> for height in (0.005, 0.010, 0.015):  # m, a moving target; nan: free
        ...     motion = follower.step({"tip": (np.nan, np.nan, height)}, seconds=1.0)
        >>> round(motion.inputs["flexor"], 1), motion.error_m < 1e-4  # N, m
        (0.7, True)
    """

    def __init__(
        self,
        robot: Robot,
        *,
        control: str = "tension",
        limits: Mapping[str, tuple[float, float]] | None = None,
        calibration: Calibration | None = None,
        options: ReachOptions | None = None,
    ) -> None:
        """Start from the equilibrium without inputs.

        Arguments:
            robot: the robot with its effects. The limits of its cables and chambers apply.
            control: kind of the cable commands: "tension" [N] or "displacement" [m].
            limits: name → (minimum, maximum): cable commands [N or m] and chamber pressures [Pa], in addition to the limits of the robot.
            calibration: initial inputs, which are subtracted from the commands.
            options: criteria to end a search. The empirical correction of a robot is ignored.

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
        """Restart from the equilibrium under given commands of all cables [N or m] and chambers [Pa].

        If no equilibrium is found, the follower stays at its current state.
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
        """Whether the search for the current target has ended: the target is reached, or the distance is at a local minimum."""
        return self._search is not None and bool(self._search.status)

    @property
    def resting(self) -> bool:
        """Whether the search from the state without inputs (`stays`) has ended too, so that no further step changes the result."""
        search = self._search
        return search is not None and bool(search.status) and (search.status == REACHED or self._compared)

    def step(self, target: Target, *, seconds: float = 0.0, stays: bool = False) -> Motion:
        """Take one or more steps towards a target, and return the commands so far.

        Arguments:
            target: marker or point at rest → target position [m], as for `reach`.
            seconds: time budget [s]. At least one equilibrium is solved; a reached target is always solved to full tolerance.
            stays: the target is at rest. If the search ended at a local minimum, a second search starts from the state without inputs, and the
                closer result is returned.

        Returns:
            the motion. Its status is "converging" while further steps reduce the distance.

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
