"""Robot and surroundings apart: by colour where there is some, else by what explains the shape."""

from __future__ import annotations

import numpy as np

from femsense.calib.scan import REACH, Scan, parted
from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.pointcloud.rays import Surface
from femsense.sensing.forces import no_forces
from femsense.sensing.judge import left_over
from femsense.sensing.measurement_rows import seen_through
from femsense.sensing.places import given_touches, said_free
from femsense.sensing.prepare import condensed_at
from femsense.sensing.search import attempt, better, find_hidden, start_from, with_hidden
from femsense.sensing.states import foretold
from femsense.sensing.types import Fit, SensedFrame, Sensor, Start

Before = tuple[FloatArray, ...] | None
Seen = tuple[Scan, Fit]
"""What is the robot's with neighbouring points averaged, and the fit without forces to it."""

MOST_ROUNDS = 5
"""How often robot and surroundings are separated at most."""
SETTLED = 0.005
"""They are separated where the number of the robot's points changes by less than this share of it."""
KEPT = 0.9
"""What explains a frame as the one before shows this share of the points that matched there: else part of the robot was taken for something else.
On `slab-gray` any value gives the same (docs/forces.md)."""
SOME = 500
"""Points that tell which of two states is closer to all of them."""


def segmented(
    sensor: Sensor, k: int, scan: Scan | None, alone: Equilibrium, previous: SensedFrame | None, before: Before
) -> tuple[Scan | None, Fit]:
    """Return the scan with robot and surroundings apart, neighbouring points averaged, and the fit without forces to what is the robot's.

    Where colour has not separated them, the shape is explained first; what then lies off the surface is something else.

    Arguments:
        scan: every point that was measured.
        alone: the state without forces.
        previous: the frame before.
        before: tensions along the cables until now (friction).
    """
    response, near = None if previous is None else previous.free_response, foretold(previous, alone)
    if scan is None:
        return None, no_forces(sensor, k, None, alone, response)
    frame = _Colourless(sensor, k, scan, alone, previous, before)
    if not scan.segmented and not len(sensor.places):
        return frame.as_before(near) or frame.anew()
    few = condensed_at(sensor, scan, near if _closer(sensor, scan, near, alone) else alone)
    if not scan.segmented:
        return frame.with_given_places(few)
    return few, no_forces(sensor, k, few, alone, response)


class _Colourless:
    """One frame whose points no colour tells."""

    def __init__(
        self, sensor: Sensor, k: int, scan: Scan, alone: Equilibrium, previous: SensedFrame | None, before: Before
    ) -> None:
        self.sensor, self.k, self.scan, self.alone, self.previous, self.before = sensor, k, scan, alone, previous, before
        self.response = None if previous is None else previous.free_response

    def as_before(self, near: Equilibrium) -> Seen | None:
        """Return what the contacts of the frame before show of the robot; None where they do not explain this one, or show less of it.

        They have to be earned anew: where the points lie closer to the state without forces, what touched is gone, or going. Separated by
        a state that it makes no more, points of the body would be taken for an object beside it, and the rest would show a force.
        """
        sensor, previous = self.sensor, self.previous
        if previous is None or near is self.alone or not _closer(sensor, self.scan, near, self.alone):
            return None
        few, free = self.seen_at(near)
        start = Start(near, previous.forces, previous.response, firm=True)
        fit = attempt(sensor, self.k, few, previous.touches, free, start, self.before)
        if fit is None or fit.cost >= free.cost or left_over(sensor, fit) > sensor.knowledge.misfit_limit:
            return None
        few, free = self.seen_at(fit.state)
        whole = few.measured.sum() >= KEPT * previous.report.matched
        return (few, free) if whole and self.hides_nothing(few, fit.state) else None

    def anew(self) -> Seen:
        """Return what is the robot's where nothing of the frame before is used.

        First what lies on the state without forces is explained, then what lies on the states that this leads to. Where points are left
        behind the body, as where a touch moved it far, all points are explained first.
        """
        seen = self.seen_at(self.alone)
        if said_free(self.sensor, self.k):
            return seen
        if self.hides_nothing(seen[0], self.alone) and not find_hidden(self.sensor, seen[1]):
            return seen
        near, hides_nothing = self.explained(seen)
        if hides_nothing:
            return near
        few = condensed_at(self.sensor, self.scan, self.alone)
        whole, hides_nothing = self.explained((few, no_forces(self.sensor, self.k, few, self.alone, self.response)))
        return whole if hides_nothing else near

    def explained(self, seen: Seen) -> tuple[Seen, bool]:
        """Return what is the robot's where its shape is explained by one contact, then by two, …, and whether nothing of it is left behind the body."""
        (few, free), last = seen, 0.0
        for most in range(1, MOST_ROUNDS):
            fit = with_hidden(self.sensor, self.k, few, free, free, self.before, most=most)
            few, free = self.seen_at(fit.state)
            if not fit.touches or few.measured.sum() < (1.0 + SETTLED) * last:
                break
            last = few.measured.sum()
        return (few, free), self.hides_nothing(few, fit.state)

    def with_given_places(self, few: Scan) -> Seen:
        """Return what is the robot's in the state that forces at the given places make, from all points on."""
        sensor, last = self.sensor, self.scan
        free = no_forces(sensor, self.k, few, self.alone, self.response)
        touches, state = given_touches(sensor), self.alone
        for _ in range(0 if said_free(sensor, self.k) else MOST_ROUNDS):
            start = start_from(self.previous, touches)
            fit = better(free, attempt(sensor, self.k, few, touches, free, start, self.before))
            state = fit.state
            if not fit.touches:
                break
            own = self.parted(state)
            few = condensed_at(sensor, own, state)
            free = no_forces(sensor, self.k, few, self.alone, free.response)
            if abs(len(own.view) - len(last.view)) < SETTLED * len(own.view):
                return few, free
            last = own
        return self.seen_at(state)

    def seen_at(self, state: Equilibrium) -> Seen:
        """Return what is the robot's in a state."""
        few = condensed_at(self.sensor, self.parted(state), state)
        return few, no_forces(self.sensor, self.k, few, self.alone, self.response)

    def parted(self, state: Equilibrium) -> Scan:
        sensor = self.sensor
        surface, noises = Surface(state.positions, sensor.surface.triangles), sensor.knowledge.noises
        return parted(self.scan, surface, sensor.calibration.poses, noises, reach=REACH * sensor.size)

    def hides_nothing(self, few: Scan, state: Equilibrium) -> bool:
        """Return whether no more points lie behind a state than in free frames."""
        return seen_through(self.sensor, few, state) <= self.sensor.knowledge.through_limit


def _closer(sensor: Sensor, scan: Scan, near: Equilibrium, alone: Equilibrium) -> bool:
    """Return whether most points lie closer to one state than to another: what touched in the frame before may be gone."""
    if near is alone:
        return True
    points = scan.points(sensor.calibration.poses)[:: max(1, len(scan.view) // SOME)]
    first, second = (Surface(state.positions, sensor.surface.triangles).gap(points) for state in (near, alone))
    return bool(np.median(first) <= np.median(second))
