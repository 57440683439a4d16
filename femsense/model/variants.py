"""States of slightly different robots, by the linear response of a solved state."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.parallel import each
from femsense.fem.cables import bend_angles
from femsense.fem.capstan import capstan_tensions
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.fem.linalg.factorization import Factorization, available_memory, factorize
from femsense.fem.linalg.refinement import refined
from femsense.fem.mesh import Embedding
from femsense.model.balance import Balance, Tensions, motor_tensions
from femsense.model.drive import DrivenRobot, body_in, frame_key, has_history
from femsense.model.frame_state import require_converged
from femsense.model.linear_answers import Answers, AtPoints, Upset, segment_forces
from femsense.model.path_solver import PathSolver
from femsense.model.robot import Robot

FACTOR_MEMORY = 1e9
"""Factors of several frames are kept up to this total [bytes], and up to MEMORY_SHARE of the memory that is free."""
MEMORY_SHARE = 0.25
FEW_COLUMNS = 40
"""Number of right-hand sides from which iterative correction takes longer than a factor in double precision."""
MANY_POINTS = 40
"""Answers to forces at more points than that are not kept."""


def room_for_factor(count: int) -> float:
    """Return how much memory a factor may take where so many are kept [bytes]."""
    return min(FACTOR_MEMORY, MEMORY_SHARE * available_memory()) / max(count, 1)


def most_lent(state: Equilibrium, room: float) -> float:
    """Return how many bytes a factor may take to be kept with a state: no more than the one it takes the place of,
    which is near enough."""
    return room if state.factor is None else min(room, state.factor.bytes + 1)


Job = tuple[int, int, list[int]]
"""Variant, the frame it is computed in, and all frames that it is the same in."""


class Variants:
    """Observed points of variants in the frames of a path."""

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
        solver: PathSolver,
    ) -> None:
        self.solver = solver
        self.driven, self.variants, self.bases, self.alike, self.others, self.lent = driven, variants, bases, alike, others, lent
        self.ties = [ties(v.robot) for v in variants]
        self.own_ties = ties(driven.robot)
        self.known = None if len(self.own_ties) > MANY_POINTS or has_history(driven.robot) else known
        own = [not same_mechanics(driven, v) for v in variants]
        linear = [is_linear(driven, v) for v in variants]
        rubs = [has_history(v.robot) for v in variants]
        every = range(len(variants))
        self.still = [i for i in every if not own[i]]
        self.alone = [i for i in every if own[i] and not linear[i]]
        self.plain = [i for i in every if own[i] and linear[i] and not rubs[i]]
        self.rubbing = [i for i in every if own[i] and linear[i] and rubs[i]]
        self.along: dict[tuple[int, int], Tensions] = {}
        """(variant, frame) → tensions along its cables, of those that rub."""
        self.kept: dict[int, Answers] = {}
        self.room = room_for_factor(len(set(alike.values())))

    def write(self) -> Iterator[tuple[int, Factorization | None]]:
        """Write all observations; yield the factors that gave them, with their frames."""
        for k, table in self.others.items():
            for i in self.still:
                table[i] = self.ties[i].positions(self.bases[k].positions)
        for i in self.alone:
            self._write_alone(i)
        if not self.plain and not self.rubbing:
            return
        if self.rubbing:  # twice: the second pass uses the bend angles after the first response
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
        """Write the observed points of a variant that is solved nonlinearly."""
        variant = self.variants[i]
        memory: Tensions | None = None
        for k in self.bases if has_history(variant.robot) else self.others:
            state = require_converged(
                self.solver.equilibrium(variant, k, start=self.bases[k], options=SolveOptions(before=memory)), k
            )
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
                motors = motor_tensions(variant, k, base)
                before = tuple(capstan_tensions(c, angle, b, T) for c, angle, b, T in zip(cables, bends[i, k], before, motors))
                self.along[i, k] = before

    def _bends(self, i: int, x: FloatArray) -> list[FloatArray]:
        return [bend_angles(c, x) if c.friction > 0 else np.zeros(len(c.path)) for c in self.variants[i].robot.body.cables]

    def _answers(self, k: int) -> Answers:
        columns, at_points = len(self.plain) + len(self.rubbing), 3 * len(self.own_ties)
        few = (at_points if self.known is not None else min(columns, at_points)) <= FEW_COLUMNS
        solver = partial(refined, lent=self.lent.get(k)) if few else factorize
        return Answers(partial(self.solver.tangent, body_in(self.driven, k), self.bases[k], solver), 2 if self.rubbing else 1)

    def _jobs(self, group: list[int], which: Sequence[int]) -> list[Job]:
        """Return the tasks of some variants in frames with the same base state."""
        jobs: dict[tuple[int, bytes], Job] = {}
        for i in which:
            for k in group:
                key = frame_key(self.variants[i], k) + b"".join(a.tobytes() for a in self.along.get((i, k), ()))
                jobs.setdefault((i, key), (i, k, []))[2].append(k)
        return list(jobs.values())

    def _bent(self, group: list[int]) -> tuple[int, Factorization | None, dict[tuple[int, int], list[FloatArray]]]:
        """Return the bends of the variants that rub, as the first response leaves them, and keep what the second one takes,
        where that fits into memory; write what is observed of the other variants."""
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

    def _write(self, group: list[int], which: Sequence[int], answers: Answers) -> None:
        """Write what is observed of some variants in frames with one base state, as far as that is asked."""
        frames = [k for k in group if k in self.others]
        jobs = self._jobs(frames, which)
        for (i, _, alike), seen in zip(jobs, self._seen(group[0], jobs, answers)) if jobs else ():
            for frame in alike:
                self.others[frame][i] = seen

    def _seen(self, frame: int, jobs: list[Job], answers: Answers) -> list[FloatArray]:
        """Return where the points of variants are [m], each (p, 3):
        where these have so many forces of their own that it takes fewer solves, or the answers are kept, from those of the base
        state to forces at its points (Maxwell's reciprocity; friction of a held cable has none)."""
        upsets = self._upsets(frame, jobs, answers)
        alike = [self.ties[u.key[0]] is self.own_ties for u in upsets]
        pushes = sum(u.force is not None and bool(u.force.any()) for u, same in zip(upsets, alike) if same)
        if (self.known is None and pushes <= 3 * len(self.own_ties)) or has_history(self.driven.robot):
            alike = [False] * len(upsets)
        others = [u for u, same in zip(upsets, alike) if not same]
        moved = iter(self._respond(frame, others, answers) if others else ())
        pulled = iter(self._answered(frame, [u for u, same in zip(upsets, alike) if same], answers) if any(alike) else ())
        return [next(pulled) if same else self.ties[u.key[0]].positions(next(moved)) for u, same in zip(upsets, alike)]

    def _upsets(self, frame: int, jobs: list[Job], answers: Answers) -> list[Upset]:
        """Return the residual forces and tensions of variants in a base state."""
        base = self.bases[frame]
        balances = {k: Balance(self.driven, k, base) for k in {k for _, k, _ in jobs}}
        upsets = list[Upset]()
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
                Upset(
                    (i, k), start, force, balance.more_tension(along) * still, balance.pulled(variant, None if still else start)
                )
            )
        return upsets

    def _respond(self, frame: int, upsets: list[Upset], answers: Answers) -> list[FloatArray]:
        """Return the positions of variants [m], each (n, 3): to first order in what they add to the forces of the base state.

        Tensions along cables are all that many of them change: their answers are sums of one for each segment.
        """
        base, body = self.bases[frame], self.driven.robot.body
        moves = answers.moves(body, base.positions, upsets)
        if base.held.any():  # cables: pressures are never held here
            held = base.held[: len(body.cables)]
            moves += np.tensordot(np.array([u.pulled for u in upsets])[:, held], answers.by_held, axes=1)
        return [u.start + move for u, move in zip(upsets, moves)]

    def _answered(self, frame: int, upsets: list[Upset], answers: Answers) -> list[FloatArray]:
        """Return the same of the points alone [m], each (p, 3), from the answers to forces at these."""
        base, body, ties = self.bases[frame], self.driven.robot.body, self.own_ties
        x, tensions = base.positions, np.array([u.tension for u in upsets])
        at = self._at_points(frame, answers)
        by_point = at.to_forces
        used = np.flatnonzero(tensions.any(axis=0)).tolist()
        forces = np.array([np.zeros_like(x) if u.force is None else u.force for u in upsets])
        moves = np.tensordot(forces, by_point, axes=((1, 2), (1, 2)))
        moves += tensions[:, used] @ np.tensordot(segment_forces(body, x, used), by_point, axes=((1, 2), (1, 2)))
        moves = moves.reshape(len(upsets), len(ties), 3)
        if base.held.any():
            held = base.held[: len(body.cables)]
            moves += np.tensordot(np.array([u.pulled for u in upsets])[:, held], at.to_held, axes=1)
        return [ties.positions(u.start) + move for u, move in zip(upsets, moves)]

    def _at_points(self, frame: int, answers: Answers) -> AtPoints:
        """Return the adjoint responses of the points of a base state, cached on request."""
        first, ties = self.alike[frame], self.own_ties
        if self.known is not None and first in self.known:
            return self.known[first]
        held = answers.by_held if self.bases[frame].held.any() else ()
        made = AtPoints(answers.to_forces_at(ties), np.array([ties.moves(move) for move in held]))
        if self.known is not None:
            self.known[first] = made
        return made


def is_linear(driven: DrivenRobot, variant: DrivenRobot) -> bool:
    """Return whether the linear response gives a variant: the same elements, and a clamp that moves by little."""
    base, other = driven.robot.body, variant.robot.body
    return base.stencil.slots is other.stencil.slots and (base.clamp_is_rigid or not other.clamp_is_rigid)


def same_mechanics(driven: DrivenRobot, variant: DrivenRobot) -> bool:
    """Return whether a variant has the same body under the same loads, so that only its observation differs."""
    a, b = driven.drive, variant.drive
    return (
        variant.robot.body is driven.robot.body
        and np.array_equal(a.inputs, b.inputs)
        and np.array_equal(a.pressures, b.pressures)
        and np.array_equal(a.load_forces, b.load_forces)
        and a.softness is b.softness
    )
