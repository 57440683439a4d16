"""The quasi-static walk along a recording: from recorded inputs to one equilibrium a frame.

History (friction of cables, creep) is carried from frame to frame in the order of time. Without history, frames with the
same inputs and loads share one solve.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from femsense.arrays import FloatArray, IntArray, freeze
from femsense.errors import DataError, FemsenseError
from femsense.fem.assembly import add_elements, element_forces, internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles, cable_forces, rub, shortening
from femsense.fem.chambers import volume_gradient
from femsense.fem.clamp import first_give, rigid_give
from femsense.fem.compliance import Tangent, drive_rows, tangent_at
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.linear import Factorization, available_memory, factorize
from femsense.fem.mesh import Embedding, TetMesh, embed_points
from femsense.fem.solves import ROUGH, Refined, prepare_roughly, refined, roughly
from femsense.fem.turning import turned_step
from femsense.model import Robot
from femsense.parallel import each
from femsense.recording import Recording

FACTOR_MEMORY = 2e9
"""Factors of several frames are kept up to this total [bytes], and up to MEMORY_SHARE of the memory that is free."""
MEMORY_SHARE = 0.25
TRIED = 1e-8
"""Relative tolerance of states that are only tried: below a thousandth of a millimetre, where derivatives want a tenth of it."""
PARTS, SHORTEST_PART = 4, 6
"""Parts at most that frames are walked in side by side where each starts from the one before, and frames of a part at least."""
FEW_COLUMNS = 40
"""With more right-hand sides of a state the solves that correct them take longer than a factor in double precision."""
MANY_POINTS = 40
"""Answers to forces at more points than that are not kept."""
PAST, PAST_TRIED = 1e-8, 1e-6
"""Tensions along a cable that agree so well [N], and as shares of the largest, are the same past; the latter for states that are only tried."""


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
    inputs = inputs_wanted(robot, recording, initial)
    if recording.actuation == "tension":
        inputs = _creep(np.maximum(inputs, 0.0), recording.time_s, robot.creep)
    frame, points, forces = _creep_loads(recording, robot.creep)
    order = [recording.chamber_names.index(name) for name in robot.body.chamber_names] if recording.chamber_names else []
    pressures = recording.pressures[:, order] if order else np.zeros((len(recording.time_s), len(robot.body.chambers)))
    pressures = _creep(pressures, recording.time_s, robot.creep)
    ties = _load_ties(robot.body.mesh, points)
    return Drive(recording.actuation, freeze(inputs), recording.gravity, frame, points, forces, freeze(pressures), ties)


def inputs_wanted(robot: Robot, recording: Recording, initial: FloatArray | None = None) -> FloatArray:
    """Return recorded inputs after zero, gain and play [N] or [m], shape (F, a); a tension below zero pulls like none."""
    names, act = robot.body.cable_names, robot.actuation
    order = [recording.cable_names.index(name) for name in names] if recording.cable_names else []
    recorded = recording.inputs[:, order] if order else np.zeros((len(recording.time_s), len(names)))
    recorded = recorded + (0.0 if initial is None else initial)
    if recording.actuation == "tension":
        return np.asarray(act.gain * recorded + act.tension_offset)
    return np.asarray(act.gain * recorded + act.displacement_offset - act.slack)


def creep_response(robot: Robot, recording: Recording) -> FloatArray:
    """Return what drives the robot in each frame by what is wanted in each, shape (F, F)."""
    return _creep(np.eye(len(recording.time_s)), recording.time_s, robot.creep)


def _load_ties(mesh: TetMesh, points: FloatArray) -> Embedding:
    """Return the ties of loads, each place looked up once; variant after variant asks for the same ones."""
    return _ties_at(mesh, points.tobytes())


@lru_cache(maxsize=4)
def _ties_at(mesh: TetMesh, points: bytes) -> Embedding:
    places, number = np.unique(np.frombuffer(points).reshape(-1, 3), axis=0, return_inverse=True)
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


@dataclass(frozen=True, eq=False, slots=True)
class AtPoints:
    """What the observed points of a state answer to, whatever the variant."""

    to_forces: FloatArray
    """Moves of the nodes under a unit force at each of p points along each axis, and so (Maxwell's reciprocity) of the points along each axis under
    unit nodal forces [m/N], (3p, n, 3)."""
    to_held: FloatArray
    """Moves of the points for a shortening of each held cable by one metre [1], (h, p, 3)."""


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
    nodal_forces: FloatArray | None = None, relative_tolerance: float = 1e-9, rough: bool = False, single: bool = False,
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
        single: factors in single precision, which the true residual makes up for.
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
        rough=rough, single=single,
    )  # fmt: skip


def walk_along(
    walk: Walk, frames: Sequence[int], ties: Callable[[Robot], Embedding], variants: Sequence[Walk] = (),
    *, starts: dict[int, Equilibrium] | None = None, rough: bool = False, answers: dict[int, AtPoints] | None = None,
) -> Iterator[tuple[int, Equilibrium, FloatArray, FloatArray]]:  # fmt: skip
    """Solve frames in order, and with each the same frame of variants that differ from it by little.

    A variant's state is the linear response of the base state to the forces that the variant adds there, so that all of them
    together cost one factorisation and one solve with many right-hand sides; they must differ by little. A variant on another
    mesh, or with a rigid clamp where that of the base gives, is solved for itself.

    Arguments:
        walk: the base.
        frames: indices, ascending; frames between them are solved too where the past matters.
        ties: robot → the points that are observed, p of them.
        variants: other robots or drives.
        starts: frame → a state near by, such as that of an earlier walk; brought up to date as frames are solved. Their
            factors are kept as long as they fit into FACTOR_MEMORY.
        rough: states are only tried, where one near by is known.
        answers: frame → what its points answer to, from an earlier walk along these very states with other variants; what is missing is
            added where the points are few.

    Yields:
        frame index, equilibrium, where the points are [m], shape (p, 3), and where those of the variants are, shape (v, p, 3).
    """
    wanted = sorted(set(int(f) for f in frames))
    past = has_history(walk.robot)
    todo = list(range(max(wanted) + 1)) if wanted and any(has_history(w.robot) for w in (walk, *variants)) else wanted
    alike = _alike(walk, todo, past)
    unique = [k for k in todo if alike[k] == k]
    bases = dict(zip(unique, _base_states(walk, unique, starts, past, rough)))
    seen = {k: ties(walk.robot).positions(bases[k].positions) for k in {alike[k]: None for k in wanted}}
    others = {k: np.zeros((len(variants), *seen[alike[k]].shape)) for k in wanted}
    lent = {k: s.factor for k, s in (starts or {}).items() if k in bases and s.positions is bases[k].positions}
    observed = _Variants(walk, variants, {k: bases[alike[k]] for k in todo}, alike, others, ties, lent, answers)
    room = _room(len(unique))
    for k, factor in observed.write():
        plain = factor.plain if isinstance(factor, Refined) else factor
        if plain is not None and starts is not None and plain.bytes < _most_lent(starts[k], room):
            starts[k] = replace(starts[k], factor=plain)
    for k in wanted:
        yield k, bases[alike[k]], seen[alike[k]], others[k]


def _alike(walk: Walk, frames: list[int], past: bool) -> dict[int, int]:
    """Return for each frame the first one with the same state: the same inputs and loads, with a past the frames just before."""
    first: dict[bytes, int] = {}
    result: dict[int, int] = {}
    last = b""
    for k in frames:
        key = _key(walk, k)
        if past and key != last:
            first[key] = k
        result[k] = first.setdefault(key, k)
        last = key
    return result


def _room(count: int) -> float:
    """Return how much memory a factor may take where so many are kept [bytes]."""
    return min(FACTOR_MEMORY, MEMORY_SHARE * available_memory()) / max(count, 1)


def _most_lent(state: Equilibrium, room: float) -> float:
    """Return how many bytes a factor may take to be kept with a state: no more than the one it takes the place of, which is near enough."""
    return room if state.factor is None else min(room, state.factor.bytes + 1)


def _base_states(
    walk: Walk, frames: list[int], starts: dict[int, Equilibrium] | None, past: bool, rough: bool
) -> Iterator[Equilibrium]:
    """Yield the states of frames, without their factors; `starts` gets them with these where they fit into memory."""
    room = _room(len(frames))
    near = {k: state for k, state in sorted((starts or {}).items()) if _clamp_fits(walk.robot.body, state)}

    def keep(k: int, state: Equilibrium) -> Equilibrium:
        bare = replace(state, factor=None)
        if starts is not None:
            starts[k] = state if state.factor is not None and state.factor.bytes < room else bare
        return bare

    known, fits = near.keys() & set(frames), bool(near)
    if not near:
        near = {k: start for k, state in sorted((starts or {}).items()) if (start := _taken_along(walk, k, state)) is not None}
    if near:
        near.update(_nearest(walk, near, [k for k in frames if k not in near]))

    def again(k: int, before: tuple[FloatArray, ...] | None = None, start: Equilibrium | None = None) -> Equilibrium:
        start, tried = near[k] if start is None else start, rough and k in known
        return _require(
            solve_frame(
                walk,
                k,
                start=start,
                before=before,
                reuse_factor=True,
                relative_tolerance=TRIED if tried else 1e-9,
                rough=tried,
                single=True,
            ),
            k,
        )

    if near:
        with contextlib.suppress(*(() if fits else (DataError,))):  # taken along, a body may not come to rest: then from rest
            states = list(_march(walk, frames, near, again, rough) if past else each(again, frames))
            yield from (keep(k, state) for k, state in zip(frames, states))
            return

    def along(part: list[int]) -> list[Equilibrium]:
        states: list[Equilibrium] = []
        for k in part:
            last = states[-1] if states else None
            before = last.segment_tensions if past and last is not None else None
            states.append(keep(k, _require(solve_frame(walk, k, start=last, before=before, single=True), k)))
        return states

    for states in each(along, [frames] if past else _parts(frames)):
        yield from states


def _parts(frames: list[int]) -> list[list[int]]:
    """Return frames cut into parts that are walked side by side; as many wherever it runs."""
    size = max(SHORTEST_PART, -(-len(frames) // PARTS))
    return [frames[i : i + size] for i in range(0, len(frames), size)]


def _nearest(walk: Walk, near: dict[int, Equilibrium], frames: list[int]) -> dict[int, Equilibrium]:
    """Return for other frames the states of those frames whose inputs and loads are most like theirs."""
    drive = walk.drive
    load = np.zeros((len(drive.inputs), 3))
    np.add.at(load, drive.load_frame, drive.load_forces)
    gravity = np.zeros((len(load), 0)) if drive.gravity is None else drive.gravity
    table = np.hstack([drive.inputs, drive.pressures, gravity, load])
    table = (table - table[0]) / np.maximum(np.ptp(table, axis=0), 1e-12)
    known = list(near)
    return {k: near[known[int(np.linalg.norm(table[known] - table[k], axis=1).argmin())]] for k in frames}


def _march(
    walk: Walk, frames: list[int], near: dict[int, Equilibrium], again: Callable[..., Equilibrium], rough: bool
) -> list[Equilibrium]:
    """Return the states of frames with a past, from states near by.

    The frames are cut into parts that are walked side by side, each from the tensions along the cables that the states near by let
    expect there. Then, part after part, frames are solved again until these are what the part before left.
    """
    parts = _parts(frames)
    expected = _expected_tensions(walk, frames, near)
    assumed = [None, *(expected[part[-1]] for part in parts[:-1])]
    result: dict[int, Equilibrium] = {}
    slack = PAST_TRIED if rough else PAST

    def along(i: int) -> list[Equilibrium]:
        states, before = [], assumed[i]
        for k in parts[i]:
            states.append(again(k, before))
            before = states[-1].segment_tensions
        return states

    for i, states in enumerate(each(along, range(len(parts)))):
        before = result[parts[i - 1][-1]].segment_tensions if i else None
        result.update(zip(parts[i], states))
        last = assumed[i]
        for k in parts[i]:
            if before is None or last is None or _as_before(before, last, slack):
                break
            last, result[k] = result[k].segment_tensions, again(k, before, result[k])
            before = result[k].segment_tensions
    return [result[k] for k in frames]


def _expected_tensions(walk: Walk, frames: list[int], near: dict[int, Equilibrium]) -> dict[int, tuple[FloatArray, ...]]:
    """Return the tensions along the cables in each frame if they bend as in states near by."""
    result: dict[int, tuple[FloatArray, ...]] = {}
    held, cables = walk.drive.control == "displacement", walk.robot.body.cables
    before = tuple(np.zeros(len(c.path)) for c in cables)
    for k in frames:
        state = near[k]
        motors = [state.tension[c.name] if held else float(T) for c, T in zip(cables, walk.drive.inputs[k])]
        before = tuple(rub(c, bend_angles(c, state.positions), b, max(T, 0.0)) for c, b, T in zip(cables, before, motors))
        result[k] = before
    return result


def _as_before(now: tuple[FloatArray, ...], then: tuple[FloatArray, ...], slack: float) -> bool:
    """Return whether the tensions along all cables are what they were."""
    return all(np.abs(a - b).max(initial=0.0) <= slack * max(1.0, float(a.max(initial=0.0))) for a, b in zip(now, then))


def _clamp_fits(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether a state can serve as a start as it is: one whose clamp gave way elsewhere would be torn back, one whose clamp has not yet would let
    go of the whole load at once."""
    return body.clamp_is_rigid != has_given(body, state)


def _taken_along(walk: Walk, frame: int, state: Equilibrium) -> Equilibrium | None:
    """Return a state with a rigid clamp as a start for a clamp that gives, the whole body taken along; None where that is no start."""
    balance = _Balance(walk, frame, state)
    moved = rigid_give(walk.robot.body, state.positions, balance.whole(walk, balance.along(walk), state.positions))
    return None if moved is None else replace(state, positions=moved)


def has_given(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether the clamp has given way in a state."""
    return bool(np.abs(state.positions[body.clamped] - body.mesh.nodes[body.clamped]).max(initial=0.0) >= 1e-9)


Tensions = tuple[FloatArray, ...]
"""Tensions along the cables [N], one array (s,) a cable."""
Job = tuple[int, int, list[int]]
"""Variant, the frame it is computed in, and all frames that it is the same in."""


@dataclass(frozen=True, eq=False, slots=True)
class _Upset:
    """What a variant adds to the balance of a base state."""

    key: tuple[int, int]
    """Variant, and the frame it is computed in."""
    start: FloatArray
    """Where its response starts [m], (n, 3)."""
    force: FloatArray | None
    """What it changes of the forces, but for tensions along cables [N], (n, 3); None: the answer to that is known."""
    tension: FloatArray
    """What it adds to the tensions along the segments of all cables [N], (s,)."""
    pulled: FloatArray
    """Shortening that it adds to held cables [m], (a,)."""


class _Answers:
    """The tangent of a base state, and what was solved with it."""

    def __init__(self, make: Callable[[], Tangent], times: int) -> None:
        self.make, self.times = make, times
        """times: how often it is asked."""
        self.own: dict[tuple[int, int], FloatArray | None] = {}
        """(variant, frame) → its answer to the forces of the variant but for tensions [m], (n, 3); None: there are none."""
        self.by_segment: dict[int, FloatArray] = {}
        """Segment, of all cables → the answer to a unit tension along it [m/N], (n, 3)."""

    @property
    def bytes(self) -> int:
        every = [*self.own.values(), *self.by_segment.values()]
        factor = 0 if self.factor is None else self.factor.bytes
        return factor + sum(a.nbytes for a in every if a is not None)

    @cached_property
    def tangent(self) -> Tangent:
        return self.make()

    @property
    def factor(self) -> Factorization | None:
        """The factor, if one was needed."""
        return self.tangent.factor if "tangent" in self.__dict__ else None

    @cached_property
    def by_held(self) -> FloatArray:
        """Held cable → the answer to a shortening by one metre [1], (h, n, 3)."""
        return self.tangent.respond_to_held()

    def keep(self, keys: Iterable[tuple[int, int]]) -> None:
        """Let go of the answers of other variants, and of the factor if further tensions are sums of the answers of segments: it is made again
        where it is needed after all."""
        self.own = {key: self.own[key] for key in keys if key in self.own}
        if self.by_segment:
            self.__dict__.pop("tangent", None)

    def to_forces_at(self, ties: Embedding) -> FloatArray:
        """Return the answers [m/N], (3p, n, 3), to a unit force at each of p points along each axis."""
        count = self.tangent.node_count
        at = ties.matrix(count).toarray()
        return self.tangent.respond(np.einsum("pn,ac->panc", at, np.eye(3)).reshape(-1, count, 3))

    def moves(self, body: BodyModel, x: FloatArray, upsets: list[_Upset]) -> FloatArray:
        """Return the answers to upsets [m], (v, n, 3): to their forces, where the answer is not known yet, and to tensions along the segments of all
        cables, sums of one answer for each segment where that takes fewer of them."""
        asked = [u for u in upsets if u.force is not None and u.force.any()]
        tensions = np.array([u.tension for u in upsets])
        pulling, used = np.flatnonzero(tensions.any(axis=1)), np.flatnonzero(tensions.any(axis=0)).tolist()
        new = [s for s in used if s not in self.by_segment]
        few = len(new) <= self.times * len(pulling)
        pulls = _segment_forces(body, x, new if few else used)
        columns = [
            *(u.force for u in asked if u.force is not None),
            *(pulls if few else np.tensordot(tensions[pulling][:, used], pulls, axes=1)),
        ]
        solved = self.tangent.respond(np.array(columns)) if columns else np.zeros((0, *x.shape))
        self.own.update({u.key: None for u in upsets if u.force is not None})
        self.own.update((u.key, move) for u, move in zip(asked, solved))
        moves, rest = np.zeros((len(upsets), *x.shape)), solved[len(asked) :]
        if few:
            self.by_segment.update(zip(new, rest))
            rest = (
                np.tensordot(tensions[pulling][:, used], np.array([self.by_segment[s] for s in used]), axes=1) if used else rest
            )
        moves[pulling] = rest
        for move, upset in zip(moves, upsets):
            own = self.own[upset.key]
            if own is not None:
                move += own
        return moves


def _segment_forces(body: BodyModel, x: FloatArray, which: list[int]) -> FloatArray:
    """Return the nodal forces of a unit tension along some segments of all cables [1], shape (s, n, 3)."""
    units = [(cable, unit) for cable in body.cables for unit in np.eye(len(cable.path))]
    forces = [cable_forces(units[s][0], x, units[s][1], len(x)) for s in which]
    return np.array(forces) if forces else np.zeros((0, *x.shape))


class _Variants:
    """What is observed of variants in the frames of a walk."""

    def __init__(
        self, walk: Walk, variants: Sequence[Walk], bases: dict[int, Equilibrium], alike: dict[int, int], others: dict[int, FloatArray],
        ties: Callable[[Robot], Embedding], lent: dict[int, Factorization | None], known: dict[int, AtPoints] | None,
    ) -> None:  # fmt: skip
        self.walk, self.variants, self.bases, self.alike, self.others, self.lent = walk, variants, bases, alike, others, lent
        self.ties = [ties(v.robot) for v in variants]
        self.own_ties = ties(walk.robot)
        self.known = None if len(self.own_ties) > MANY_POINTS or has_history(walk.robot) else known
        own = [not _same_mechanics(walk, v) for v in variants]
        linear = [_linear(walk, v) for v in variants]
        rubs = [has_history(v.robot) for v in variants]
        every = range(len(variants))
        self.still = [i for i in every if not own[i]]
        self.alone = [i for i in every if own[i] and not linear[i]]
        self.plain = [i for i in every if own[i] and linear[i] and not rubs[i]]
        self.rubbing = [i for i in every if own[i] and linear[i] and rubs[i]]
        self.along: dict[tuple[int, int], Tensions] = {}
        """(variant, frame) → tensions along its cables, of those that rub."""
        self.kept: dict[int, _Answers] = {}
        self.room = _room(len(set(alike.values())))

    def write(self) -> Iterator[tuple[int, Factorization | None]]:
        """Write all observations; yield the factors that gave them, with their frames."""
        for k, table in self.others.items():
            for i in self.still:
                table[i] = self.ties[i].positions(self.bases[k].positions)
        for i in self.alone:
            self._write_alone(i)
        if not self.plain and not self.rubbing:
            return
        if self.rubbing:  # twice: the second time with the bends as the first response leaves them
            bends = {(i, k): self._bends(i, self.bases[k].positions) for i in self.rubbing for k in self.bases}
            self._rub(bends)
            for k, factor, found in each(self._bent, self._groups(self.bases)):
                bends.update(found)
                yield k, factor
            self._rub(bends)
            deque(each(self._write_rubbing, self._groups(self.others)), maxlen=0)
        else:
            yield from each(self._written, self._groups(self.others))

    def _write_alone(self, i: int) -> None:
        """Write what is observed of a variant that is solved for itself."""
        variant = self.variants[i]
        memory: Tensions | None = None
        for k in self.bases if has_history(variant.robot) else self.others:
            state = _require(solve_frame(variant, k, start=self.bases[k], before=memory), k)
            memory = state.segment_tensions if has_history(variant.robot) else None
            if k in self.others:
                self.others[k][i] = self.ties[i].positions(state.positions)

    def _groups(self, frames: Iterable[int]) -> list[list[int]]:
        """Return the frames with one base state together."""
        groups: dict[int, list[int]] = {}
        for k in frames:
            groups.setdefault(self.alike[k], []).append(k)
        return list(groups.values())

    def _rub(self, bends: dict[tuple[int, int], list[FloatArray]]) -> None:
        """Move the tensions along the cables of all variants that rub from frame to frame, for given bends."""
        for i in self.rubbing:
            variant = self.variants[i]
            cables = variant.robot.body.cables
            before = tuple(np.zeros(len(c.path)) for c in cables)
            for k, base in self.bases.items():
                motors = _motor_tensions(variant, k, base)
                before = tuple(rub(c, angle, b, T) for c, angle, b, T in zip(cables, bends[i, k], before, motors))
                self.along[i, k] = before

    def _bends(self, i: int, x: FloatArray) -> list[FloatArray]:
        return [bend_angles(c, x) if c.friction > 0 else np.zeros(len(c.path)) for c in self.variants[i].robot.body.cables]

    def _answers(self, k: int) -> _Answers:
        columns, at_points = len(self.plain) + len(self.rubbing), 3 * len(self.own_ties)
        few = (at_points if self.known is not None else min(columns, at_points)) <= FEW_COLUMNS
        solver = partial(refined, lent=self.lent.get(k)) if few else factorize
        return _Answers(partial(tangent_at, self.walk.robot.body, self.bases[k], solver), 2 if self.rubbing else 1)

    def _jobs(self, group: list[int], which: Sequence[int]) -> list[Job]:
        """Return what is to be computed of some variants in frames with one base state."""
        jobs: dict[tuple[int, bytes], Job] = {}
        for i in which:
            for k in group:
                key = _key(self.variants[i], k) + b"".join(a.tobytes() for a in self.along.get((i, k), ()))
                jobs.setdefault((i, key), (i, k, []))[2].append(k)
        return list(jobs.values())

    def _bent(self, group: list[int]) -> tuple[int, Factorization | None, dict[tuple[int, int], list[FloatArray]]]:
        """Return the bends of the variants that rub, as the first response leaves them, and keep what the second one takes, where that fits into
        memory; write what is observed of the other variants."""
        first = self.alike[group[0]]
        answers, jobs = self._answers(first), self._jobs(group, self.rubbing)
        moved = list(zip(jobs, self._respond(group[0], self._upsets(group[0], jobs, answers), answers)))
        self._write(group, self.plain, answers)
        factor = answers.factor
        answers.keep(job[:2] for job in jobs)
        if answers.bytes < self.room and any(k in self.others for k in group):
            self.kept[first] = answers
        return first, factor, {(i, k): self._bends(i, x) for (i, _, frames), x in moved for k in frames}

    def _write_rubbing(self, group: list[int]) -> None:
        """Write what is observed of the variants that rub in frames with one base state."""
        first = self.alike[group[0]]
        self._write(group, self.rubbing, self.kept.pop(first) if first in self.kept else self._answers(first))

    def _written(self, group: list[int]) -> tuple[int, Factorization | None]:
        """Write what is observed of the variants, none of which rubs, in frames with one base state."""
        first = self.alike[group[0]]
        answers = self._answers(first)
        self._write(group, self.plain, answers)
        return first, answers.factor

    def _write(self, group: list[int], which: Sequence[int], answers: _Answers) -> None:
        """Write what is observed of some variants in frames with one base state, as far as that is asked."""
        frames = [k for k in group if k in self.others]
        jobs = self._jobs(frames, which)
        for (i, _, alike), seen in zip(jobs, self._seen(group[0], jobs, answers)) if jobs else ():
            for frame in alike:
                self.others[frame][i] = seen

    def _seen(self, frame: int, jobs: list[Job], answers: _Answers) -> list[FloatArray]:
        """Return where the points of variants are [m], each (p, 3): where these have so many forces of their own that it takes fewer solves, or the
        answers are kept, from those of the base state to forces at its points (Maxwell's reciprocity; friction of a held cable has none)."""
        upsets = self._upsets(frame, jobs, answers)
        alike = [self.ties[u.key[0]] is self.own_ties for u in upsets]
        pushes = sum(u.force is not None and bool(u.force.any()) for u, same in zip(upsets, alike) if same)
        if (self.known is None and pushes <= 3 * len(self.own_ties)) or has_history(self.walk.robot):
            alike = [False] * len(upsets)
        others = [u for u, same in zip(upsets, alike) if not same]
        moved = iter(self._respond(frame, others, answers) if others else ())
        pulled = iter(self._answered(frame, [u for u, same in zip(upsets, alike) if same], answers) if any(alike) else ())
        return [next(pulled) if same else self.ties[u.key[0]].positions(next(moved)) for u, same in zip(upsets, alike)]

    def _upsets(self, frame: int, jobs: list[Job], answers: _Answers) -> list[_Upset]:
        """Return what variants add to the balance of a base state."""
        base = self.bases[frame]
        balances = {k: _Balance(self.walk, k, base) for k in {k for _, k, _ in jobs}}
        upsets = list[_Upset]()
        for i, k, _ in jobs:
            balance, variant = balances[k], self.variants[i]
            start = balance.carried(variant)
            still = start is base.positions
            along = balance.along(variant) if (i, k) not in self.along else self.along[i, k]
            force = None
            if not still:
                force = balance.whole(variant, along, start) - balance.left()
            elif (i, k) not in answers.own:
                force = balance.change(variant)
            upsets.append(
                _Upset(
                    (i, k), start, force, balance.more_tension(along) * still, balance.pulled(variant, None if still else start)
                )
            )
        return upsets

    def _respond(self, frame: int, upsets: list[_Upset], answers: _Answers) -> list[FloatArray]:
        """Return the positions of variants [m], each (n, 3): to first order in what they add to the forces of the base state.

        Tensions along cables are all that many of them change: their answers are sums of one for each segment.
        """
        base, body = self.bases[frame], self.walk.robot.body
        moves = answers.moves(body, base.positions, upsets)
        if base.held.any():  # cables: pressures are never held here
            held = base.held[: len(body.cables)]
            moves += np.tensordot(np.array([u.pulled for u in upsets])[:, held], answers.by_held, axes=1)
        return [u.start + move for u, move in zip(upsets, moves)]

    def _answered(self, frame: int, upsets: list[_Upset], answers: _Answers) -> list[FloatArray]:
        """Return the same of the points alone [m], each (p, 3), from the answers to forces at these."""
        base, body, ties = self.bases[frame], self.walk.robot.body, self.own_ties
        x, tensions = base.positions, np.array([u.tension for u in upsets])
        at = self._at_points(frame, answers)
        by_point = at.to_forces
        used = np.flatnonzero(tensions.any(axis=0)).tolist()
        forces = np.array([np.zeros_like(x) if u.force is None else u.force for u in upsets])
        moves = np.tensordot(forces, by_point, axes=((1, 2), (1, 2)))
        moves += tensions[:, used] @ np.tensordot(_segment_forces(body, x, used), by_point, axes=((1, 2), (1, 2)))
        moves = moves.reshape(len(upsets), len(ties), 3)
        if base.held.any():
            held = base.held[: len(body.cables)]
            moves += np.tensordot(np.array([u.pulled for u in upsets])[:, held], at.to_held, axes=1)
        return [ties.positions(u.start) + move for u, move in zip(upsets, moves)]

    def _at_points(self, frame: int, answers: _Answers) -> AtPoints:
        """Return what the points of a base state answer to, kept where that is asked."""
        first, ties = self.alike[frame], self.own_ties
        if self.known is not None and first in self.known:
            return self.known[first]
        held = answers.by_held if self.bases[frame].held.any() else ()
        made = AtPoints(answers.to_forces_at(ties), np.array([ties.moves(move) for move in held]))
        if self.known is not None:
            self.known[first] = made
        return made


def _motor_tensions(variant: Walk, frame: int, base: Equilibrium) -> list[float]:
    """Return the tension at the motor of each cable [N]: of held ones as in the base state."""
    names = variant.robot.body.cable_names
    held = variant.drive.control == "displacement"
    return [base.tension[name] if held else float(T) for name, T in zip(names, variant.drive.inputs[frame])]


def _linear(walk: Walk, variant: Walk) -> bool:
    """Return whether the linear response gives a variant: the same elements, and a clamp that moves by little."""
    base, other = walk.robot.body, variant.robot.body
    return base.stencil.slots is other.stencil.slots and (base.clamp_is_rigid or not other.clamp_is_rigid)


def _rubbed(variant: Walk, frame: int, base: Equilibrium, x: FloatArray) -> Tensions:
    """Return the tensions along the cables of a variant at positions x if those of the base state are what was before."""
    motors = _motor_tensions(variant, frame, base)
    return tuple(
        rub(c, bend_angles(c, x), before, T) if c.friction > 0 else np.full(len(c.path), T)
        for c, before, T in zip(variant.robot.body.cables, base.segment_tensions, motors)
    )


class _Balance:
    """The forces that balance in the base state of a frame, and by how much a variant upsets them."""

    def __init__(self, walk: Walk, frame: int, base: Equilibrium) -> None:
        self.walk, self.frame, self.base = walk, frame, base
        self.body = self._body(walk)

    @cached_property
    def dead(self) -> FloatArray:
        """Weight and other dead forces [N], (n, 3)."""
        return self.body.dead_load()

    @cached_property
    def inner(self) -> FloatArray:
        """Inner forces [N], (n, 3)."""
        return internal(self.body, self.base.positions, tangent=False).forces

    @cached_property
    def by_element(self) -> FloatArray:
        """Inner forces of each element [N], (m, k, 3)."""
        return element_forces(self.body, self.base.positions)

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

    def along(self, variant: Walk) -> Tensions:
        """Return the tensions along a variant's cables where these do not rub."""
        motors = _motor_tensions(variant, self.frame, self.base)
        return tuple(np.full(len(c.path), T) for c, T in zip(variant.robot.body.cables, motors))

    def more_tension(self, along: Tensions) -> FloatArray:
        """Return by how much tensions along all cables differ from those of the base state [N], shape (s,)."""
        differences = [a - b for a, b in zip(along, self.base.segment_tensions)]
        return np.concatenate(differences) if differences else np.zeros(0)

    def whole(self, variant: Walk, tensions: Tensions, x: FloatArray) -> FloatArray:
        """Return all forces on a variant's body at x near the base state [N], (n, 3), for tensions along its cables."""
        body = self._body(variant)
        force = body.dead_load() + self._loads(variant) - internal(body, x, tangent=False).forces
        for cable, along in zip(body.cables, tensions):
            force = force + cable_forces(cable, x, along, len(x))
        for chamber, pressure in zip(body.chambers, variant.drive.pressures[self.frame]):
            force = force + pressure * volume_gradient(chamber, x)
        return np.asarray(force)

    def change(self, variant: Walk) -> FloatArray:
        """Return what a variant changes of the forces in the base state, where they sum to nothing, but for tensions along cables [N], (n, 3)."""
        body = self._body(variant)
        x, own, drive = self.base.positions, self.body, variant.drive
        force = np.zeros_like(x)
        if body is not own:
            force += body.dead_forces - own.dead_forces
            if not _same_weight(body, own):
                force += body.weight() - own.weight()
            self._add_inner(body, force)
        if drive.load_forces is not self.walk.drive.load_forces:
            force += self._loads(variant) - self._loads(self.walk)
        for i, chamber in enumerate(body.chambers):
            more = drive.pressures[self.frame, i] - self.walk.drive.pressures[self.frame, i]
            if more != 0.0:
                force += more * volume_gradient(chamber, x)
        return force

    def _add_inner(self, body: BodyModel, force: FloatArray) -> None:
        """Add by how much less another body resists to a force [N], (n, 3)."""
        own, x = self.body, self.base.positions
        springs = [(b.clamp_stiffness, b.clamp_turn_stiffness) for b in (body, own)]
        if springs[0] != springs[1] or not _same_but_modulus(body, own):
            force += self.inner - internal(body, x, tangent=False).forces
        elif body.material is not own.material:
            softer = 1.0 - body.material.young_modulus / own.material.young_modulus
            add_elements(own.stencil.tets, self.by_element, softer, force)

    def pulled(self, variant: Walk, x: FloatArray | None) -> FloatArray:
        """Return the shortening that a variant adds to held cables at x, by default in the base state [m], (a,)."""
        body, cables = self._body(variant), self.body.cables
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


FINER_STEPS = 8
FINER_ENOUGH = 5e-3
"""Newton steps on the finer mesh end when the unbalanced force has fallen to this share …"""
LAST_STEP = 0.2
"""… and the last one was no more than this share of the whole way: what bends easily may be far off and leave little force."""
PACES = (1.0, 0.5)
"""Shares of the first steps that are gone, tried in turn: whole ones fold elements where a body is bent much …"""
NEAR = 0.1
"""… until the unbalanced force has fallen to this share."""
LET_BE = 0.01
"""A held cable may push by this share of the largest tension, or a slack one be too long by this share of the way, before it goes slack or taut."""
EARLY = 3e-2
"""Share of the first of these steps that may be missing, in energy, which the next one mends; of the last ones ROUGH."""


def share_on_finer(body: BodyModel) -> None:
    """Make what the steps of all states on a finer mesh share, whatever its material: it is kept with the body's free map."""
    prepare_roughly(body.free_map.pattern)
    turned_step(body, body.mesh.nodes, np.zeros_like(body.mesh.nodes))


def finer_state(walk: Walk, fine: Walk, frame: int, base: Equilibrium, ties: Embedding) -> FloatArray | None:
    """Return where the nodes of a finer mesh come to rest [m], shape (n, 3), nearly: Newton steps from a state of a coarser one.

    The finer mesh holds the coarse state exactly, but what it softens are single elements, so that two to four steps are needed, with
    elements that turn along each of them. None where the steps do not settle, or run away: far off, forces look small again.

    Tried on the bar of `benchmarks/improve.py`, without use: a preconditioner kept from the first step of a state takes as much time in
    further iterations as it saves, one of another state takes several times as long, and `FINER_ENOUGH` = 0.02 moves the error by a sixth.
    To begin where the finer mesh lay beside another model saves a step of three, but elements that do not fit there may fold: the state was
    then missing, and the error of the mesh a third too small in that frame.

    Arguments:
        walk: the coarse robot and its drive.
        fine: the same on the finer mesh.
        frame: index of the frame.
        base: the coarse state of that frame.
        ties: of the fine nodes to the coarse mesh.
    """
    for pace in PACES:
        try:
            x = _stepped(walk, fine, frame, base, ties, pace)
        except FemsenseError:
            if pace == PACES[-1]:
                raise
            continue
        if x is not None:
            return x
    return None


def _stepped(walk: Walk, fine: Walk, frame: int, base: Equilibrium, ties: Embedding, pace: float) -> FloatArray | None:
    """Return what `finer_state` is after; the first steps go so far of the way."""
    body, balance = fine.robot.body, _Balance(walk, frame, base)
    x = coarse = ties.positions(base.positions)
    at, force, first = _pulling(fine, balance, base, x)
    size, share = first, 1.0
    for _ in range(FINER_STEPS):
        if size <= FINER_ENOUGH * first and share <= LAST_STEP:
            held, at = at.held, _retaut(fine, frame, at, x, LET_BE * np.abs(x - coarse).max())
            if (at.held == held).all():
                return x
        enough = min(EARLY, ROUGH * first / size) if size < first else EARLY
        here = replace(base, positions=x, factor=None, held=at.held)
        tangent = tangent_at(body, here, partial(roughly, tolerance=enough))
        move = tangent.respond(force[None])[0]
        if at.held.any():
            missing = _missing(fine, frame, at, x)[at.held[: len(body.cables)]]
            move = move + np.tensordot(missing, tangent.respond_to_held(), axes=1)
        move *= pace if size > NEAR * first else 1.0
        turned = turned_step(body, x, move)
        x = np.asarray(x + move) if turned is None else turned
        way = np.abs(x - coarse).max()
        if not way < body.reach:
            return None
        share = np.abs(move).max() / max(way, 1e-300)
        at, force, size = _pulling(fine, balance, at, x)
    return x if size <= FINER_ENOUGH * first else None


def _pulling(fine: Walk, balance: _Balance, at: Equilibrium, x: FloatArray) -> tuple[Equilibrium, FloatArray, float]:
    """Return a state with the tensions of its held cables that balance best at x, what they leave of the nodal forces there [N], (n, 3), and its
    size [N]."""
    body, dofs = fine.robot.body, fine.robot.body.free_map.dofs
    force = balance.whole(fine, _rubbed(fine, balance.frame, at, x), x)
    rest, held = force.ravel()[dofs], np.flatnonzero(at.held[: len(body.cables)])
    if len(held):
        pulls = drive_rows(body, x)[held][:, dofs].T
        more = -np.linalg.lstsq(pulls, rest, rcond=None)[0]
        rest = rest + pulls @ more
        names = body.cable_names
        at = replace(at, tension={**at.tension, **{names[i]: at.tension[names[i]] + float(m) for i, m in zip(held, more)}})
    whole = np.zeros(force.size)
    whole[dofs] = rest
    return at, whole.reshape(force.shape), float(np.linalg.norm(rest))


def _missing(fine: Walk, frame: int, at: Equilibrium, x: FloatArray) -> FloatArray:
    """Return the shortening that each cable lacks at x [m], (a,): what is wanted less what it has and what it stretches by."""
    body = fine.robot.body
    stretch = np.array([at.tension[c.name] / c.stretch_stiffness for c in body.cables])
    return np.asarray(fine.drive.inputs[frame] - stretch - shortening(body, x))


def _retaut(fine: Walk, frame: int, at: Equilibrium, x: FloatArray, least: float) -> Equilibrium:
    """Return a state at x with the held cables slack that would push there, and those taut that are too long by more than a length [m]."""
    if fine.drive.control != "displacement":
        return at
    names, held = fine.robot.body.cable_names, at.held.copy()
    T = np.array([at.tension[name] for name in names])
    taut, most = held[: len(names)], np.abs(T).max(initial=0.0)
    now = np.where(taut, -LET_BE * most < T, _missing(fine, frame, at, x) > least)
    held[: len(names)] = now
    return replace(at, held=held, tension={name: float(t) for name, t in zip(names, np.where(now, T, 0.0))})


def _same_but_modulus(body: BodyModel, other: BodyModel) -> bool:
    """Return whether the elements of two bodies answer alike, but for their modulus, where their meshes do not differ by what moves their nodes."""
    a, b = body.material, other.material
    if a is b or body.mesh is not other.mesh:
        return a is b
    return np.array_equal(a.poisson_ratio, b.poisson_ratio) and (a.law, a.stretch_limit) == (b.law, b.stretch_limit)


def _same_weight(body: BodyModel, other: BodyModel) -> bool:
    volume, others = body.stencil.node_volume, other.stencil.node_volume
    return (
        (volume is others or np.array_equal(volume, others))
        and body.material.density == other.material.density
        and np.array_equal(body.gravity, other.gravity)
    )


def _same_mechanics(walk: Walk, variant: Walk) -> bool:
    a, b = walk.drive, variant.drive
    return (
        variant.robot.body is walk.robot.body
        and np.array_equal(a.inputs, b.inputs)
        and np.array_equal(a.pressures, b.pressures)
        and np.array_equal(a.load_forces, b.load_forces)
    )


def _key(walk: Walk, frame: int) -> bytes:
    """Return what tells the drive of two frames apart."""
    drive = walk.drive
    rows = drive.load_frame == frame
    parts = [drive.inputs[frame], drive.pressures[frame], drive.load_points[rows].ravel(), drive.load_forces[rows].ravel()]
    if drive.gravity is not None:
        parts.append(drive.gravity[frame])
    return np.concatenate([np.asarray(p, dtype=float) for p in parts]).tobytes()


def _require(state: Equilibrium, frame: int) -> Equilibrium:
    if not state.converged:
        raise DataError(f"no equilibrium in frame {frame}: {state.status}: {state.advice} (unbalanced {state.residual_n:.2g} N)")
    return state
