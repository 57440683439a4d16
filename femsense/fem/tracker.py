"""Follow a body from frame to frame while its inputs move: an equilibrium with a checked error, and its compliance, at camera rate.

A frame follows from a state at which the stiffness was factorised some frames ago, as a power series of up to three terms
(`femsense.fem.series`): two or three solves, no assembly, no factor. Where a series of terms x₁, x₂, x₃ is cut off, what is left is below
its last term; after three of them, with q = |x₃|/|x₂|, it is about q|x₃|/(1 − q), of which SAFETY times is reported. Where that is more than a small share
of the motion, or where the compliance has changed too much, the state at hand becomes the new start: one assembly, one factor, and the first
term from there is how far the old series has missed. That is compared with what was reported: where it was more, reports grow (`trust`).
Where no series settles, `solve_equilibrium` takes over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.arrays import FloatArray, as_points, freeze
from femsense.errors import FemsenseError, InputError
from femsense.fem.body import BodyModel
from femsense.fem.cables import pull_rows
from femsense.fem.compliance import direction_rows
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import embed_points
from femsense.fem.series import MEMORY, Expansion, combination

SAFETY = 5.0
"""The reported error is so many times what the terms make one expect."""
SHRINK = 0.5
"""A term that is more than this share of the one before settles nothing."""
NEAR = 0.005
"""The last frames carried on are a start where they missed by less than this share of the motion in the frame before."""
CLOSE = 0.03
"""A start that is made for a frame is this share of the motion from its equilibrium at most."""
DRIFT = 0.015
"""Share by which the compliance may be off where it is carried on from the last two starts."""
MOST = 5
"""Factorisations a frame, before the full solver takes over."""
SINGLE_FROM = 10_000
"""Unknowns from which on the factor is kept in single precision: the terms forgive its errors."""


@dataclass(frozen=True, eq=False, slots=True)
class Tracked:
    """One frame of a tracked body."""

    positions: FloatArray
    """Node positions [m], shape (n, 3)."""
    error_m: float
    """How far any node may be from its equilibrium [m], estimated from how fast the terms shrink."""
    motion_m: float
    """How far the farthest node has moved since the frame before [m]."""
    residual_n: float
    """Largest unbalanced nodal force before the last term [N]."""
    factorisations: int
    fell_back: bool
    """Whether the full solver had to take over."""


class Tracker:
    """A body without friction and held cables whose tensions and nodal forces change by little from frame to frame."""

    def __init__(self, body: BodyModel, *, tolerance: float = 0.01, floor_m: float = 1e-7, single: bool | None = None) -> None:
        """Prepare to track.

        Arguments:
            body: with its weight; cables with friction, chambers and a clamp that gives are for `solve_equilibrium`.
            tolerance: largest error of a frame, as a share of its motion.
            floor_m: an error that is always small enough, and never undercut by what is reported [m].
            single: keep the factor in single precision; by default from SINGLE_FROM unknowns on.

        Raises:
            InputError: the body has what a tracker does not know.
        """
        if body.chambers or not body.clamp_is_rigid or any(c.friction > 0 for c in body.cables):
            raise InputError("cannot be tracked", where="body", found="chambers, friction or a clamp that gives",
                             expected="cables under tension", hint="solve_equilibrium with start=… knows them")  # fmt: skip
        self.body = body
        self._tolerance, self._floor = tolerance, floor_m
        self.expansion = Expansion(body, single=len(body.free_map.dofs) >= SINGLE_FROM if single is None else single)
        self._past: list[FloatArray] = []
        self._tension = np.zeros(len(body.cables))
        self._smooth = False
        self._trust = 1.0
        self._reach = np.inf  # how far from the start the compliance may be carried on [m]
        self._columns: dict[bytes, sp.csr_matrix] = {}
        self._known: list[tuple[FloatArray, FloatArray]] = []  # the last starts, and the compliance there

    def step(self, *, tension: Mapping[str, float] | None = None, nodal_forces: npt.ArrayLike | None = None) -> Tracked:
        """Return the state under new tensions [N] (cables that are not named are slack) and nodal forces [N], shape (n, 3).

        Raises:
            InputError: wrong names or shapes; FemsenseError: no equilibrium.
        """
        names = self.body.cable_names
        given = dict(tension or {})
        if not set(given) <= set(names):
            raise InputError("unknown cable", where="tension", found=sorted(set(given) - set(names)), expected=", ".join(names))
        T = np.array([given.get(name, 0.0) for name in names])
        extra = np.zeros_like(self.body.mesh.nodes) if nodal_forces is None else as_points(nodal_forces, "nodal_forces")
        tracked = self._follow(T, self.body.dead_load() + extra) if self._past and (T >= 0).all() else None
        if tracked is None:
            tracked = self._solve_anew(given, extra)
        self._past, self._tension = [*self._past[-2:], tracked.positions], T
        return tracked

    def compliance(self, *, points: npt.ArrayLike = (), directions: npt.ArrayLike = ()) -> FloatArray:
        """Return W as `femsense.compliance` does [m/N]: that of the last start, carried on by how it has changed since the start before."""
        if not self._past:
            raise FemsenseError("nothing is tracked yet: call step first")
        P, D = as_points(points, "points"), as_points(directions, "directions")
        if P.shape != D.shape:
            raise InputError("points and directions differ in shape", where="directions", found=D.shape, expected=P.shape)
        k = len(P)
        whole = self._carried_compliance(self._past[-1], self._compliances(P))
        rows = (D[:, :, None] * whole[: 3 * k].reshape(k, 3, -1)).sum(axis=1)
        rows = np.concatenate([rows, whole[3 * k :]])
        columns = (rows[:, : 3 * k].reshape(len(rows), k, 3) * D).sum(axis=2)
        return np.concatenate([columns, rows[:, 3 * k :]], axis=1)

    def _compliances(self, P: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return the last starts and the compliance of x, y and z at points, and of the cables, there."""
        n, free, key = len(self.body.mesh.nodes), self.body.free_map.dofs, P.tobytes()
        if key not in self._columns:  # the same points frame after frame: their columns are made once
            three = direction_rows(embed_points(self.body.mesh, np.repeat(P, 3, axis=0)), np.tile(np.eye(3), (len(P), 1)), n)
            self._columns, self._known, self._reach = {key: sp.csr_matrix(three[:, free])}, [], 0.0
            if self.expansion.positions is not self._past[-1] and not self.expansion.move(self._past[-1], self._tension):
                raise FemsenseError("the state is unstable: reduce the load")
        x = self.expansion.positions
        if not self._known or self._known[-1][0] is not x:
            assert self.expansion.factor is not None
            cables = sp.csr_matrix(pull_rows(self.body, x)[:, free])
            here = self.expansion.factor.gram(sp.csc_matrix(sp.vstack([self._columns[key], cables]).T))
            if self._known:
                missed = _norm(here - self._carried_compliance(x, self._known)) / max(_norm(here), 1e-300)
                growth = min(max(DRIFT / max(missed, 1e-12), 0.5), 1.5)
                self._reach = growth * _largest(x - self._known[-1][0])
            self._known = [*self._known[1 - MEMORY :], (x, here)]
        return self._known

    def _carried_compliance(self, x: FloatArray, known: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
        weights = combination(x, [state for state, _ in known])
        return np.asarray(sum(weight * W for weight, (_, W) in zip(weights, known)))

    def _follow(self, T: FloatArray, loads: FloatArray) -> Tracked | None:
        """Return the state, None where no series gets there."""
        last, carried = self._past[-1], self._carried()
        far = not self.expansion.is_series or _largest(last - self.expansion.positions) > self._reach
        begins = [carried] if far and self._smooth and carried is not None else []
        expected = np.inf
        for count in range(MOST + 1):
            if begins and not self.expansion.move(begins[-1], T):
                return None
            x, first, error = self._summed(T, loads, last, 1 if far and not begins and not self.expansion.is_series else 3)
            if count > 0 and np.isfinite(expected):  # the first term is how far the series before has missed
                self._trust = max(0.9 * self._trust, 1.0, 1.2 * self._trust * first / expected)
            motion = _largest(x - last)
            # a start from farther off would flatter its terms
            trusted = first <= max(CLOSE * motion, self._floor) if begins else not far
            if error <= max(self._tolerance * motion, self._floor) and trusted:
                self._smooth = carried is not None and _largest(x - carried) <= NEAR * motion
                if begins:
                    self.expansion.learn(x)
                residual = _largest(np.linalg.norm(self.expansion.unbalanced, axis=1))
                return Tracked(freeze(x), error, motion, residual, len(begins), False)
            begins, expected = [*begins, x], error
        return None

    def _summed(self, T: FloatArray, loads: FloatArray, last: FloatArray, most: int) -> tuple[FloatArray, float, float]:
        """Return the sum of a series of so many terms at most, its first term and its error [m], inf where the terms do not shrink."""
        x, sizes, error = self.expansion.positions, list[float](), np.inf
        for term in islice(self.expansion.terms(T, loads), most):
            sizes.append(_largest(term))
            if not np.isfinite(sizes[-1]) or (len(sizes) > 1 and sizes[-1] > SHRINK * sizes[-2]):
                return x, sizes[0], np.inf
            x, error = x + term, sizes[-1]
            if len(sizes) == 3:
                shrink = sizes[2] / max(sizes[1], 1e-300)
                error = min(1.0, SAFETY * shrink / (1.0 - shrink)) * sizes[2]
            error = max(self._trust * error, self._floor)
            if error <= max(self._tolerance * _largest(x - last), self._floor):
                break
        return x, sizes[0], error

    def _carried(self) -> FloatArray | None:
        """Return the last three states carried on as a parabola, None where there are fewer."""
        return 3.0 * self._past[2] - 3.0 * self._past[1] + self._past[0] if len(self._past) == 3 else None

    def _solve_anew(self, tension: Mapping[str, float], extra: FloatArray) -> Tracked:
        state = solve_equilibrium(self.body, tension=tension, nodal_forces=extra)
        if not state.converged:
            raise FemsenseError(f"no equilibrium: {state.status}: {state.advice}")
        motion = _largest(state.positions - (self._past[-1] if self._past else self.body.mesh.nodes))
        self._past, self._known, self._smooth = self._past[-1:], [], False
        self.expansion.forget()
        self.expansion.learn(state.positions)
        if not self.expansion.move(state.positions, np.array(list(state.tension.values()))):
            raise FemsenseError("the state is unstable: reduce the load")
        return Tracked(state.positions, self._floor, motion, state.residual_n, state.iterations, True)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


def _norm(values: FloatArray) -> float:
    return float(np.linalg.norm(values))
