"""The quasi-static walk along a recording: from recorded inputs to one equilibrium a frame.

History (friction of cables, creep) is carried from frame to frame in the order of time. Without history, frames with the
same inputs and loads share one solve.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.arrays import FloatArray, IntArray, freeze
from femsense.errors import DataError
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles, cable_forces, rub, shortening
from femsense.fem.chambers import volume_gradient
from femsense.fem.clamp import first_give
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.iterative import UnsettledError, iterative
from femsense.fem.linear import Factorization, Pattern, available_memory, factorize
from femsense.fem.mesh import Embedding, TetMesh, embed_points
from femsense.model import Robot
from femsense.parallel import each
from femsense.recording import Recording

FACTOR_MEMORY = 2e9
"""Factors of several frames are kept up to this total [bytes], and up to MEMORY_SHARE of the memory that is free."""
MEMORY_SHARE = 0.25
TRIED = 1e-8
"""Relative tolerance of states that are only tried: below a thousandth of a millimetre, where derivatives want a tenth of it."""


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """What truly drives the robot in each frame: recorded inputs after offset, gain, play and creep."""

    control: str
    """"tension" or "displacement"."""
    inputs: FloatArray
    """[N] or [m], shape (F, a), in the order of the body's cables."""
    gravity: FloatArray | None
    """[m/s²], shape (F, 3); None: that of the body."""
    load_frame: IntArray
    """Frame index of each known load, shape (L,)."""
    load_points: FloatArray
    """Where it acts, at rest [m], shape (L, 3)."""
    load_forces: FloatArray
    """[N], shape (L, 3), creep included."""
    pressures: FloatArray
    """[Pa], shape (F, c), in the order of the body's chambers, creep included."""
    load_ties: Embedding
    """Where the mesh carries each known load."""


def drive_of(robot: Robot, recording: Recording, *, initial: FloatArray | None = None) -> Drive:
    """Return what drives a robot in a recording.

    Arguments:
        robot: the robot with its effects.
        recording: inputs, loads and gravity of each frame.
        initial: initial inputs [N] or [m], shape (a,), added to the recorded ones (for `actuation_zero = "unknown"`).

    Returns:
        the drive.
    """
    names, act = robot.body.cable_names, robot.actuation
    order = [recording.cable_names.index(name) for name in names] if recording.cable_names else []
    recorded = recording.inputs[:, order] if order else np.zeros((len(recording.time_s), len(names)))
    recorded = recorded + (0.0 if initial is None else initial)
    if recording.actuation == "tension":
        inputs = np.maximum(act.gain * recorded + act.tension_offset, 0.0)
        inputs = _creep(inputs, recording.time_s, robot.creep)
    else:
        inputs = act.gain * recorded + act.displacement_offset - act.slack
    frame, points, forces = _creep_loads(recording, robot.creep)
    order = [recording.chamber_names.index(name) for name in robot.body.chamber_names] if recording.chamber_names else []
    pressures = recording.pressures[:, order] if order else np.zeros((len(recording.time_s), len(robot.body.chambers)))
    pressures = _creep(pressures, recording.time_s, robot.creep)
    ties = _load_ties(robot.body.mesh, points)
    return Drive(recording.actuation, freeze(inputs), recording.gravity, frame, points, forces, freeze(pressures), ties)


def _load_ties(mesh: TetMesh, points: FloatArray) -> Embedding:
    """Return the ties of loads, each place looked up once."""
    places, number = np.unique(points, axis=0, return_inverse=True)
    return embed_points(mesh, places)[number.ravel()]


def _creep(values: FloatArray, time_s: FloatArray, terms: tuple[tuple[float, float], ...]) -> FloatArray:
    """Return values (F, k) with J(t) = 1 + Σ f (1 − exp(−t/τ)) on every change; linear between frames, crept out before the first."""
    result = values.copy()
    for fraction, tau in terms:
        flow = values[0].copy()
        result[0] += fraction * flow
        for k in range(1, len(values)):
            dt = time_s[k] - time_s[k - 1]
            decay = np.exp(-dt / tau)
            slope = (values[k] - values[k - 1]) / dt
            flow = values[k] - slope * tau * (1.0 - decay) + (flow - values[k - 1]) * decay
            result[k] += fraction * flow
    return result


def _creep_loads(recording: Recording, terms: tuple[tuple[float, float], ...]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return frame, place and force of the known loads with creep; a load that is taken off goes on acting while it creeps back."""
    if not terms or not len(recording.load_frame):
        return recording.load_frame, recording.load_points, recording.load_forces
    places, number = np.unique(recording.load_points, axis=0, return_inverse=True)
    table = np.zeros((len(recording.time_s), len(places), 3))
    np.add.at(table, (recording.load_frame, number.ravel()), recording.load_forces)
    crept = _creep(table.reshape(len(table), -1), recording.time_s, terms).reshape(table.shape)
    frame, place = np.nonzero(np.abs(crept).max(axis=2) > 0)
    return frame, places[place], crept[frame, place]


@dataclass(frozen=True, eq=False, slots=True)
class Walk:
    """One way to walk: a robot and its drive."""

    robot: Robot
    drive: Drive


def has_history(robot: Robot) -> bool:
    """Return whether the state depends on what was before (friction along a cable)."""
    return any(cable.friction > 0 for cable in robot.body.cables)


def frame_loads(walk: Walk, frame: int) -> FloatArray | None:
    """Return the nodal forces of the known loads of a frame [N], shape (n, 3); None where there are none."""
    rows = np.flatnonzero(walk.drive.load_frame == frame)
    if not len(rows):
        return None
    return walk.drive.load_ties[rows].spread(walk.drive.load_forces[rows], len(walk.robot.body.mesh.nodes))


def solve_frame(
    walk: Walk, frame: int, *, start: Equilibrium | None = None, before: tuple[FloatArray, ...] | None = None, reuse_factor: bool = False,
    nodal_forces: FloatArray | None = None, relative_tolerance: float = 1e-9, rough: bool = False,
) -> Equilibrium:  # fmt: skip
    """Return the equilibrium of one frame.

    Arguments:
        walk: robot and drive.
        frame: index of the frame.
        start: a state to start from.
        before: tensions along the cables until now (friction); by default none.
        reuse_factor: whether the start's factor serves.
        nodal_forces: forces beside the known loads [N], shape (n, 3).
        relative_tolerance: of the unbalanced force against the sum of all loads.
        rough: the state is only tried (see `solve_equilibrium`).
    """
    drive, body = walk.drive, walk.robot.body
    if drive.gravity is not None:
        body = body.with_gravity(drive.gravity[frame])
    loads = frame_loads(walk, frame)
    if nodal_forces is not None:
        loads = nodal_forces if loads is None else loads + nodal_forces
    values = {name: float(v) for name, v in zip(body.cable_names, drive.inputs[frame])}
    if before is None:
        before = tuple(np.zeros(len(c.path)) for c in body.cables)
    tension, held = (values, None) if drive.control == "tension" else (None, values)
    return solve_equilibrium(
        body, tension=tension, shortening=held, pressure=dict(zip(body.chamber_names, drive.pressures[frame].tolist())),
        nodal_forces=loads, start=start, before=before, reuse_factor=reuse_factor, relative_tolerance=relative_tolerance,
        rough=rough,
    )  # fmt: skip


def walk_along(
    walk: Walk, frames: Sequence[int], observe: Callable[[Robot, Equilibrium], FloatArray], variants: Sequence[Walk] = (),
    *, starts: dict[int, Equilibrium] | None = None, rough: bool = False,
) -> Iterator[tuple[int, Equilibrium, FloatArray, FloatArray]]:  # fmt: skip
    """Solve frames in order, and with each the same frame of variants that differ from it by little.

    A variant's state is the linear response of the base state to the forces that the variant adds there, so that all of them
    together cost one factorisation and one solve with many right-hand sides; they must differ by little. A variant on another
    mesh, or with a rigid clamp where that of the base gives, is solved for itself.

    Arguments:
        walk: the base.
        frames: indices, ascending; frames between them are solved too where the past matters.
        observe: (robot, state) → what is kept of a state, shape (p, 3).
        variants: other robots or drives.
        starts: frame → a state near by, such as that of an earlier walk; brought up to date as frames are solved. Their
            factors are kept as long as they fit into FACTOR_MEMORY.
        rough: states are only tried, where one near by is known.

    Yields:
        frame index, equilibrium, observation (p, 3), observations of the variants (v, p, 3).
    """
    wanted = set(int(f) for f in frames)
    past = any(has_history(w.robot) for w in (walk, *variants))
    todo = list(range(max(wanted) + 1)) if past and wanted else sorted(wanted)
    first: dict[bytes, int] = {}
    alike = {k: k if past else first.setdefault(_key(walk, variants, k), k) for k in todo}
    unique = [k for k in todo if alike[k] == k]
    bases = dict(zip(unique, _base_states(walk, unique, starts, past, rough)))
    answers: dict[int, tuple[FloatArray, FloatArray]] = {}
    room = _room(len(unique))
    for k, seen, others, factor in _answers(walk, variants, bases, observe, past):
        answers[k] = seen, others
        if factor is not None and starts is not None and factor.bytes < room:
            starts[k] = replace(starts[k], factor=factor)
    for k in todo:
        if k in wanted:
            yield k, bases[alike[k]], *answers[alike[k]]


def _room(count: int) -> float:
    """Return how much memory a factor may take where so many are kept [bytes]."""
    return min(FACTOR_MEMORY, MEMORY_SHARE * available_memory()) / max(count, 1)


def _base_states(
    walk: Walk, frames: list[int], starts: dict[int, Equilibrium] | None, past: bool, rough: bool
) -> Iterator[Equilibrium]:
    """Yield the states of frames, without their factors; `starts` gets them with these where they fit into memory."""
    body, room = walk.robot.body, _room(len(frames))
    near = {} if starts is None else {k: starts[k] for k in frames if k in starts and _clamp_fits(body, starts[k])}

    def keep(k: int, state: Equilibrium) -> Equilibrium:
        bare = replace(state, factor=None)
        if starts is not None:
            starts[k] = state if state.factor is not None and state.factor.bytes < room else bare
        return bare

    def again(k: int) -> Equilibrium:
        tolerance = TRIED if rough else 1e-9
        return keep(
            k, _require(solve_frame(walk, k, start=near[k], reuse_factor=True, relative_tolerance=tolerance, rough=rough), k)
        )

    if not past and len(near) == len(frames):
        yield from each(again, frames)
        return
    last: Equilibrium | None = None
    before: tuple[FloatArray, ...] | None = None
    for k in frames:
        start = near.get(k, last)
        start = start if start is None or _clamp_fits(body, start) else None
        last = _require(
            solve_frame(walk, k, start=start, before=before, reuse_factor=start is not last, rough=rough and k in near), k
        )
        before = last.segment_tensions if past else None
        yield keep(k, last)


Answer = tuple[int, FloatArray, FloatArray, Factorization | None]
"""Frame, observation (p, 3), observations of variants (v, p, 3), the factor that gave them."""


def _answers(
    walk: Walk, variants: Sequence[Walk], bases: dict[int, Equilibrium], observe: Callable[[Robot, Equilibrium], FloatArray], past: bool
) -> Iterator[Answer]:  # fmt: skip
    """Yield what is observed in each base state, and of the variants there."""
    body, memory = walk.robot.body, list[tuple[FloatArray, ...] | None]([None] * (1 + len(variants)))

    def at(k: int, tangent: Tangent | None, memory: list[tuple[FloatArray, ...] | None]) -> Answer:
        seen = observe(walk.robot, bases[k])
        return k, seen, *_observe_variants(walk, variants, k, bases[k], seen, observe, memory, tangent)

    if not past:
        yield from each(lambda k: at(k, None, list(memory)), bases)
        return
    if not any(_linear(walk, v) and not _same_mechanics(walk, v) for v in variants):
        yield from (at(k, None, memory) for k in bases)
        return
    for k, tangent in zip(bases, each(lambda k: tangent_at(body, bases[k]), bases)):
        yield at(k, tangent, memory)


def _clamp_fits(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether a state can serve as a start: a clamp that gave way elsewhere would be torn back."""
    held = body.clamped if body.clamp_is_rigid else body.clamped[:0]
    return bool(np.abs(state.positions[held] - body.mesh.nodes[held]).max(initial=0.0) < 1e-9)


def _observe_variants(
    walk: Walk, variants: Sequence[Walk], k: int, base: Equilibrium, seen: FloatArray, observe: Callable[[Robot, Equilibrium], FloatArray],
    memory: list[tuple[FloatArray, ...] | None], tangent: Tangent | None = None,
) -> tuple[FloatArray, Factorization | None]:  # fmt: skip
    """Return what is observed of each variant in frame k, shape (v, p, 3), and the factor of the stiffness where it took one.

    `memory` keeps the tensions along the cables of the variants; `tangent` is that of the base state, where it is known.
    """
    others = np.zeros((len(variants), *seen.shape))
    linear = []
    for i, variant in enumerate(variants):
        if _same_mechanics(walk, variant):
            others[i] = observe(variant.robot, base)
        elif not _linear(walk, variant):
            state = _require(solve_frame(variant, k, start=base, before=memory[1 + i]), k)
            memory[1 + i] = state.segment_tensions
            others[i] = observe(variant.robot, state)
        else:
            linear.append(i)
    if not linear:
        return others, None
    tangent = tangent_at(walk.robot.body, base) if tangent is None else tangent
    balance = _Balance(walk, k, base)
    starts = [balance.carried(variants[i]) for i in linear]
    moves = np.zeros((len(linear), *base.positions.shape))
    rubbing = any(has_history(variants[i].robot) for i in linear)
    for _ in range(2 if rubbing else 1):  # the second time with the bends as the first response leaves them
        answers = [
            balance.upset_by(variants[i], memory[1 + i], start, start + move) for i, start, move in zip(linear, starts, moves)
        ]
        moved = [start is not base.positions for start in starts]
        forces = [force - balance.left() if m else force for m, (force, _, _) in zip(moved, answers)]
        moves = tangent.respond(np.array(forces))
        if base.held.any():  # cables: pressures are never held here
            held = base.held[: len(walk.robot.body.cables)]
            moves += np.tensordot(np.array([pulled[held] for _, pulled, _ in answers]), tangent.respond_to_held(), axes=1)
    for i, start, move, (_, _, tensions) in zip(linear, starts, moves, answers):
        memory[1 + i] = tensions
        others[i] = observe(variants[i].robot, replace(base, positions=start + move))
    return others, tangent.factor


def _linear(walk: Walk, variant: Walk) -> bool:
    """Return whether the linear response gives a variant: the same elements, and a clamp that moves by little."""
    base, other = walk.robot.body, variant.robot.body
    return base.stencil.slots is other.stencil.slots and (base.clamp_is_rigid or not other.clamp_is_rigid)


class _Balance:
    """The forces that balance in the base state of a frame, and by how much a variant upsets them."""

    def __init__(self, walk: Walk, frame: int, base: Equilibrium) -> None:
        self.walk, self.frame, self.base = walk, frame, base
        self.body = self._body(walk)
        self.inner = internal(self.body, base.positions, tangent=False).forces
        self.dead = self.body.dead_load()

    def _body(self, walk: Walk) -> BodyModel:
        body, gravity = walk.robot.body, walk.drive.gravity
        return body if gravity is None else body.with_gravity(gravity[self.frame])

    def _loads(self, walk: Walk) -> FloatArray:
        loads = frame_loads(walk, self.frame)
        return np.zeros((len(walk.robot.body.mesh.nodes), 3)) if loads is None else loads

    def carried(self, variant: Walk) -> FloatArray:
        """Return where the variant's response starts [m], (n, 3): the base state, grown as its body is and with its clamp given way."""
        body, other, x = self.body, variant.robot.body, self.base.positions
        if other.mesh is not body.mesh:
            x = x + (other.mesh.nodes - body.mesh.nodes)
        if body.clamp_is_rigid and not other.clamp_is_rigid:
            return x + first_give(other, self.left())
        return x

    def left(self) -> FloatArray:
        """Return all forces in the base state [N], (n, 3): at the clamp what it takes up, elsewhere what Newton left."""
        x = self.base.positions
        force = self.dead + self.base.nodal_forces
        for cable, along in zip(self.body.cables, self.base.segment_tensions):
            force = force + cable_forces(cable, x, along, len(x))
        for chamber in self.body.chambers:
            force = force + self.base.pressure[chamber.name] * volume_gradient(chamber, x)
        return np.asarray(force - self.inner)

    def upset_by(
        self, variant: Walk, before: tuple[FloatArray, ...] | None, x: FloatArray, bent: FloatArray
    ) -> tuple[FloatArray, FloatArray, tuple[FloatArray, ...]]:
        """Return the nodal forces that a variant adds at positions x near the base state [N], (n, 3); the shortening that it adds
        to held cables [m], (a,); and the tensions along its cables [N]. `bent` is where its cables bend [m], (n, 3)."""
        body = self._body(variant)
        tensions = self._tensions(variant, body, before, bent)
        still = x is self.base.positions
        force = self._change(variant, body, tensions) if still else self._whole(variant, body, tensions, x)
        return force, self._pulled(variant, body, None if still else x), tensions

    def _whole(self, variant: Walk, body: BodyModel, tensions: tuple[FloatArray, ...], x: FloatArray) -> FloatArray:
        """Return all forces on a variant's body at x."""
        force = body.dead_load() + self._loads(variant) - internal(body, x, tangent=False).forces
        for cable, along in zip(body.cables, tensions):
            force = force + cable_forces(cable, x, along, len(x))
        for chamber, pressure in zip(body.chambers, variant.drive.pressures[self.frame]):
            force = force + pressure * volume_gradient(chamber, x)
        return np.asarray(force)

    def _change(self, variant: Walk, body: BodyModel, tensions: tuple[FloatArray, ...]) -> FloatArray:
        """Return what a variant changes of the forces in the base state, where they sum to nothing."""
        x, own, drive = self.base.positions, self.body, variant.drive
        force = np.zeros_like(x)
        if body is not own:
            force += body.dead_load() - self.dead
            springs = [(b.clamp_stiffness, b.clamp_turn_stiffness) for b in (body, own)]
            if body.material is not own.material or springs[0] != springs[1]:
                force += self.inner - internal(body, x, tangent=False).forces
        if drive.load_forces is not self.walk.drive.load_forces:
            force += self._loads(variant) - self._loads(self.walk)
        for cable, along, along_here in zip(body.cables, tensions, self.base.segment_tensions):
            if not np.array_equal(along, along_here):
                force += cable_forces(cable, x, along - along_here, len(x))
        for i, chamber in enumerate(body.chambers):
            more = drive.pressures[self.frame, i] - self.walk.drive.pressures[self.frame, i]
            if more != 0.0:
                force += more * volume_gradient(chamber, x)
        return force

    def _tensions(
        self, variant: Walk, body: BodyModel, before: tuple[FloatArray, ...] | None, bent: FloatArray
    ) -> tuple[FloatArray, ...]:
        result = []
        for i, cable in enumerate(body.cables):
            held = variant.drive.control == "displacement"
            motor = self.base.tension[cable.name] if held else float(variant.drive.inputs[self.frame, i])
            start = np.zeros(len(cable.path)) if before is None else before[i]
            rubs = cable.friction > 0
            result.append(rub(cable, bend_angles(cable, bent), start, motor) if rubs else np.full(len(cable.path), motor))
        return tuple(result)

    def _pulled(self, variant: Walk, body: BodyModel, x: FloatArray | None) -> FloatArray:
        cables = self.body.cables
        if variant.drive.control != "displacement":
            return np.zeros(len(cables))
        stretch = [
            self.base.tension[c.name] * (1.0 / b.stretch_stiffness - 1.0 / c.stretch_stiffness)
            for b, c in zip(cables, body.cables)
        ]
        pulled = variant.drive.inputs[self.frame] - self.walk.drive.inputs[self.frame] + np.array(stretch)
        if x is not None:
            pulled = pulled - shortening(body, x) + shortening(self.body, self.base.positions)
        return np.asarray(pulled)


FINER_STEPS = 5
FINER_ENOUGH = 0.2
"""Newton steps on the finer mesh end when the unbalanced force has fallen to this share."""
ROUGH = 1e-3
"""Share of a step on the finer mesh that may be missing, in energy. With ten times as much the order of the nodes moved a fit by two percent."""
ROUGH_FROM = 9000
"""Unknowns from which on such a step takes conjugate gradients instead of a factor."""


def roughly(pattern: Pattern, values: FloatArray) -> Factorization | None:
    """Return a stiffness that is solved to ROUGH, by conjugate gradients where these are faster than a factor."""
    if pattern.size < ROUGH_FROM or pattern.grid is None or not np.isfinite(values).all():
        return factorize(pattern, values)
    try:
        return iterative(pattern.levels(), values, tolerance=ROUGH) or factorize(pattern, values)
    except UnsettledError:
        return factorize(pattern, values)


def finer_state(walk: Walk, fine: Walk, frame: int, base: Equilibrium, ties: Embedding) -> FloatArray | None:
    """Return where the nodes of a finer mesh come to rest [m], shape (n, 3), nearly: Newton steps from a state of a coarser one.

    One step is most often enough, since the finer mesh holds the coarse state exactly and its error is small. None where the steps
    do not settle.

    Arguments:
        walk: the coarse robot and its drive.
        fine: the same on the finer mesh.
        frame: index of the frame.
        base: the coarse state of that frame.
        ties: of the fine nodes to the coarse mesh.
    """
    body, balance = fine.robot.body, _Balance(walk, frame, base)
    x, first = ties.positions(base.positions), np.inf
    for step in range(FINER_STEPS):
        force, pulled, _ = balance.upset_by(fine, base.segment_tensions, x, x)
        size = float(np.linalg.norm(force.ravel()[body.free_map.dofs]))
        first = size if step == 0 else first
        if step and size < FINER_ENOUGH * first:
            return x
        tangent = tangent_at(body, replace(base, positions=x, factor=None), roughly)
        move = tangent.respond(force[None])[0]
        if base.held.any():
            move = move + np.tensordot(pulled[base.held[: len(body.cables)]], tangent.respond_to_held(), axes=1)
        x = np.asarray(x + move)
    return None


def _same_mechanics(walk: Walk, variant: Walk) -> bool:
    a, b = walk.drive, variant.drive
    return (
        variant.robot.body is walk.robot.body
        and np.array_equal(a.inputs, b.inputs)
        and np.array_equal(a.pressures, b.pressures)
        and np.array_equal(a.load_forces, b.load_forces)
    )


def _key(walk: Walk, variants: Sequence[Walk], frame: int) -> bytes:
    parts = []
    for w in (walk, *variants):
        drive = w.drive
        rows = drive.load_frame == frame
        parts += [drive.inputs[frame], drive.pressures[frame], drive.load_points[rows].ravel(), drive.load_forces[rows].ravel()]
        if drive.gravity is not None:
            parts.append(drive.gravity[frame])
    return np.concatenate([np.asarray(p, dtype=float) for p in parts]).tobytes()


def _require(state: Equilibrium, frame: int) -> Equilibrium:
    if not state.converged:
        raise DataError(f"no equilibrium in frame {frame}: {state.status}: {state.advice} (unbalanced {state.residual_n:.2g} N)")
    return state


def marker_positions(robot: Robot, state: Equilibrium) -> FloatArray:
    """Return the markers of a robot in a state [m], shape (k, 3), robot frame."""
    return robot.markers.positions(state.positions)
