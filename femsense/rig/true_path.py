"""The true body along a plan: a quasi-static path in small steps, with its own friction and creep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import DataError
from femsense.core.text import one_line
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles
from femsense.fem.energy import energy_density
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh, embed_points
from femsense.model.robot import Robot
from femsense.model.softening import softened_share
from femsense.rig.friction import Grip, new_grip, pull
from femsense.rig.plan import Plan
from femsense.rig.presses import Hovering, Press, Presses, TrueContact, between
from femsense.rig.truth import creep_matrix, true_inputs

SETTLED = 1e-8
"""Tensions along the cables and contact forces have converged if an iteration changes them by less than this [N]."""
SETTLED_HELD = 1e-6
"""The same for held cables, whose tensions follow from the equilibrium to its tolerance [N]."""
PASSES = 200
SHORTEST = 0.05
"""Smallest step of the fixed-point iteration for contact forces, as a share of the full step."""
SOFT = 1e-5
"""Shares of the moduli have converged if an iteration changes them by less than this."""
SLOW = 0.9
"""Ratio of consecutive changes of a held cable beyond which the series is extrapolated."""
FAR, NEARER = float(np.log(2.0)), 0.7
"""Largest extrapolation of the logarithm of a tension at first, and factor by which this decreases."""
TINY = 1e-12
"""Tensions below this count as zero [N]."""
FINER = 4
"""A frame that does not converge is repeated with this multiple of the substeps."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueFrame:
    """The true state in one frame."""

    state: Equilibrium
    motor: FloatArray
    """Inputs at the motors after all effects [N] or [m], shape (a,)."""
    contacts: tuple[TrueContact, ...]
    hovering: tuple[Hovering, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Memory:
    """The history-dependent state of the body."""

    state: Equilibrium
    grips: list[Grip]
    """Friction states of the bends of each cable."""
    most: FloatArray
    """Largest energy density so far in each element [J/m³], shape (m,)."""


@dataclass(frozen=True, eq=False, slots=True)
class Course:
    """Progress along a path."""

    frames: tuple[tuple[int, TrueFrame], ...] = ()
    """Index and true state of the converged frames."""
    skipped: tuple[tuple[int, str], ...] = ()
    """Index of the frames that did not converge, with the reason."""
    memory: Memory | None = field(default=None)

    @property
    def done(self) -> int:
        """Number of completed frames, converged or not."""
        return len(self.frames) + len(self.skipped)


@dataclass(frozen=True, eq=False, slots=True)
class _Load:
    """The loads at one moment."""

    inputs: FloatArray  # (a,)
    forces: FloatArray  # known loads, (n, 3) N
    contact: tuple[Press, ...]
    gravity: FloatArray  # (3,)
    pressures: FloatArray  # (p,) Pa

    def towards(self, other: _Load, part: float) -> _Load:
        inputs, forces, gravity, pressures = (
            a + part * (b - a)
            for a, b in ((getattr(self, f), getattr(other, f)) for f in ("inputs", "forces", "gravity", "pressures"))
        )
        contact = other.contact if part == 1.0 else between(self.contact, other.contact, part)
        return _Load(inputs, forces, contact, gravity, pressures)


def true_path(robot: Robot, plan: Plan, *, substeps: int = 3) -> list[TrueFrame]:
    """Return the true state of every frame.

    Arguments:
        robot: see `true_robot`.
        plan: the inputs and loads.
        substeps: steps from frame to frame; inputs and loads are interpolated linearly.

    Raises:
        DataError: no equilibrium.
    """
    path = TruePath(robot, plan, Path())
    return [path.frame(k, substeps) for k in range(len(plan.time_s))]


def true_course(
    robot: Robot, plan: Plan, *, substeps: int = 3, folder: Path = Path(), kept: Course | None = None
) -> Iterator[Course]:
    """Yield the progress after each frame; a frame that does not converge is skipped, and the path continues from
    the one before.

    Arguments:
        robot, plan, substeps: as of `true_path`.
        folder: of the object meshes.
        kept: progress of an interrupted call; the continuation gives bit-identical results.
    """
    course = kept or Course()
    path = TruePath(robot, plan, folder)
    if course.memory is not None:
        path.go_on_from(course)
    for k in range(course.done, len(plan.time_s)):
        memory = path.memory()
        try:
            frame = _tried(path, k, substeps, memory)
            course = replace(course, frames=(*course.frames, (k, frame)))
        except DataError as error:
            path.remember(memory)
            course = replace(course, skipped=(*course.skipped, (k, one_line(error))))
        course = replace(course, memory=path.memory())
        yield course


def _tried(path: TruePath, k: int, substeps: int, memory: Memory) -> TrueFrame:
    try:
        return path.frame(k, substeps)
    except DataError:
        path.remember(memory)
        return path.frame(k, FINER * substeps)


class TruePath:
    """The true state, advanced step by step; the bodies that are solved have no friction, but given tensions along their cables."""

    def __init__(self, robot: Robot, plan: Plan, folder: Path) -> None:
        self.control = plan.control
        self.plan = plan
        self.friction = [cable.friction for cable in robot.body.cables]
        self.creep = robot.creep
        self.pressures = robot.actuation.pressure_gain * plan.pressures + robot.actuation.pressure_offset
        self.body = robot.body.with_cables(tuple(replace(cable, friction=0.0) for cable in robot.body.cables))
        self.presses = Presses(robot.body, plan, folder)
        self.grips = [new_grip(len(cable.path)) for cable in robot.body.cables]
        self.state = solve_equilibrium(self.body)
        self.softening = robot.softening
        self.most = energy_density(self.body, self.state.positions)
        self.inputs = true_inputs(robot, plan)
        self.creeping = creep_matrix(plan.time_s, self.creep)
        self.known = _known_loads(self.body.mesh, plan, self.creeping)
        self.last = self._nothing()

    def frame(self, k: int, substeps: int) -> TrueFrame:
        """Return the true state of frame k, consecutively. Raises DataError."""
        load = self._load(k)
        self.state = replace(self.state, factor=None)  # as after a restart from a checkpoint
        for step in range(1, substeps + 1):
            self.go(self.last.towards(load, step / substeps), k)
        self.last = load
        x = self.state.positions
        contacts = self.presses.contacts(load.contact, x)
        return TrueFrame(replace(self.state, factor=None), freeze(self.inputs[k]), contacts, self.presses.hovering(k, x))

    def memory(self) -> Memory:
        """Return the history-dependent state."""
        return Memory(replace(self.state, factor=None), list(self.grips), self.most)

    def remember(self, memory: Memory) -> None:
        """Restore a history-dependent state."""
        self.state, self.grips, self.most = memory.state, list(memory.grips), memory.most

    def go_on_from(self, course: Course) -> None:
        """Continue from the end of an earlier path."""
        assert course.memory is not None
        self.remember(course.memory)
        if course.frames:
            self.last = self._load(course.frames[-1][0])

    def _nothing(self) -> _Load:
        """Return the load at rest: the body's own weight."""
        gravity = self.body.gravity if self.plan.gravity is None else self.plan.gravity[0]
        return _Load(
            np.zeros(len(self.friction)),
            np.zeros((len(self.body.mesh.nodes), 3)),
            (),
            np.asarray(gravity),
            np.zeros(len(self.body.chambers)),
        )

    def _load(self, k: int) -> _Load:
        """Return the loads in frame k."""
        gravity = self.body.gravity if self.plan.gravity is None else self.plan.gravity[k]
        known = self.known.get(k, np.zeros((len(self.body.mesh.nodes), 3)))
        return _Load(self.inputs[k], known, self.presses.at(k), gravity, (self.creeping @ self.pressures)[k])

    def go(self, load: _Load, frame: int) -> None:
        """Advance to a load; state, tensions along the cables and contact forces are consistent at the end."""
        whole = self.body if self.plan.gravity is None else self.body.with_gravity(load.gravity)
        passes, far = [self._motors(load)], FAR
        pressed = FixedPoint(self._contact_forces(load))
        for _ in range(PASSES):
            ahead = creep_ahead(passes, far)
            motors = passes[-1] if ahead is None else ahead
            passes, far = (passes, far) if ahead is None else ([], NEARER * far)
            along, _ = self._along(motors)
            shares = self._shares()
            body = whole if shares is None else whole.with_stiffness_scale(shares)
            forces = load.forces + pressed.value
            self.state = self._solve(body, load, motors, along, forces, frame)
            soft = self._shares()
            same = soft is None or shares is None or bool(np.abs(soft - shares).max() < SOFT)
            if same and self._settled(load, along, forces):
                self.most = np.maximum(self.most, energy_density(self.body, self.state.positions))
                # of the converged state: while bends slide, every tension at the motor gives the same shares
                self.grips = self._along(self._motors(load))[1]
                return
            passes.append(self._motors(load))
            pressed.step(self._contact_forces(load))
        raise DataError(
            f"the true state of frame {frame} does not converge: friction and contact keep changing; use more substeps"
        )

    def _shares(self) -> FloatArray | None:
        """Return the softened share of each element's modulus, after its largest energy density so far, (m,); None: no softening."""
        if not self.softening:
            return None
        now = energy_density(self.body, self.state.positions)
        return softened_share(self.softening, np.maximum(self.most, now), now)

    def _motors(self, load: _Load) -> FloatArray:
        """Return the tensions at the motors [N], shape (a,); of held cables those of the last state."""
        return load.inputs if self.control == "tension" else np.array(list(self.state.tension.values()))

    def _along(self, motors: FloatArray) -> tuple[list[FloatArray], list[Grip]]:
        """Return the tensions along each cable [N], far end first, and the friction states that follow."""
        tensions, grips = [], []
        for cable, grip, friction, motor in zip(self.body.cables, self.grips, self.friction, motors):
            bends = bend_angles(cable, self.state.positions)[::-1]
            behind, now = pull(grip, max(float(motor), 0.0), bends, friction)
            tensions.append(behind[::-1])
            grips.append(now)
        return tensions, grips

    def _solve(
        self, body: BodyModel, load: _Load, motors: FloatArray, along: list[FloatArray], forces: FloatArray, frame: int
    ) -> Equilibrium:
        names = body.cable_names
        values = {name: float(v) for name, v in zip(names, load.inputs)}
        motor = {name: float(v) for name, v in zip(names, motors)}
        start = replace(self.state, tension=motor)
        shares = tuple(t / motor[n] if motor[n] > 0 else np.ones_like(t) for n, t in zip(names, along))
        tension, held = (values, None) if self.control == "tension" else (None, values)
        pressure = dict(zip(body.chamber_names, load.pressures.tolist()))
        state = solve_equilibrium(
            body,
            tension=tension,
            shortening=held,
            pressure=pressure,
            nodal_forces=forces,
            start=start,
            options=SolveOptions(along=shares, reuse_factor=True),
        )
        if not state.converged:
            raise DataError(f"the truth has no equilibrium in frame {frame}: {state.status}: {state.advice}")
        return state

    def _settled(self, load: _Load, along: list[FloatArray], forces: FloatArray) -> bool:
        """Return whether tensions and contact forces of the solution equal those assumed for it."""
        wanted, _ = self._along(self._motors(load))
        used = self.state.segment_tensions
        moved = [np.abs(w - u).max(initial=0.0) for w, u in zip(wanted, used)]
        pressed = np.abs(load.forces + self._contact_forces(load) - forces).max(initial=0.0)
        if self.control == "tension":
            return bool(max([float(pressed), *moved]) < SETTLED * max(1.0, float(np.abs(load.inputs).max(initial=0.0))))
        return bool(max([float(pressed), *moved]) < SETTLED_HELD)

    def _contact_forces(self, load: _Load) -> FloatArray:
        return self.presses.total(load.contact, self.state.positions)


class FixedPoint:
    """Solves x = g(x); the step length is extrapolated from the last two (vector Aitken; Irons & Tuck 1969), at most a full step."""

    def __init__(self, value: FloatArray) -> None:
        self.value = value
        self._missed: FloatArray | None = None
        self._share = 1.0

    def step(self, wanted: FloatArray) -> None:
        """Advance, given g of the current value."""
        missed = wanted - self.value
        if self._missed is not None:
            change = missed - self._missed
            square = float((change**2).sum())
            ahead = -self._share * float((self._missed * change).sum()) / square if square > 0.0 else 1.0
            self._share = float(np.clip(ahead, SHORTEST, 1.0))
        self.value, self._missed = self.value + self._share * missed, missed


def creep_ahead(passes: list[FloatArray], far: float) -> FloatArray | None:
    """Return the extrapolated tensions at the motors [N], (a,); None without slow convergence.

    While the bends of a held cable stick, the tension behind them is constant, and the tension at the motor changes by nearly the same
    small ratio in every iteration, until they slide. If the logarithms of three iterations form a geometric series, its limit is taken
    (Aitken 1926), within `far` in the logarithm.
    """
    if len(passes) < 3:
        return None
    first, second, last = np.log(np.maximum(passes[-3:], TINY))
    before, step = second - first, last - second
    ratio = np.divide(step, before, out=np.zeros_like(step), where=before != 0.0)
    slow = (ratio > SLOW) & (ratio < 1.0 / SLOW)
    whole = np.clip(step * ratio / np.maximum(1.0 - ratio, TINY), -far, far)
    return passes[-1] * np.exp(np.where(slow, whole, 0.0)) if slow.any() else None


def _known_loads(mesh: TetMesh, plan: Plan, creep: FloatArray) -> dict[int, FloatArray]:
    """Return the nodal forces of the known loads, creep included: frame → (n, 3)."""
    if not len(plan.load_frame):
        return {}
    places, number = np.unique(plan.load_points, axis=0, return_inverse=True)
    table = np.zeros((len(plan.time_s), len(places), 3))
    np.add.at(table, (plan.load_frame, number.ravel()), plan.load_forces)
    crept = np.einsum("fg,gpc->fpc", creep, table)
    ties = embed_points(mesh, places)
    return {k: ties.spread(crept[k], len(mesh.nodes)) for k in range(len(crept))}
