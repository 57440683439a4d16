"""Follow a body from frame to frame while its inputs move: an equilibrium with a checked error, and its compliance,
at camera rate.

A frame follows from a state at which the stiffness was factorised some frames ago, as a power series of up to three terms
(`femsense.fem.realtime.power_series`): two or three solves, no assembly, no factor. Where a series of terms x₁, x₂,
x₃ is cut off, what is left is below its last term, and that is what is reported; where two terms do, it is what the third is
expected to be, from the frame before. Where that will soon be more than a small share of the motion, or where the compliance has
changed too much, a new start is made a little ahead on the way. Where a series fails at once, its sum becomes the start, and the
first term from there is how far the old series has missed. That is compared with what was reported: where it was more, reports
grow (`trust`). The compliance is known at the starts, and carried on from them. Where no series settles,
`solve_equilibrium` takes over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, as_points, freeze
from femsense.core.errors import FemsenseError, InputError
from femsense.fem.body import BodyModel
from femsense.fem.cables import pull_rows
from femsense.fem.compliance import direction_rows
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import embed_points
from femsense.fem.realtime.power_series import Expansion, combination

GUESS = 4.0
"""Where the third term is only expected, from how it grew in frames before, the reported error is so many times that …"""
FADES = 0.9
"""… and how it grew counts by so much less with every third term that was seen since."""
SHRINK = 0.5
"""A term that is more than this share of the one before settles nothing."""
NEAR = 0.005
"""The last frames carried on are a start where they missed by less than this share of the motion in the frame before."""
CLOSE = 0.03
"""A start that is made for a frame is this share of the motion from its equilibrium at most."""
LOOK, AHEAD = 0.25, 0.5
"""A new start is made where the series would fail this share of a motion farther on, and so much of one ahead on the way."""
DRIFT = 0.0165
"""Share by which the compliance may be off where it is carried on from other states."""
LIBRARY = 16
"""States at most whose compliance is kept."""
EXPLORED = 0.02
"""How far a body is bent by each cable, as a share of its size, to learn how the compliance changes."""
SOUND = 1e-5
"""The stretches of a state are learnt where its error is below this share of the body's size."""
MOST = 5
"""Factorisations a frame, before the full solver takes over."""
SINGLE_FROM = 10_000
"""Unknowns from which on the factor is kept in single precision: the terms forgive its errors."""


@dataclass(frozen=True, eq=False, slots=True)
class Tracked:
    """Result of `Tracker.step`: the state of a body in one frame."""

    positions: FloatArray
    """Node positions [m], shape (n, 3)."""
    error_m: float
    """Estimated largest distance of a node from its equilibrium [m], from the convergence of the series."""
    motion_m: float
    """Largest displacement of a node since the previous frame [m]."""
    residual_n: float
    """Largest unbalanced nodal force before the last term [N]."""
    factorisations: int
    fell_back: bool
    """Whether the full solver had to take over."""


class Tracker:
    """Tracks the equilibrium of a body in real time, for cable tensions and nodal forces that change little from frame to frame.

    Each `step` expands the equilibrium in a power series about an earlier state, so that most frames need no new factorisation of the stiffness. Bodies with
    chambers, cable friction or a compliant clamp, and cables with an imposed shortening, are not supported: `solve_equilibrium` with `start` handles them.

    Example:
        >>> import femsense as fs
        >>> tracker = fs.Tracker(fs.load_robot("finger").body)
        >>> for tension in (0.1, 0.2, 0.3):  # N
        ...     frame = tracker.step(tension={"flexor": tension})
        >>> round(1e3 * frame.motion_m, 1), frame.error_m < 1e-5  # largest displacement since the previous frame [mm]; estimated error [m]
        (2.2, True)
    """

    def __init__(
        self,
        body: BodyModel,
        *,
        tolerance: float = 0.01,
        floor_m: float = 1e-7,
        single: bool | None = None,
        most_factorisations: int = MOST,
    ) -> None:
        """Start from the body at rest.

        Arguments:
            body: the body with its weight, a rigid clamp, and cables without friction.
            tolerance: largest error of a frame relative to its motion [1].
            floor_m: error below which the series ends in any case [m]; no smaller error is reported.
            single: whether to keep the factor in single precision. Default: for bodies with at least SINGLE_FROM unknowns.
            most_factorisations: maximum number of factorisations in a frame; then the full solver takes over.

        Raises:
            InputError: the body has chambers, cable friction or a compliant clamp.
        """
        if body.chambers or not body.clamp_is_rigid or any(c.friction > 0 for c in body.cables):
            raise InputError(
                "cannot be tracked",
                where="body",
                found="chambers, friction or a clamp that gives",
                expected="cables under tension",
                hint="solve_equilibrium with start=… knows them",
            )
        self.body = body
        self._tolerance, self._floor, self._most = tolerance, floor_m, most_factorisations
        self.expansion = Expansion(body, single=len(body.free_map.dofs) >= SINGLE_FROM if single is None else single)
        self._past: list[FloatArray] = []
        self._tension = np.zeros(len(body.cables))
        self._sound = max(SOUND * body.reach, floor_m)
        self._smooth = False
        self._trust = 1.0
        self._loads = np.zeros_like(body.mesh.nodes)
        self._terms: list[FloatArray] = []  # of the last series
        self._growth = 0.0  # largest recent ratio of the third term to second and first [1/m]
        self._grown = False  # whether one is known from the start at hand
        self._learns = False  # whether the next sound state is to be learnt
        self._columns: dict[bytes, sp.csc_matrix] = {}
        self._known = Known(self.expansion.length)

    def step(self, *, tension: Mapping[str, float] | None = None, nodal_forces: npt.ArrayLike | None = None) -> Tracked:
        """Return the state under new tensions [N] (cables that are not named are slack) and nodal forces [N], shape (n, 3).

        Raises:
            InputError: an unknown cable or a wrong shape.
            FemsenseError: no equilibrium was found.
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
        self._past, self._tension, self._loads = [*self._past[-2:], tracked.positions], T, self.body.dead_load() + extra
        return tracked

    def compliance(self, *, points: npt.ArrayLike = (), directions: npt.ArrayLike = ()) -> FloatArray:
        """Return the compliance matrix [m/N] of the current state, as `femsense.compliance` defines it, extrapolated from states where it is exact.

        The first call with other points takes longer: the compliance is then also computed at a slightly larger tension of each cable.
        """
        if not self._past:
            raise FemsenseError("nothing is tracked yet: call step first")
        P, D = as_points(points, "points"), as_points(directions, "directions")
        if P.shape != D.shape:
            raise InputError("points and directions differ in shape", where="directions", found=D.shape, expected=P.shape)
        k, key = len(P), P.tobytes()
        if key not in self._columns:  # the same points frame after frame: their columns are made once
            three = direction_rows(
                embed_points(self.body.mesh, np.repeat(P, 3, axis=0)), np.tile(np.eye(3), (k, 1)), len(self.body.mesh.nodes)
            )
            self._columns = {key: sp.csc_matrix(three[:, self.body.free_map.dofs].T)}
            self._explore()
        self._know()
        whole = self._known.at(self.expansion.sample(self._past[-1]))
        rows = (D[:, :, None] * whole[: 3 * k].reshape(k, 3, -1)).sum(axis=1)
        rows = np.concatenate([rows, whole[3 * k :]])
        columns = (rows[:, : 3 * k].reshape(len(rows), k, 3) * D).sum(axis=2)
        return np.concatenate([columns, rows[:, 3 * k :]], axis=1)

    def _explore(self) -> None:
        """Learn the compliance at the state at hand and, for each cable, at one with a little more tension:
        inputs may jitter all ways."""
        start, here, T = self.expansion, self._past[-1], self._tension
        self._known = Known(start.length)
        if not start.move(here, T):
            raise FemsenseError("the state is unstable: reduce the load")
        others = []
        for more in np.eye(len(T)) if start.is_series else ():
            soft = _largest(next(start.terms(T + more, self._loads)))
            tension = T + EXPLORED * self.body.reach / max(soft, 1e-300) * more
            terms = list(start.terms(tension, self._loads))
            if _largest(terms[2]) < SHRINK * _largest(terms[1]) < SHRINK**2 * _largest(terms[0]):
                others.append((here + sum(terms), tension))
        for x, tension in others:
            if start.move(x, tension):
                x = x + sum(start.terms(tension, self._loads))
                start.learn(x)
                if start.move(x, tension):
                    self._know()
        self._grown = False
        if not start.move(here, T):
            raise FemsenseError("the state is unstable: reduce the load")

    def _know(self) -> None:
        """Add the compliance at the start at hand to what is known, unless it is."""
        start = self.expansion
        if self._known.newest is start.positions:
            return
        assert start.factor is not None
        pulls = sp.csc_matrix(pull_rows(self.body, start.positions)[:, self.body.free_map.dofs].T)
        W = start.factor.gram(sp.hstack([*self._columns.values(), pulls], format="csc"))
        self._known.add(start.positions, start.sample(start.positions), W, judge=len(self._known.states) > len(self._tension))

    def _follow(self, T: FloatArray, loads: FloatArray) -> Tracked | None:
        """Return the state, None where no series gets there."""
        if self.expansion.factor is None:
            return None
        last, carried, anew = self._past[-1], self._carried(), not self.expansion.is_series
        begins = [carried] if anew and self._smooth and carried is not None else []
        expected = np.inf
        for count in range(self._most + 1):
            if begins and not self._begin(begins[-1], T):
                return None
            x, first, error = self._summed(T, loads, last, 1 if anew and not begins else 3)
            if count > 0 and np.isfinite(expected):  # the first term is the error of the previous series
                self._trust = max(0.9 * self._trust, 1.0, 1.2 * self._trust * first / expected)
            motion = _largest(x - last)
            # an expansion point farther away would make the terms look too small
            trusted = first <= max(CLOSE * motion, self._floor) if begins else not anew
            if error <= self._allowed(motion) and trusted:
                self._smooth = carried is not None and _largest(x - carried) <= NEAR * motion
                if self._learns and error <= self._sound:
                    self.expansion.learn(x)
                    self._learns = False
                residual = _largest(np.linalg.norm(self.expansion.unbalanced, axis=1))
                ahead = not begins and not anew and self._look_ahead(T, motion)
                return Tracked(freeze(x), error, motion, residual, len(begins) + ahead, False)
            begins, expected = [*begins, x], error
        return None

    def _begin(self, x: FloatArray, tension: FloatArray) -> bool:
        self._learns, self._grown = True, False
        return self.expansion.move(x, tension)

    def _look_ahead(self, T: FloatArray, motion: float) -> bool:
        """Make a new expansion slightly ahead of the motion if the current series will soon not converge; return whether one was made."""
        start, terms = self.expansion, self._terms
        sizes, x = [_largest(term) for term in terms], start.positions
        if len(terms) < 2:
            return False
        share = motion / max(sizes[0], 1e-300)
        soon, s = 1.0 + LOOK * share, 1.0 + AHEAD * min(share, 1.0)
        doubt = self._known.doubt(start.sample(x + sum(terms)))
        fails = len(terms) == 3 and self._trust * soon**3 * sizes[2] > self._allowed(motion)
        if not fails and doubt <= DRIFT:
            return False
        ahead = x + sum(s ** (n + 1) * term for n, term in enumerate(terms))
        self._begin(np.asarray(ahead), start.tension + s * (T - start.tension))
        return True

    def _allowed(self, motion: float) -> float:
        return max(self._tolerance * motion, self._floor)

    def _summed(self, T: FloatArray, loads: FloatArray, last: FloatArray, most: int) -> tuple[FloatArray, float, float]:
        """Return the sum of a series of so many terms at most, its first term and its error [m],
        inf where the terms do not shrink."""
        x, sizes, error, self._terms = self.expansion.positions, list[float](), np.inf, list[FloatArray]()
        for term in islice(self.expansion.terms(T, loads), most):
            sizes.append(_largest(term))
            self._terms.append(term)
            if not np.isfinite(sizes[-1]) or (len(sizes) > 1 and sizes[-1] > SHRINK * sizes[-2]):
                return x, sizes[0], np.inf
            x, error = x + term, sizes[-1]
            if len(sizes) == 2 and self._grown:
                error *= min(1.0, GUESS * self._growth * sizes[0])
            if len(sizes) == 3:
                growth = sizes[2] / max(sizes[1] * sizes[0], 1e-300)
                self._growth, self._grown = max(growth, FADES * self._growth), True
            error = max(self._trust * error, self._floor)
            if error <= self._allowed(_largest(x - last)) and (not self._learns or error <= self._sound):
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
        self._past, self._columns, self._smooth, self._learns, self._grown = self._past[-1:], {}, False, False, False
        self.expansion.forget()
        self.expansion.learn(state.positions)
        if not self.expansion.move(state.positions, np.array(list(state.tension.values()))):
            raise FemsenseError("the state is unstable: reduce the load")
        return Tracked(state.positions, self._floor, motion, state.residual_n, state.iterations, True)


class Known:
    """The compliance at some states, its interpolation to others (`combination`), and the estimated error of that interpolation."""

    def __init__(self, length: float) -> None:
        """Know nothing; `length` [m] is that of `combination`."""
        self.states: list[FloatArray] = []  # samples of positions
        self.newest: FloatArray | None = None
        self._length, self._scale, self._stack = length, 1.0, np.zeros((LIBRARY, 0, 0))

    def add(self, x: FloatArray, state: FloatArray, W: FloatArray, *, judge: bool) -> None:
        """Keep the compliance W at positions x with a sample `state`; with `judge`,
        learn from it how far the others have missed."""
        if judge:
            weights, doubt = combination(state, self.states, self._length)
            missed = _norm(W - np.tensordot(weights, self._stack[: len(weights)], 1)) / max(_norm(W), 1e-300)
            self._scale = float(np.clip(0.8 * self._scale + 0.2 * missed / max(doubt, 1e-12), 1.0, 2.0))
        if not self.states:
            self._stack = np.zeros((LIBRARY, *W.shape))
        if len(self.states) == LIBRARY:
            self.states.pop(0)
            self._stack[:-1] = self._stack[1:]
        self._stack[len(self.states)] = W
        self.states.append(state)
        self.newest = x

    def at(self, state: FloatArray) -> FloatArray:
        """Return W at a state."""
        weights, _ = combination(state, self.states, self._length)
        return np.asarray(np.tensordot(weights, self._stack[: len(weights)], 1))

    def doubt(self, state: FloatArray) -> float:
        """Return the estimated relative error of W at a state; 0 if no compliance was requested before."""
        return self._scale * combination(state, self.states, self._length)[1] if self.states else 0.0


def _largest(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


def _norm(values: FloatArray) -> float:
    return float(np.linalg.norm(values))
