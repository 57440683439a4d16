"""The true body: another mesh and law than the estimator's, its own friction and creep, on a quasi-static path along a plan in small steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import DataError, InputError
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles
from femsense.fem.energy import energy_density
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh, embed_points, refined, surface_triangles, to_linear, to_quadratic, triangle_normals
from femsense.model.effects import apply_effects
from femsense.model.remeshing import body_on_mesh
from femsense.model.robot import Robot
from femsense.model.softening import softened_share
from femsense.rig.friction import Grip, new_grip, pull
from femsense.rig.plan import Plan
from femsense.rig.script import TruthTable

SETTLED = 1e-8
"""Tensions along the cables and contact forces rest when a pass moves them by less than this [N]."""
SETTLED_HELD = 1e-6
"""The same where cables are held: their tensions come from the balance of the body, to its tolerance [N]."""
PASSES = 200
SOFT = 1e-5
"""Shares of the moduli rest when a pass moves them by less than this."""
SLOW = 0.9
"""Share of the pass before from which on passes of a held cable are summed beforehand."""
FAR, NEARER = float(np.log(2.0)), 0.7
"""A sum may change the logarithm of a tension by so much at first, and then by a smaller and smaller share of it."""
TINY = 1e-12
"""Tensions below this are none [N]."""


@dataclass(frozen=True, eq=False, slots=True)
class LoadPatch:
    """A part of the surface that a probe presses on."""

    triangles: IntArray
    """Node indices, shape (t, 3)."""
    share: FloatArray
    """Part of the force that each triangle carries [1], shape (t,)."""

    def place(self, positions: FloatArray) -> FloatArray:
        """Return the centre of the contact patch [m], shape (3,)."""
        return np.asarray(self.share @ positions[self.triangles].mean(axis=1))

    def normal(self, positions: FloatArray) -> FloatArray:
        """Return the outward unit normal of the contact patch, shape (3,)."""
        area = self.share @ triangle_normals(positions, self.triangles)
        return np.asarray(area / np.linalg.norm(area))

    def spread(self, force: FloatArray, node_count: int) -> FloatArray:
        """Return the nodal forces of a force [N], shape (n, 3)."""
        forces = np.zeros((node_count, 3))
        for corner in range(3):
            np.add.at(forces, self.triangles[:, corner], self.share[:, None] * force / 3.0)
        return forces


@dataclass(frozen=True, eq=False, slots=True)
class TrueContact:
    """A contact in one frame."""

    contact: int
    """Which of the script's contacts."""
    place: FloatArray
    """Centre of the contact patch on the deformed body [m], shape (3,)."""
    normal: FloatArray
    """Outward unit normal there, shape (3,)."""
    force: FloatArray
    """On the body [N], shape (3,)."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueFrame:
    """The truth in one frame."""

    state: Equilibrium
    motor: FloatArray
    """Inputs at the motors after all effects [N] or [m], shape (a,)."""
    contacts: tuple[TrueContact, ...]


@dataclass(frozen=True, eq=False, slots=True)
class _Load:
    """What drives the body at one moment."""

    inputs: FloatArray  # (a,)
    forces: FloatArray  # known loads, (n, 3) N
    contact: FloatArray  # (c,) N
    gravity: FloatArray  # (3,)
    pressures: FloatArray  # (p,) Pa

    def towards(self, other: _Load, part: float) -> _Load:
        pairs = ((getattr(self, f), getattr(other, f)) for f in ("inputs", "forces", "contact", "gravity", "pressures"))
        return _Load(*(a + part * (b - a) for a, b in pairs))


# The body


def true_robot(robot: Robot, table: TruthTable, effects: Sequence[Mapping[str, Any]]) -> Robot:
    """Return the robot as it truly is.

    Arguments:
        robot: as it is declared.
        table: mesh and law of the truth.
        effects: entries as in `[[effects]]`, applied to the truth only.

    Raises:
        InputError: where an effect does not fit.
    """
    mesh = true_mesh(robot.body.mesh, table)
    body = robot.body if mesh is robot.body.mesh else body_on_mesh(robot.body, mesh)
    limit = np.inf if table.stretch_limit is None else table.stretch_limit
    body = body.with_material(replace(body.material, law=table.law, stretch_limit=limit))
    moved = replace(robot.with_body(body).with_marker_points(robot.marker_points), features=np.zeros(0, np.int64))
    for i, entry in enumerate(effects):
        try:
            moved = apply_effects(moved, [entry])
        except InputError as error:
            raise InputError(
                error.what, where=f"effects[{i}]: {error.where}", found=error.found, expected=error.expected, hint=error.hint
            ) from None
    return moved


def true_mesh(mesh: TetMesh, table: TruthTable) -> TetMesh:
    """Return the mesh of the truth; the robot's own where nothing is refined and the element is the same."""
    if not table.refinements and mesh.is_quadratic == (table.element == "tet10"):
        return mesh
    fine = to_linear(mesh)
    for _ in range(table.refinements):
        fine = refined(fine)
    return to_quadratic(fine) if table.element == "tet10" else fine


def contact_patch(mesh: TetMesh, point: Sequence[float], radius: float) -> LoadPatch:
    """Return the surface triangles around a place at rest; the pressure falls to nothing at the radius.

    Arguments:
        mesh: of the truth.
        point: on the surface at rest [m], shape (3,).
        radius: [m]; where no triangle's centre is so near, the nearest one carries all.
    """
    triangles = surface_triangles(mesh)
    distance = np.linalg.norm(mesh.nodes[triangles].mean(axis=1) - np.asarray(point), axis=1)
    area = np.linalg.norm(triangle_normals(mesh.nodes, triangles), axis=1)
    near = np.flatnonzero(distance < radius)
    if not len(near):
        near = np.array([int(distance.argmin())])
    normals = triangle_normals(mesh.nodes, triangles[near])
    near = near[normals @ normals[distance[near].argmin()] > 0]  # not the far side of a thin part
    share = area[near] * np.maximum(1.0 - (distance[near] / radius) ** 2, 1e-3)
    return LoadPatch(triangles[near], share / share.sum())


# The inputs


def true_inputs(robot: Robot, plan: Plan) -> FloatArray:
    """Return what the motors truly do in each frame [N] or [m], shape (F, a): gain, zero, play and creep of the truth."""
    act = robot.actuation
    inputs = act.gain * (plan.commanded + plan.initial)
    if act.coupling is not None:
        inputs = inputs @ (np.eye(inputs.shape[1]) + act.coupling).T
    if plan.control == "displacement":
        return np.asarray(inputs + act.displacement_offset - act.slack)
    pulled = np.where(inputs + act.tension_offset > 0, inputs + act.tension_offset, 0.0)
    return creep_matrix(plan.time_s, robot.creep) @ pulled


def creep_matrix(time_s: FloatArray, terms: Sequence[tuple[float, float]]) -> FloatArray:
    """Return C, shape (F, F), with crept = C @ values.

    The convolution of J(t) = 1 + Σ f (1 − exp(−t/τ)) with the rate of values that go straight from frame to frame; what was
    there before the first frame has crept to its end. Each row is summed in full, from the closed form of each piece.
    """
    F = len(time_s)
    rate = np.zeros((F, F))
    rate[:, 0] = 1.0 + sum(fraction for fraction, _ in terms)
    for k in range(1, F):
        dt = time_s[k] - time_s[k - 1]
        since, until = time_s[k:] - time_s[k - 1], time_s[k:] - time_s[k]
        rate[k:, k] = 1.0
        for fraction, tau in terms:
            rate[k:, k] += fraction * (1.0 - tau / dt * (np.exp(-until / tau) - np.exp(-since / tau)))
    change = np.eye(F) - np.eye(F, k=-1)
    return np.asarray(rate @ change)


# The path


def true_path(robot: Robot, plan: Plan, *, substeps: int = 3) -> list[TrueFrame]:
    """Return the truth of every frame.

    Arguments:
        robot: see `true_robot`.
        plan: what happens.
        substeps: steps from frame to frame; the path between them is straight in the inputs and loads.

    Raises:
        DataError: where there is no equilibrium.
    """
    inputs = true_inputs(robot, plan)
    path = TruePath(robot, plan)
    frames, last = [], path.nothing()
    loads = path.frame_loads(inputs)
    for k, load in enumerate(loads):
        for step in range(1, substeps + 1):
            path.go(last.towards(load, step / substeps), k)
        frames.append(TrueFrame(replace(path.state, factor=None), freeze(inputs[k]), path.contacts_now(load)))
        last = load
    return frames


class TruePath:
    """The state of the truth, moved on step by step; bodies without friction carry given tensions along their cables."""

    def __init__(self, robot: Robot, plan: Plan) -> None:
        self.control = plan.control
        self.plan = plan
        self.friction = [cable.friction for cable in robot.body.cables]
        self.creep = robot.creep
        self.pressures = robot.actuation.pressure_gain * plan.pressures + robot.actuation.pressure_offset
        self.body = robot.body.with_cables(tuple(replace(cable, friction=0.0) for cable in robot.body.cables))
        self.patches = [contact_patch(robot.body.mesh, c.table.point_m, c.table.radius_m) for c in plan.contacts]
        self.grips = [new_grip(len(cable.path)) for cable in robot.body.cables]
        self.state = solve_equilibrium(self.body)
        self.softening = robot.softening
        self.most = energy_density(self.body, self.state.positions)

    def nothing(self) -> _Load:
        """Return the load of the body at rest: its own weight."""
        n = len(self.body.mesh.nodes)
        gravity = self.body.gravity if self.plan.gravity is None else self.plan.gravity[0]
        return _Load(
            np.zeros(len(self.friction)),
            np.zeros((n, 3)),
            np.zeros(len(self.patches)),
            np.asarray(gravity),
            np.zeros(len(self.body.chambers)),
        )

    def frame_loads(self, inputs: FloatArray) -> list[_Load]:
        """Return what drives the body in each frame."""
        plan, n, F = self.plan, len(self.body.mesh.nodes), len(inputs)
        creep = creep_matrix(plan.time_s, self.creep)
        known = _known_loads(self.body.mesh, plan, creep)
        gravity = np.tile(self.body.gravity, (F, 1)) if plan.gravity is None else plan.gravity
        contact = np.stack([c.force for c in plan.contacts], axis=1) if plan.contacts else np.zeros((F, 0))
        pressures = creep @ self.pressures
        return [_Load(inputs[k], known.get(k, np.zeros((n, 3))), contact[k], gravity[k], pressures[k]) for k in range(F)]

    def go(self, load: _Load, frame: int) -> None:
        """Move on to a load: the state, the tensions along the cables and the contact forces agree at the end."""
        whole = self.body if self.plan.gravity is None else self.body.with_gravity(load.gravity)
        passes, far = [self._motors(load)], FAR
        for _ in range(PASSES):
            ahead = creep_ahead(passes, far)
            motors = passes[-1] if ahead is None else ahead
            passes, far = (passes, far) if ahead is None else ([], NEARER * far)
            along, _ = self._along(motors)
            shares = self._shares()
            body = whole if shares is None else whole.with_stiffness_scale(shares)
            forces = load.forces + self._contact_forces(load)
            self.state = self._solve(body, load, motors, along, forces, frame)
            soft = self._shares()
            same = soft is None or shares is None or bool(np.abs(soft - shares).max() < SOFT)
            if same and self._settled(load, along, forces):
                self.most = np.maximum(self.most, energy_density(self.body, self.state.positions))
                # of where it converged: while bends slide, any tension at the motor gives the same shares
                self.grips = self._along(self._motors(load))[1]
                return
            passes.append(self._motors(load))
        raise DataError(f"the truth of frame {frame} does not settle: friction and contact keep moving; use more substeps")

    def _shares(self) -> FloatArray | None:
        """Return the share of its modulus that each element has by all it has been through, (m,); None: all of it."""
        if not self.softening:
            return None
        now = energy_density(self.body, self.state.positions)
        return softened_share(self.softening, np.maximum(self.most, now), now)

    def contacts_now(self, load: _Load) -> tuple[TrueContact, ...]:
        """Return the contacts that press."""
        x = self.state.positions
        return tuple(
            TrueContact(i, freeze(patch.place(x)), freeze(patch.normal(x)), freeze(force * self._direction(i)))
            for i, (patch, force) in enumerate(zip(self.patches, load.contact))
            if force > 0
        )

    def _motors(self, load: _Load) -> FloatArray:
        """Return the tensions at the motors [N], shape (a,): of held cables as they came out last."""
        return load.inputs if self.control == "tension" else np.array(list(self.state.tension.values()))

    def _along(self, motors: FloatArray) -> tuple[list[FloatArray], list[Grip]]:
        """Return the tensions along each cable [N], far end first, and what the bends would remember."""
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
        """Return whether what was solved with is what its result asks for."""
        wanted, _ = self._along(self._motors(load))
        used = self.state.segment_tensions
        moved = [np.abs(w - u).max(initial=0.0) for w, u in zip(wanted, used)]
        pressed = np.abs(load.forces + self._contact_forces(load) - forces).max(initial=0.0)
        if self.control == "tension":
            return bool(max([float(pressed), *moved]) < SETTLED * max(1.0, float(np.abs(load.inputs).max(initial=0.0))))
        return bool(max([float(pressed), *moved]) < SETTLED_HELD)

    def _direction(self, i: int) -> FloatArray:
        given = self.plan.contacts[i].table.direction
        if given is None:
            return -self.patches[i].normal(self.state.positions)
        return np.asarray(np.array(given) / np.linalg.norm(given))

    def _contact_forces(self, load: _Load) -> FloatArray:
        n = len(self.body.mesh.nodes)
        total = np.zeros((n, 3))
        for i, (patch, force) in enumerate(zip(self.patches, load.contact)):
            total += patch.spread(force * self._direction(i), n)
        return total


def creep_ahead(passes: list[FloatArray], far: float) -> FloatArray | None:
    """Return the tensions at the motors that passes creep towards [N], (a,); None where they do not creep.

    While the bends of a held cable hold, what is behind them stays, and the tension at the motor moves by nearly the same small share in every
    pass, until they slide. So where the logarithms of three passes move like a geometric series, it is summed (Aitken 1926), up to `far` in
    the logarithm.
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
