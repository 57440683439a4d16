"""Follow a body from frame to frame while its inputs move: an equilibrium with a checked error, and its compliance, at camera rate.

A frame starts from one of two predictions: the last three frames carried on as a parabola, where that was near in the frame before,
or else the linear response to the change of the loads, by the factor at hand and along which elements turn. Either stretches elements
by a little too much, and it is the stress of this that spoils the stiffness there: with quadratic elements it is that of the rotations
predicted and of the stress of the frame before (stress that lags behind is what Magisano, Leonetti & Garcea, CMAME 313, 2017, make
Newton converge faster with), whose error is a tenth. Then a fresh factor and two corrections with it, until what they leave is a small share of the motion: where
the second is q times the first, the ones to come sum up to q/(1−q) of the second (Deuflhard 2011, section 2.1), and SAFETY times
that is the error that is reported. Where Newton does not get there, `solve_equilibrium` takes over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.arrays import FloatArray, as_points, freeze
from femsense.errors import FemsenseError, InputError
from femsense.fem.assembly import Internal, internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import add_cable_stiffness, pull_rows
from femsense.fem.cholesky import Cholesky, cholesky
from femsense.fem.compliance import direction_rows
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import embed_points
from femsense.fem.turning import turned_step

SAFETY = 3.0
"""The reported error is so many times what the corrections make one expect."""
LEAST_SHRINK = 0.05
"""No correction is trusted to leave less than this share of itself."""
NEAR = 0.03
"""The factor of a frame belongs to a state that is this share of the motion from its equilibrium at most."""
MOST = 6
"""Factorisations a frame, before the full solver takes over."""
SINGLE_FROM = 10_000
"""Unknowns from which on the factor is kept in single precision: the corrections forgive its errors."""


@dataclass(frozen=True, eq=False, slots=True)
class Tracked:
    """One frame of a tracked body."""

    positions: FloatArray
    """Node positions [m], shape (n, 3)."""
    error_m: float
    """How far any node may be from its equilibrium [m], estimated from how fast the corrections shrank."""
    motion_m: float
    """How far the farthest node has moved since the frame before [m]."""
    residual_n: float
    """Largest unbalanced nodal force before the last correction [N]."""
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
        self._single = len(body.free_map.dofs) >= SINGLE_FROM if single is None else single
        self._past: list[FloatArray] = []
        self._inputs: tuple[FloatArray, FloatArray] | None = None
        self._smooth = False
        blocks = len(body.stencil.block_columns), 9
        self._blocks = np.zeros(blocks, np.float32 if self._single else np.float64)
        keeps = body.mesh.is_quadratic and body.material.law == "corotational"
        self._stretch = np.zeros((len(body.mesh.tets), 4, 9)) if keeps else None
        self._source = np.asarray(body.free_map.source[body.free_map.pattern.analysis().source], dtype=np.int32)
        self._factor: Cholesky | None = None
        self._columns: dict[bytes, sp.csr_matrix] = {}

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
        loads = self.body.dead_load() + extra
        tracked = self._newton(T, loads) if self._factor is not None and (T >= 0).all() else None
        if tracked is None:
            tracked = self._solve_anew(given, extra)
        self._past, self._inputs = [*self._past[-2:], tracked.positions], (T, loads)
        return tracked

    def compliance(self, *, points: npt.ArrayLike = (), directions: npt.ArrayLike = ()) -> FloatArray:
        """Return W as `femsense.compliance` does [m/N], with the last factor of this frame (one Newton step before its state)."""
        if self._factor is None or not self._past:
            raise FemsenseError("nothing is tracked yet: call step first")
        P, D = as_points(points, "points"), as_points(directions, "directions")
        if P.shape != D.shape:
            raise InputError("points and directions differ in shape", where="directions", found=D.shape, expected=P.shape)
        n, free = len(self.body.mesh.nodes), self.body.free_map.dofs
        key = P.tobytes()
        if key not in self._columns:  # the same points frame after frame: x, y and z of each, once
            three = direction_rows(embed_points(self.body.mesh, np.repeat(P, 3, axis=0)), np.tile(np.eye(3), (len(P), 1)), n)
            self._columns = {key: sp.csr_matrix(three[:, free])}
        along = sp.csr_matrix((D.ravel(), np.arange(D.size), 3 * np.arange(len(D) + 1)), shape=(len(D), D.size))
        cables = sp.csr_matrix(pull_rows(self.body, self._past[-1])[:, free])
        return self._factor.gram(sp.csc_matrix(sp.vstack([along @ self._columns[key], cables]).T))

    def _newton(self, T: FloatArray, loads: FloatArray) -> Tracked | None:
        """Return the state, None where Newton does not get there."""
        last, free = self._past[-1], self.body.free_map.dofs
        x = self._predicted(T, loads)
        for count in range(1, MOST + 1):
            force = self._refresh(x, T, loads)
            if force is None or self._factor is None:
                return None
            first = self._factor.solve(force)
            x = _moved(x, free, first)
            force = self._unbalanced(internal(self.body, x, tangent=False, stretch=self._stretch), x, T, loads)
            second = self._factor.solve(force)
            x = _moved(x, free, second)
            size, shrink = _largest(second), _largest(second) / max(_largest(first), self._floor)
            if not np.isfinite(size) or shrink > 1.0:
                return None
            motion = _largest(x - last)
            error = max(SAFETY * size * max(shrink, LEAST_SHRINK) / max(1.0 - shrink, 0.1), self._floor)
            # a factor from farther off would flatter its corrections
            settled = _largest(first) <= max(NEAR * motion, self._floor)
            if settled and shrink < 0.5 and error <= max(self._tolerance * motion, self._floor):
                carried = self._carried()
                self._smooth = carried is not None and _largest(x - carried) <= NEAR * motion
                residual = _largest(np.linalg.norm(force.reshape(-1, 3), axis=1))
                return Tracked(freeze(x), error, motion, residual, count, False)
        return None

    def _carried(self) -> FloatArray | None:
        """Return the last three states carried on as a parabola, None where there are fewer."""
        return 3.0 * self._past[2] - 3.0 * self._past[1] + self._past[0] if len(self._past) == 3 else None

    def _predicted(self, T: FloatArray, loads: FloatArray) -> FloatArray:
        """Return where the nodes may be: carried on where that was near in the frame before, else as the body answers to new inputs."""
        last, carried = self._past[-1], self._carried()
        if carried is not None and self._smooth:
            return carried
        assert self._factor is not None and self._inputs is not None
        more = loads - self._inputs[1] + ((T - self._inputs[0]) @ pull_rows(self.body, last)).reshape(-1, 3)
        free = self.body.free_map.dofs
        step = _moved(np.zeros_like(last), free, self._factor.solve(more.ravel()[free]))
        turned = turned_step(self.body, last, step)
        return last + step if turned is None else turned

    def _unbalanced(self, here: Internal, x: FloatArray, T: FloatArray, loads: FloatArray) -> FloatArray:
        pull = T @ pull_rows(self.body, x) if len(T) else 0.0
        return np.asarray(((loads - here.forces).ravel() + pull)[self.body.free_map.dofs])

    def _refresh(self, x: FloatArray, T: FloatArray, loads: FloatArray) -> FloatArray | None:
        """Factorise the stiffness at x; return the unbalanced force there [N], None where the stiffness is not positive definite."""
        body, blocks = self.body, self._blocks
        here = internal(body, x, room=blocks, stretch=self._stretch)
        along = tuple(np.full(len(c.path), t) for c, t in zip(body.cables, T))
        add_cable_stiffness(body, x, along, blocks)
        self._factor = None  # its memory serves the next one
        self._factor = cholesky(body.free_map.pattern.analysis(), blocks.ravel(), single=self._single, source=self._source)
        return None if self._factor is None else self._unbalanced(here, x, T, loads)

    def _solve_anew(self, tension: Mapping[str, float], extra: FloatArray) -> Tracked:
        state = solve_equilibrium(self.body, tension=tension, nodal_forces=extra)
        if not state.converged:
            raise FemsenseError(f"no equilibrium: {state.status}: {state.advice}")
        motion = _largest(state.positions - (self._past[-1] if self._past else self.body.mesh.nodes))
        self._past = self._past[-1:]
        T = np.array(list(state.tension.values()))
        internal(self.body, state.positions, tangent=False, stretch=self._stretch)
        if self._refresh(state.positions, T, self.body.dead_load() + extra) is None:
            raise FemsenseError("the state is unstable: reduce the load")
        return Tracked(state.positions, self._floor, motion, state.residual_n, state.iterations, True)


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


def _moved(x: FloatArray, free: npt.NDArray[np.int64], correction: FloatArray) -> FloatArray:
    moved = x.ravel().copy()
    moved[free] += correction
    return moved.reshape(-1, 3)
