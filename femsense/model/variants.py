"""States of robots that differ from a solved one by little: the linear response of that state to what they change."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.parallel import each
from femsense.fem.assembly import add_elements, element_forces, internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import bend_angles, cable_forces, rub, shortening
from femsense.fem.chambers import volume_gradient
from femsense.fem.clamp import first_give
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.linalg.factorization import Factorization, available_memory, factorize
from femsense.fem.linalg.refinement import refined
from femsense.fem.mesh import Embedding
from femsense.model.drive import DrivenRobot, _key, body_in, frame_loads, has_history
from femsense.model.robot import Robot

FACTOR_MEMORY = 2e9
"""Factors of several frames are kept up to this total [bytes], and up to MEMORY_SHARE of the memory that is free."""


MEMORY_SHARE = 0.25


FEW_COLUMNS = 40
"""With more right-hand sides of a state the solves that correct them take longer than a factor in double precision."""


MANY_POINTS = 40
"""Answers to forces at more points than that are not kept."""


@dataclass(frozen=True, eq=False, slots=True)
class AtPoints:
    """What the observed points of a state answer to, whatever the variant."""

    to_forces: FloatArray
    """Moves of the nodes under a unit force at each of p points along each axis, and so (Maxwell's reciprocity) of the points along each axis under
    unit nodal forces [m/N], (3p, n, 3)."""
    to_held: FloatArray
    """Moves of the points for a shortening of each held cable by one metre [1], (h, p, 3)."""


def solve_frame(
    driven: DrivenRobot,
    frame: int,
    *,
    start: Equilibrium | None = None,
    nodal_forces: FloatArray | None = None,
    options: SolveOptions | None = None,
) -> Equilibrium:
    """Return the equilibrium of one frame.

    Arguments:
        driven: robot and drive.
        frame: index of the frame.
        start: a state to start from.
        nodal_forces: forces beside the known loads [N], shape (n, 3).
        options: as of `solve_equilibrium`; friction remembers nothing where they do not say.
    """
    drive, body = driven.drive, body_in(driven, frame)
    loads = frame_loads(driven, frame)
    if nodal_forces is not None:
        loads = nodal_forces if loads is None else loads + nodal_forces
    values = {name: float(v) for name, v in zip(body.cable_names, drive.inputs[frame])}
    how = options or SolveOptions()
    if how.before is None:
        how = replace(how, before=tuple(np.zeros(len(c.path)) for c in body.cables))
    tension, held = (values, None) if drive.control == "tension" else (None, values)
    return solve_equilibrium(
        body,
        tension=tension,
        shortening=held,
        pressure=dict(zip(body.chamber_names, drive.pressures[frame].tolist())),
        nodal_forces=loads,
        start=start,
        options=how,
    )


def _room(count: int) -> float:
    """Return how much memory a factor may take where so many are kept [bytes]."""
    return min(FACTOR_MEMORY, MEMORY_SHARE * available_memory()) / max(count, 1)


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
    """What is observed of variants in the frames of a path."""

    def __init__(
        self,
        driven: DrivenRobot,
        variants: Sequence[DrivenRobot],
        bases: dict[int, Equilibrium],
        alike: dict[int, int],
        others: dict[int, FloatArray],
        ties: Callable[[Robot], Embedding],
        lent: dict[int, Factorization | None],
        known: dict[int, AtPoints] | None,
    ) -> None:
        self.driven, self.variants, self.bases, self.alike, self.others, self.lent = driven, variants, bases, alike, others, lent
        self.ties = [ties(v.robot) for v in variants]
        self.own_ties = ties(driven.robot)
        self.known = None if len(self.own_ties) > MANY_POINTS or has_history(driven.robot) else known
        own = [not _same_mechanics(driven, v) for v in variants]
        linear = [_linear(driven, v) for v in variants]
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
            state = _require(solve_frame(variant, k, start=self.bases[k], options=SolveOptions(before=memory)), k)
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
        return _Answers(partial(tangent_at, body_in(self.driven, k), self.bases[k], solver), 2 if self.rubbing else 1)

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
        if (self.known is None and pushes <= 3 * len(self.own_ties)) or has_history(self.driven.robot):
            alike = [False] * len(upsets)
        others = [u for u, same in zip(upsets, alike) if not same]
        moved = iter(self._respond(frame, others, answers) if others else ())
        pulled = iter(self._answered(frame, [u for u, same in zip(upsets, alike) if same], answers) if any(alike) else ())
        return [next(pulled) if same else self.ties[u.key[0]].positions(next(moved)) for u, same in zip(upsets, alike)]

    def _upsets(self, frame: int, jobs: list[Job], answers: _Answers) -> list[_Upset]:
        """Return what variants add to the balance of a base state."""
        base = self.bases[frame]
        balances = {k: _Balance(self.driven, k, base) for k in {k for _, k, _ in jobs}}
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
        base, body = self.bases[frame], self.driven.robot.body
        moves = answers.moves(body, base.positions, upsets)
        if base.held.any():  # cables: pressures are never held here
            held = base.held[: len(body.cables)]
            moves += np.tensordot(np.array([u.pulled for u in upsets])[:, held], answers.by_held, axes=1)
        return [u.start + move for u, move in zip(upsets, moves)]

    def _answered(self, frame: int, upsets: list[_Upset], answers: _Answers) -> list[FloatArray]:
        """Return the same of the points alone [m], each (p, 3), from the answers to forces at these."""
        base, body, ties = self.bases[frame], self.driven.robot.body, self.own_ties
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


def _motor_tensions(variant: DrivenRobot, frame: int, base: Equilibrium) -> list[float]:
    """Return the tension at the motor of each cable [N]: of held ones as in the base state."""
    names = variant.robot.body.cable_names
    held = variant.drive.control == "displacement"
    return [base.tension[name] if held else float(T) for name, T in zip(names, variant.drive.inputs[frame])]


def _linear(driven: DrivenRobot, variant: DrivenRobot) -> bool:
    """Return whether the linear response gives a variant: the same elements, and a clamp that moves by little."""
    base, other = driven.robot.body, variant.robot.body
    return base.stencil.slots is other.stencil.slots and (base.clamp_is_rigid or not other.clamp_is_rigid)


def _rubbed(variant: DrivenRobot, frame: int, base: Equilibrium, x: FloatArray) -> Tensions:
    """Return the tensions along the cables of a variant at positions x if those of the base state are what was before."""
    motors = _motor_tensions(variant, frame, base)
    return tuple(
        rub(c, bend_angles(c, x), before, T) if c.friction > 0 else np.full(len(c.path), T)
        for c, before, T in zip(variant.robot.body.cables, base.segment_tensions, motors)
    )


class _Balance:
    """The forces that balance in the base state of a frame, and by how much a variant upsets them."""

    def __init__(self, driven: DrivenRobot, frame: int, base: Equilibrium) -> None:
        self.driven, self.frame, self.base = driven, frame, base
        self.body = self._body(driven)

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

    def _body(self, driven: DrivenRobot) -> BodyModel:
        return body_in(driven, self.frame)

    def _loads(self, driven: DrivenRobot) -> FloatArray:
        loads = frame_loads(driven, self.frame)
        return np.zeros((len(driven.robot.body.mesh.nodes), 3)) if loads is None else loads

    def carried(self, variant: DrivenRobot) -> FloatArray:
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

    def along(self, variant: DrivenRobot) -> Tensions:
        """Return the tensions along a variant's cables where these do not rub."""
        motors = _motor_tensions(variant, self.frame, self.base)
        return tuple(np.full(len(c.path), T) for c, T in zip(variant.robot.body.cables, motors))

    def more_tension(self, along: Tensions) -> FloatArray:
        """Return by how much tensions along all cables differ from those of the base state [N], shape (s,)."""
        differences = [a - b for a, b in zip(along, self.base.segment_tensions)]
        return np.concatenate(differences) if differences else np.zeros(0)

    def whole(self, variant: DrivenRobot, tensions: Tensions, x: FloatArray) -> FloatArray:
        """Return all forces on a variant's body at x near the base state [N], (n, 3), for tensions along its cables."""
        body = self._body(variant)
        force = body.dead_load() + self._loads(variant) - internal(body, x, tangent=False).forces
        for cable, along in zip(body.cables, tensions):
            force = force + cable_forces(cable, x, along, len(x))
        for chamber, pressure in zip(body.chambers, variant.drive.pressures[self.frame]):
            force = force + pressure * volume_gradient(chamber, x)
        return np.asarray(force)

    def change(self, variant: DrivenRobot) -> FloatArray:
        """Return what a variant changes of the forces in the base state, where they sum to nothing, but for tensions along cables [N], (n, 3)."""
        body = self._body(variant)
        x, own, drive = self.base.positions, self.body, variant.drive
        force = np.zeros_like(x)
        if body is not own:
            force += body.dead_forces - own.dead_forces
            if not _same_weight(body, own):
                force += body.weight() - own.weight()
            self._add_inner(body, force)
            self._add_paths(body, force)
        if drive.load_forces is not self.driven.drive.load_forces:
            force += self._loads(variant) - self._loads(self.driven)
        for i, chamber in enumerate(body.chambers):
            more = drive.pressures[self.frame, i] - self.driven.drive.pressures[self.frame, i]
            if more != 0.0:
                force += more * volume_gradient(chamber, x)
        return force

    def _add_paths(self, body: BodyModel, force: FloatArray) -> None:
        """Add what the tensions of the base state do along the paths of another body, where these run elsewhere, to a force [N], (n, 3)."""
        x = self.base.positions
        for cable, own, along in zip(body.cables, self.body.cables, self.base.segment_tensions):
            if cable.path is not own.path and along.any():
                force += cable_forces(cable, x, along, len(x)) - cable_forces(own, x, along, len(x))

    def _add_inner(self, body: BodyModel, force: FloatArray) -> None:
        """Add by how much less another body resists to a force [N], (n, 3)."""
        own, x = self.body, self.base.positions
        springs = [(b.clamp_stiffness, b.clamp_turn_stiffness) for b in (body, own)]
        if springs[0] != springs[1] or not _same_but_modulus(body, own):
            force += self.inner - internal(body, x, tangent=False).forces
        elif body.material is not own.material:
            softer = 1.0 - body.material.young_modulus / own.material.young_modulus
            add_elements(own.stencil.tets, self.by_element, softer, force)

    def pulled(self, variant: DrivenRobot, x: FloatArray | None) -> FloatArray:
        """Return the shortening that a variant adds to held cables at x, by default in the base state [m], (a,)."""
        body, cables = self._body(variant), self.body.cables
        if variant.drive.control != "displacement":
            return np.zeros(len(cables))
        stretch = [
            self.base.tension[c.name] * (1.0 / b.stretch_stiffness - 1.0 / c.stretch_stiffness)
            for b, c in zip(cables, body.cables)
        ]
        pulled = variant.drive.inputs[self.frame] - self.driven.drive.inputs[self.frame] + np.array(stretch)
        if x is None and any(b.path is not c.path for b, c in zip(body.cables, cables)):
            x = self.base.positions
        if x is not None:
            pulled = pulled - shortening(body, x) + shortening(self.body, self.base.positions)
        return np.asarray(pulled)


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
        and body.carried_mass is other.carried_mass
        and body.material.density == other.material.density
        and np.array_equal(body.gravity, other.gravity)
    )


def _same_mechanics(driven: DrivenRobot, variant: DrivenRobot) -> bool:
    a, b = driven.drive, variant.drive
    return (
        variant.robot.body is driven.robot.body
        and np.array_equal(a.inputs, b.inputs)
        and np.array_equal(a.pressures, b.pressures)
        and np.array_equal(a.load_forces, b.load_forces)
        and a.softness is b.softness
    )


def _require(state: Equilibrium, frame: int) -> Equilibrium:
    if not state.converged:
        raise DataError(f"no equilibrium in frame {frame}: {state.status}: {state.advice} (unbalanced {state.residual_n:.2g} N)")
    return state
