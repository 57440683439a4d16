"""Linear response of a solved state to small forces, with cached solves of its tangent."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel
from femsense.fem.cables import cable_forces
from femsense.fem.compliance import Tangent
from femsense.fem.linalg.factorization import Factorization
from femsense.fem.mesh import Embedding


@dataclass(frozen=True, eq=False, slots=True)
class AtPoints:
    """Adjoint responses of the observed points of a state, shared by all variants."""

    to_forces: FloatArray
    """Moves of the nodes under a unit force at each of p points along each axis,
    and so (Maxwell's reciprocity) of the points along each axis under unit nodal forces [m/N], (3p, n, 3)."""
    to_held: FloatArray
    """Moves of the points for a shortening of each held cable by one metre [1], (h, p, 3)."""


@dataclass(frozen=True, eq=False, slots=True)
class Upset:
    """Residual forces and tensions of a variant in a base state."""

    key: tuple[int, int]
    """Variant, and the frame it is computed in."""
    start: FloatArray
    """Where its response starts [m], (n, 3)."""
    force: FloatArray | None
    """Residual forces, without the change of tensions along cables [N], (n, 3); None: their response is known."""
    tension: FloatArray
    """Change of the tensions along the segments of all cables [N], (s,)."""
    pulled: FloatArray
    """Shortening that it adds to held cables [m], (a,)."""


class Answers:
    """The tangent of a base state with its cached solves."""

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
        """Let go of the answers of other variants, and of the factor if further tensions are sums of the answers of segments:
        it is made again where it is needed after all."""
        self.own = {key: self.own[key] for key in keys if key in self.own}
        if self.by_segment:
            self.__dict__.pop("tangent", None)

    def to_forces_at(self, ties: Embedding) -> FloatArray:
        """Return the answers [m/N], (3p, n, 3), to a unit force at each of p points along each axis."""
        count = self.tangent.node_count
        at = ties.matrix(count).toarray()
        return self.tangent.respond(np.einsum("pn,ac->panc", at, np.eye(3)).reshape(-1, count, 3))

    def moves(self, body: BodyModel, x: FloatArray, upsets: list[Upset]) -> FloatArray:
        """Return the answers to upsets [m], (v, n, 3): to their forces, where the answer is not known yet,
        and to tensions along the segments of all cables, sums of one answer for each segment where that takes fewer of them."""
        asked = [u for u in upsets if u.force is not None and u.force.any()]
        tensions = np.array([u.tension for u in upsets])
        pulling, used = np.flatnonzero(tensions.any(axis=1)), np.flatnonzero(tensions.any(axis=0)).tolist()
        new = [s for s in used if s not in self.by_segment]
        few = len(new) <= self.times * len(pulling)
        pulls = segment_forces(body, x, new if few else used)
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


def segment_forces(body: BodyModel, x: FloatArray, which: list[int]) -> FloatArray:
    """Return the nodal forces of a unit tension along some segments of all cables [1], shape (s, n, 3)."""
    units = [(cable, unit) for cable in body.cables for unit in np.eye(len(cable.path))]
    forces = [cable_forces(units[s][0], x, units[s][1], len(x)) for s in which]
    return np.array(forces) if forces else np.zeros((0, *x.shape))
