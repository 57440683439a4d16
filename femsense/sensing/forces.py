"""Forces at places: equilibrium → rays → compliance → QP, until the forces stop changing.

Every step is a Gauss–Newton step of one least-squares problem (`force_step`). The last QP holds the friction cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.scan import Scan
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.sensing.force_step import ForceStep, Iterate, Linearisation, linearise, misfit_beside, prior_cost
from femsense.sensing.measurement_rows import rows_at
from femsense.sensing.nuisance import misfit_of, nuisance_columns
from femsense.sensing.responses import response_at
from femsense.sensing.states import solve_with
from femsense.sensing.touches import moved_to, pressed, touch_normal, within_cones
from femsense.sensing.types import Fit, Response, Sensor, Start, Touch

TRIES = 6
"""How often a step is made shorter where it leads too far: first along what the rows hardly determine."""
SLIGHT = 1e-4
"""A step that lowered the cost by less than this share of it is the last one."""


def no_forces(sensor: Sensor, k: int, scan: Scan | None, state: Equilibrium, near: Response | None = None) -> Fit:
    """Return the fit of a frame without contacts; `near` is a response at hand, which is taken where it was made near by."""
    rows = rows_at(sensor, k, scan, state)
    response = response_at(sensor, state, near)
    columns, known = nuisance_columns(sensor.knowledge, rows, response.sag)
    cost = misfit_of(rows.residual - known, columns, rows)[0]
    return Fit((), state, np.zeros((0, 3)), np.zeros((0, 0)), np.zeros((0, 3, 3)), rows, cost, response=response)


def fit_forces(
    sensor: Sensor,
    k: int,
    scan: Scan | None,
    touches: Sequence[Touch],
    free: Fit,
    *,
    start: Start | None = None,
    before: tuple[FloatArray, ...] | None = None,
) -> Fit:
    """Return the forces at some places that explain frame k best.

    Arguments:
        touches: where forces may act.
        free: the fit without them, from which it begins.
        start: a state near by with the forces in it; taken where it explains the frame better than the free state.
        before: tensions along the cables until now (friction).

    Raises:
        DataError: nothing is seen, or the force problem has no answer.
    """
    frame = _Frame(sensor, k, scan, before)
    here, linear = frame.best_start(touches, free, start)
    near = start is not None and start.firm and here.state is not free.state
    converged = False
    for firm in ((True,) if near else (False, True)) if here.rows.of_clouds else (False,):
        here, linear, step, again = frame.settle(here, linear, firm)
        converged = converged or again
    return frame.fit_of(here, linear, step, converged)


def _hardly_moves(sensor: Sensor, here: Iterate, step: ForceStep) -> bool:
    """Return whether a step changes forces by less than they are known, and places by less than the mesh shows."""
    small = 0.05 * step.force_std + 2e-3 * max(float(np.abs(step.forces).max()), 1e-3)
    still = (np.abs(step.forces - here.forces) < small[:, None]).all()
    return bool(still and (np.abs(step.shift) < 0.1 * sensor.surface.edge).all())


@dataclass(frozen=True, eq=False, slots=True)
class _Frame:
    """The frame whose forces are sought."""

    sensor: Sensor
    k: int
    scan: Scan | None
    before: tuple[FloatArray, ...] | None

    def best_start(self, touches: Sequence[Touch], free: Fit, start: Start | None) -> tuple[Iterate, Linearisation]:
        """Return the free state, or the given start where that explains the frame better. Raises DataError."""
        m, sensor = len(touches), self.sensor
        here = Iterate(tuple(touches), np.zeros((m, 3)), free.state, free.rows, np.full(m, sensor.options.force_std_n))
        warm = None if start is None or len(start.forces) != m else self._from_start(here, free, start)
        if warm is not None:
            return warm
        return here, linearise(sensor, here, free.response)

    def _from_start(self, here: Iterate, free: Fit, start: Start) -> tuple[Iterate, Linearisation] | None:
        """Return a given start where it costs less than the free state, which need not be linearised then."""
        forces = within_cones(self.sensor, here.touches, start.forces, start.state)
        touches = tuple(pressed(self.sensor, touch, force) for touch, force in zip(here.touches, forces))
        there = self._settled(replace(here, touches=touches, forces=forces, state=start.state))
        if there is None:
            return None
        cost = free.cost + prior_cost(here, np.zeros((len(forces), 3)))
        normals = np.array([touch_normal(self.sensor, touch, there.state) for touch in there.touches])
        known = free.response
        if known is not None and misfit_beside(self.sensor, there.rows, known.sag) + prior_cost(there, normals) >= cost:
            return None
        linear = linearise(self.sensor, there, start.response)
        return (there, linear) if linear.cost(there) < cost else None

    def settle(self, here: Iterate, linear: Linearisation, firm: bool) -> tuple[Iterate, Linearisation, ForceStep, bool]:
        """Return where steps lead that lower the cost, the step from there, and whether they had become small (`firm`: see `robust_std`)."""
        step, trust = linear.step(self.sensor, here, firm=firm), 1.0
        for _ in range(self.sensor.options.iterations):
            here = replace(here, sizes=step.sizes)
            cost = linear.cost(here)
            if _hardly_moves(self.sensor, here, step):
                return here, linear, step, True
            better, trust = self.descend(here, linear, step, trust, firm)
            if better is None:
                break
            gain = cost - better[1].cost(better[0])
            here, linear = better
            step = linear.step(self.sensor, here, firm=firm)
            if gain < SLIGHT * (cost - gain):
                return here, linear, step, True
        return here, linear, step, False

    def descend(
        self, here: Iterate, linear: Linearisation, step: ForceStep, trust: float, firm: bool
    ) -> tuple[tuple[Iterate, Linearisation] | None, float]:
        """Return where a step leads that costs less, and how far the next one is trusted; None where all lead too far."""
        for _ in range(TRIES):
            shorter = step if trust >= 1.0 else linear.step(self.sensor, here, trust, firm=firm)
            better = self._where_it_costs_less(_moved(self.sensor, here, linear, shorter), here, linear)
            if better is not None:
                return better, min(4.0 * trust, 1.0)
            trust *= 0.2
        return None, trust

    def _where_it_costs_less(self, there: Iterate, here: Iterate, at: Linearisation) -> tuple[Iterate, Linearisation] | None:
        """Return an iterate with its equilibrium, rows and linearisation; None where it has none or costs more than one that was linearised."""
        cost, settled = at.cost(here), self._settled(there)
        if settled is None or at.cost_beside(self.sensor, settled) >= cost:
            return None
        linear = linearise(self.sensor, settled, at.response)
        return (settled, linear) if linear.cost(settled) < cost else None

    def _settled(self, there: Iterate) -> Iterate | None:
        """Return an iterate with its equilibrium and rows; None where it has none."""
        try:
            state = solve_with(self.sensor, self.k, there.touches, there.forces, there.state, before=self.before, tried=True)
            forces = within_cones(self.sensor, there.touches, there.forces, state)
            if not np.array_equal(
                forces, there.forces
            ):  # the surface has turned: outside its cone a force could explain more than any within
                state = solve_with(self.sensor, self.k, there.touches, forces, state, before=self.before, tried=True)
            return replace(there, forces=forces, state=state, rows=rows_at(self.sensor, self.k, self.scan, state))
        except DataError:
            return None

    def fit_of(self, here: Iterate, linear: Linearisation, step: ForceStep, converged: bool) -> Fit:
        """Return an iterate as a fit, its state exact. Raises DataError."""
        state = solve_with(self.sensor, self.k, here.touches, here.forces, here.state, before=self.before)
        sizes = np.full(len(here.touches), self.sensor.options.force_std_n)
        return Fit(
            here.touches,
            state,
            freeze(here.forces),
            freeze(step.covariance),
            freeze(step.place_covariance),
            here.rows,
            linear.cost(replace(here, sizes=sizes)),
            converged,
            linear.response,
        )


def _moved(sensor: Sensor, here: Iterate, linear: Linearisation, step: ForceStep) -> Iterate:
    """Return where a step leads, with a start for its state that the tangent foretells."""
    touches = []
    for touch, frame, way in zip(here.touches, linear.frames, step.shift):
        if way.any():
            touch = moved_to(sensor, touch, touch.place + way @ frame)
        touches.append(touch)
    forces = within_cones(sensor, tuple(touches), here.forces + (step.forces - here.forces), here.state)
    touches = [pressed(sensor, touch, force) for touch, force in zip(touches, forces)]
    move = np.tensordot((forces - here.forces).ravel(), linear.moves, axes=1)
    factor = linear.response.tangent.factor if linear.response.tangent.factor.negative == 0 else None
    state = replace(here.state, positions=here.state.positions + move, factor=factor)
    return Iterate(tuple(touches), forces, state, here.rows, here.sizes)
