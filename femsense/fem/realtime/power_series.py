# mypy: allow-untyped-decorators
"""Equilibria along a path of loads as a power series: the nonlinear answer of a body, from one factor.

Where the loads move on a straight line, from those that hold x₀ (s = 0) to others (s = 1), the state is x(s) = x₀ + s x₁ + s² x₂ + …,
and each term follows from the ones before by one solve with the tangent K of x₀ (asymptotic numerical method; Cochelin, Damil &
Potier-Ferry 1994):

    K x_{N+1} = g_N,    g_N = Σ_{n ≤ N+1} of the coefficients of the unbalanced force, with x_{N+1} = 0.

The sum over all orders hands what a solve in single precision has missed on to the next term. A correction with a kept factor takes the
force of x₀ + x₁ as a whole instead: a slender body that turns by ω is stretched by |ω|²/2 there, and the force of that, which the second
term takes back, has a part across the body that the factor reads as a large motion. Term by term this cancels.

Coefficients of the corotational element: F = R₀ F̂ and R = R₀ A with A = I + s A₁ + …, A_n = [a_n]ₓ + M_n. AᵀA = I gives

    M₂ = (a₁a₁ᵀ − |a₁|² I)/2,    M₃ = (a₁a₂ᵀ + a₂a₁ᵀ)/2 − a₁·a₂ I    (M₁ = 0),

and that S = AᵀF̂ be symmetric, with S₀ = R₀ᵀF₀ and B = F̂_n + M_n S₀ + Σ_{0<k<n} A_kᵀ F̂_{n−k}:

    (tr(S₀) I − S₀) a_n = axial(B − Bᵀ),    θ_n = tr B,    P_n = R₀ (2μ (F̂_n − A_n) + Σ_k p_k A_{n−k}),

p as in `corotational`. Elements are worked on eight at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numba import njit

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.cables import add_cable_stiffness, pull_rows
from femsense.fem.corotational import LOCAL
from femsense.fem.linalg.cholesky import Cholesky, cholesky
from femsense.fem.linalg.simd_kernels import LANES, add_divergence, add_gradient
from femsense.fem.rotation import FAST, closest_rotation
from femsense.fem.stencil import in_lanes, lanes_of

ROWS = 54
"""Rows of LANES numbers that a point takes. One array with fixed places for all of them lets a compiler see that they are apart, so that it
takes the eight elements at once."""
FIRST, SECOND = 0, 9 * LANES
"""Where F₁ (then F̂₁ + F̂₂, then a stress) and F₂ begin among them, nine rows each;"""
TURNS, THETA, MEANS = 18 * LANES, 27 * LANES, 31 * LANES
"""a₁, a₂ and a₃, three rows each; θ₀ … θ₃, a row each; and their means over the element;"""
ROTATION, STRETCH = 35 * LANES, 44 * LANES
"""R₀, nine rows, and S₀ (00 01 02 11 12 22);"""
VOLUME, LOCAL_BULK, MEAN_BULK, SHEAR = 50 * LANES, 51 * LANES, 52 * LANES, 53 * LANES
"""volume, λ', λ − λ' and 2μ, a row each."""
MEMORY = 8
"""Equilibria whose stretches are kept."""
SAMPLE = 300
"""Nodes whose positions tell how far states are apart."""
ALIKE = 0.06
"""What is known at a state holds for others as far as this share of the body away (root of the mean square): ℓ in `combination`."""
NOISE = 1e-5
"""Variance of what is known at a state, as a share of that of states that lie far apart."""
TERMS = 3
"""Terms of a series at most."""


@dataclass(frozen=True, eq=False, slots=True)
class SeriesLanes:
    """What a series needs of the elements in groups of LANES, the element being the last axis; elements of no volume fill the last group up."""

    nodes: IntArray
    """shape (g, a, LANES)."""
    gradients: FloatArray
    """Single precision, shape (g, q, 3 a, LANES)."""
    constants: FloatArray
    """Volumes of the points, λ', λ − λ' and 2μ, shape (g, q + 3, LANES)."""
    frames: FloatArray
    """R₀ (nine rows) and S₀ (00 01 02 11 12 22) at the start of the series, shape (g, q, 15 LANES)."""


class Expansion:
    """A state of a body from which others follow as series: cables under given tensions, a rigid clamp.

    Laws without a series of their own have two terms, the second being the correction with the factor of x₀.
    """

    def __init__(self, body: BodyModel, *, single: bool) -> None:
        """Prepare for a body; `single` keeps the factor in single precision."""
        self.body, self._single = body, single
        self.is_series = body.material.law == "corotational"
        self._lanes = _lanes(body) if self.is_series else None
        self._blocks = np.zeros((len(body.stencil.block_columns), 9), np.float32 if single else np.float64)
        self._source = np.asarray(body.free_map.source[body.free_map.pattern.analysis().source], dtype=np.int32)
        self.positions = body.mesh.nodes
        self.factor: Cholesky | None = None
        self.unbalanced = np.zeros_like(self.positions)
        """What the last term answered to [N], shape (n, 3)."""
        self.tension, self._held = np.zeros(len(body.cables)), np.zeros_like(self.positions)
        keeps = body.mesh.is_quadratic and self._lanes is not None
        self._room = np.zeros((len(body.mesh.tets), 4, 9)) if keeps else None
        self._stretches: list[tuple[FloatArray, FloatArray]] = []  # of the last equilibria that were learnt
        self.length = ALIKE * body.reach
        self._loads: FloatArray | None = None  # dead loads of the last series
        self._answers: FloatArray | None = None  # to what is unbalanced at the start and to each cable, shape (a + 1, f)

    def learn(self, x: FloatArray) -> None:
        """Keep the stretches of an equilibrium x: their stress serves the stiffness of starts to come."""
        if self._room is not None:
            stretch = self._stretches.pop(0)[1] if len(self._stretches) == MEMORY else np.empty_like(self._room)
            internal(self.body, x, tangent=False, stretch=stretch)
            self._stretches.append((self.sample(x), stretch))

    def sample(self, x: FloatArray) -> FloatArray:
        """Return the positions [m] of some nodes, shape (k, 3): what `combination` compares states by."""
        return np.asarray(x[:: max(1, len(x) // SAMPLE)]).copy()

    def forget(self) -> None:
        """Forget what was learnt, after a leap."""
        self._stretches = []

    def move(self, x: FloatArray, tension: FloatArray) -> bool:
        """Start from node positions x [m] and tensions [N], shape (a,); return whether the stiffness is positive definite there."""
        body, blocks = self.body, self._blocks
        stretch = None
        if self._room is not None and self._stretches:
            weights, _ = combination(self.sample(x), [state for state, _ in self._stretches], self.length)
            stretch = np.einsum("k,keqi->eqi", weights, np.array([s for _, s in self._stretches]), out=self._room)
        here = internal(body, x, room=blocks, stretch=stretch)
        add_cable_stiffness(body, x, tuple(np.full(len(c.path), t) for c, t in zip(body.cables, tension)), blocks)
        self.factor = None  # its memory serves the next one
        self.factor = cholesky(body.free_map.pattern.analysis(), blocks.ravel(), single=self._single, source=self._source)
        self.positions, self.tension, self._answers = x, tension.copy(), None
        self._held = -here.forces
        if len(tension):
            self._held += (tension @ pull_rows(body, x)).reshape(-1, 3)
        if self._lanes is not None:
            _frames(_read_only(x), self._lanes.nodes, self._lanes.gradients, self._lanes.frames)
        return self.factor is not None

    def terms(self, tension: FloatArray, loads: FloatArray) -> Iterator[FloatArray]:
        """Yield x₁, x₂ and x₃ [m], shape (n, 3), for tensions [N] and dead loads [N], shape (n, 3)."""
        assert self.factor is not None
        count, free = TERMS if self._lanes is not None else 2, self.body.free_map.dofs
        terms = np.zeros((count, *self.positions.shape))
        for n in range(count):
            self.unbalanced.reshape(-1)[free] = self._forces(terms[:n], tension, loads).ravel()[free]
            known = self._first_term(tension, loads) if n == 0 else None
            terms[n].reshape(-1)[free] = self.factor.solve(self.unbalanced.ravel()[free]) if known is None else known
            yield terms[n]

    def _first_term(self, tension: FloatArray, loads: FloatArray) -> FloatArray | None:
        """Return x₁ of the free unknowns, shape (f,), where the dead loads stay: one block of solves a start, since it is linear in the tensions."""
        assert self.factor is not None
        free, before = self.body.free_map.dofs, self._loads
        self._loads = loads.copy()
        if before is None or not np.array_equal(loads, before):
            self._answers = None
            return None
        if self._answers is None:
            pulls = pull_rows(self.body, self.positions)[:, free]
            self._answers = self.factor.solve(np.vstack([(loads + self._held).ravel()[free], pulls]).T).T
        return np.asarray(self._answers[0] + (tension - self.tension) @ self._answers[1:])

    def _forces(self, terms: FloatArray, tension: FloatArray, loads: FloatArray) -> FloatArray:
        """Return g_N [N], shape (n, 3)."""
        x, lanes, force = _read_only(self.positions), self._lanes, np.zeros_like(self.positions)
        if lanes is None and len(terms):
            there = self.positions + terms[0]
            pull = (tension @ pull_rows(self.body, there)).reshape(-1, 3) if len(tension) else 0.0
            return np.asarray(loads + pull - internal(self.body, there, tangent=False).forces)
        if lanes is not None and len(terms):
            series_forces(terms, lanes.nodes, lanes.gradients, lanes.constants, lanes.frames, force)
        force = loads + self._held - force
        for cable, before, after in zip(self.body.cables, self.tension, tension):
            cable_series(cable.path.nodes, cable.path.weights, cable.pull_point, x, terms, before, after - before, force)
        return force


def combination(x: FloatArray, states: list[FloatArray], length: float) -> tuple[FloatArray, float]:
    """Return weights of sum 1, shape (k,), by which what is known at some states carries over to the state x, and how uncertain that is.

    Ordinary kriging (Cressie 1993, 3.2) with the covariance exp(−d²/2ℓ²) of states at a distance d (root of the mean square [m]) and a
    variance of NOISE of what is known; the uncertainty is the standard deviation, as a share of what states far from each other differ by.
    """
    k, ways = len(states), (np.array([*states, x]) - x).reshape(len(states) + 1, -1)
    products = ways @ ways.T / ways.shape[1]
    squares = np.diag(products)
    covariance = np.exp(-(0.5 * (squares[:, None] + squares) - products) / length**2)
    matrix = np.ones((k + 1, k + 1))
    matrix[:k, :k] = covariance[:k, :k] + NOISE * np.eye(k)
    matrix[k, k] = 0.0
    right = np.append(covariance[:k, k], 1.0)
    solution = np.linalg.solve(matrix, right)
    return solution[:k], float(np.sqrt(max(1.0 - solution @ right, 0.0)))


def _read_only(x: FloatArray) -> FloatArray:
    view = np.ascontiguousarray(x).view()
    view.flags.writeable = False  # one compiled kernel, whether the caller's array can be written to or not
    return view


def _lanes(body: BodyModel) -> SeriesLanes:
    stencil, (mu, lam) = body.stencil, body.material.lame()
    count, points = stencil.volumes.shape
    lanes, local = lanes_of(stencil), np.minimum(lam, LOCAL * mu)
    constants = in_lanes(np.column_stack([stencil.volumes, local, lam - local, 2.0 * mu]))
    groups = len(constants)
    constants[-1, :points, LANES - (groups * LANES - count) :] = 1e-300
    gradients: FloatArray = np.asarray(lanes.gradients, dtype=np.float32)
    return SeriesLanes(lanes.nodes, gradients, constants, np.zeros((groups, points, 15 * LANES)))


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _frames(x, nodes, gradients, frames):  # type: ignore[no-untyped-def]
    """Write rotations and stretches of all points."""
    groups, points, count = gradients.shape[0], gradients.shape[1], gradients.shape[2] // 3
    F, R, X = np.empty((9, LANES)), np.empty((9, LANES)), np.zeros((count, 3, LANES))
    for e in range(groups):
        for a in range(count):
            for q in range(LANES):
                for i in range(3):
                    X[a, i, q] = x[nodes[e, a, q], i]
        for p in range(points):
            F[:] = 0.0
            add_gradient(
                gradients, F.ctypes.data, X.ctypes.data, gradients.ctypes.data + 12 * (e * points + p) * count * LANES, count
            )
            out = frames[e, p]
            for q in range(LANES):
                closest_rotation(F, R, q)
                row = 9
                for i in range(3):
                    for j in range(3):
                        out[(3 * i + j) * LANES + q] = R[3 * i + j, q]
                    for j in range(i, 3):
                        out[row * LANES + q] = R[i, q] * F[j, q] + R[3 + i, q] * F[3 + j, q] + R[6 + i, q] * F[6 + j, q]
                        row += 1


@njit(inline="always")
def _three(w, at):  # type: ignore[no-untyped-def]
    """Return one number of each of three rows."""
    return w[at], w[at + LANES], w[at + 2 * LANES]


@njit(inline="always")
def _put_three(w, at, x, y, z):  # type: ignore[no-untyped-def]
    """Write one number of each of three rows."""
    w[at], w[at + LANES], w[at + 2 * LANES] = x, y, z


@njit(inline="always")
def _nine(w, at):  # type: ignore[no-untyped-def]
    """Return one number of each of nine rows."""
    return (
        w[at],
        w[at + LANES],
        w[at + 2 * LANES],
        w[at + 3 * LANES],
        w[at + 4 * LANES],
        w[at + 5 * LANES],
        w[at + 6 * LANES],
        w[at + 7 * LANES],
        w[at + 8 * LANES],
    )


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _turn(w):  # type: ignore[no-untyped-def]
    """Find how the points of LANES elements turn: F₁, F₂ → F̂₁ + F̂₂, a₁, a₂, a₃ and θ₀ … θ₃, in the rows that `ROWS` names."""
    for q in range(LANES):
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = _nine(w, ROTATION + q)
        f0, f1, f2, f3, f4, f5, f6, f7, f8 = _nine(w, FIRST + q)
        u0, u1, u2 = r0 * f0 + r3 * f3 + r6 * f6, r0 * f1 + r3 * f4 + r6 * f7, r0 * f2 + r3 * f5 + r6 * f8
        u3, u4, u5 = r1 * f0 + r4 * f3 + r7 * f6, r1 * f1 + r4 * f4 + r7 * f7, r1 * f2 + r4 * f5 + r7 * f8
        u6, u7, u8 = r2 * f0 + r5 * f3 + r8 * f6, r2 * f1 + r5 * f4 + r8 * f7, r2 * f2 + r5 * f5 + r8 * f8
        f0, f1, f2, f3, f4, f5, f6, f7, f8 = _nine(w, SECOND + q)
        v0, v1, v2 = r0 * f0 + r3 * f3 + r6 * f6, r0 * f1 + r3 * f4 + r6 * f7, r0 * f2 + r3 * f5 + r6 * f8
        v3, v4, v5 = r1 * f0 + r4 * f3 + r7 * f6, r1 * f1 + r4 * f4 + r7 * f7, r1 * f2 + r4 * f5 + r7 * f8
        v6, v7, v8 = r2 * f0 + r5 * f3 + r8 * f6, r2 * f1 + r5 * f4 + r8 * f7, r2 * f2 + r5 * f5 + r8 * f8
        (s0, s1, s2), (s4, s5, s8) = _three(w, STRETCH + q), _three(w, STRETCH + 3 * LANES + q)
        trace = s0 + s4 + s8
        d00, d11, d22 = s4 + s8, s0 + s8, s0 + s4
        i0, i1, i2 = d11 * d22 - s5 * s5, s2 * s5 + s1 * d22, s1 * s5 + s2 * d11
        det = 1.0 / (d00 * i0 - s1 * i1 - s2 * i2)
        i0, i1, i2 = i0 * det, i1 * det, i2 * det
        i3, i4, i5 = (d00 * d22 - s2 * s2) * det, (s1 * s2 + d00 * s5) * det, (d00 * d11 - s1 * s1) * det
        x, y, z = u7 - u5, u2 - u6, u3 - u1  # first order
        a, b, c = i0 * x + i1 * y + i2 * z, i1 * x + i3 * y + i4 * z, i2 * x + i4 * y + i5 * z
        t1 = u0 + u4 + u8
        sa, sb, sc = s0 * a + s1 * b + s2 * c, s1 * a + s4 * b + s5 * c, s2 * a + s5 * b + s8 * c
        # second: B = F̂₂ + M₂ S₀ − [a₁] F̂₁, M₂ = (a₁a₁ᵀ − |a₁|² I) / 2
        x2, y2, z2 = v7 - v5 - 0.5 * (b * sc - c * sb), v2 - v6 - 0.5 * (c * sa - a * sc), v3 - v1 - 0.5 * (a * sb - b * sa)
        x2 -= t1 * a - (u0 * a + u1 * b + u2 * c)
        y2 -= t1 * b - (u3 * a + u4 * b + u5 * c)
        z2 -= t1 * c - (u6 * a + u7 * b + u8 * c)
        d, e, o = i0 * x2 + i1 * y2 + i2 * z2, i1 * x2 + i3 * y2 + i4 * z2, i2 * x2 + i4 * y2 + i5 * z2
        t2 = v0 + v4 + v8
        square = a * a + b * b + c * c
        w[THETA + q] = trace - 3.0
        w[THETA + LANES + q] = t1
        w[THETA + 2 * LANES + q] = t2 + 0.5 * (a * sa + b * sb + c * sc - square * trace) + a * x + b * y + c * z
        # third: B = M₃ S₀ − [a₁] F̂₂ − [a₂] F̂₁ + M₂ F̂₁, M₃ = (a₁a₂ᵀ + a₂a₁ᵀ) / 2 − (a₁·a₂) I
        sd, se, sf = s0 * d + s1 * e + s2 * o, s1 * d + s4 * e + s5 * o, s2 * d + s5 * e + s8 * o
        ua, ub, uc = u0 * a + u3 * b + u6 * c, u1 * a + u4 * b + u7 * c, u2 * a + u5 * b + u8 * c  # F̂₁ᵀ a₁
        x3 = (
            -0.5 * (b * sf - c * se + e * sc - o * sb)
            - (t2 * a - (v0 * a + v1 * b + v2 * c))
            - (t1 * d - (u0 * d + u1 * e + u2 * o))
        )
        y3 = (
            -0.5 * (c * sd - a * sf + o * sa - d * sc)
            - (t2 * b - (v3 * a + v4 * b + v5 * c))
            - (t1 * e - (u3 * d + u4 * e + u5 * o))
        )
        z3 = (
            -0.5 * (a * se - b * sd + d * sb - e * sa)
            - (t2 * c - (v6 * a + v7 * b + v8 * c))
            - (t1 * o - (u6 * d + u7 * e + u8 * o))
        )
        x3 -= 0.5 * (b * uc - c * ub + square * x)
        y3 -= 0.5 * (c * ua - a * uc + square * y)
        z3 -= 0.5 * (a * ub - b * ua + square * z)
        _put_three(w, TURNS + q, a, b, c)
        _put_three(w, TURNS + 3 * LANES + q, d, e, o)
        _put_three(
            w, TURNS + 6 * LANES + q, i0 * x3 + i1 * y3 + i2 * z3, i1 * x3 + i3 * y3 + i4 * z3, i2 * x3 + i4 * y3 + i5 * z3
        )
        dot = a * d + b * e + c * o
        w[THETA + 3 * LANES + q] = (
            (a * sd + b * se + c * sf) - dot * trace + a * (v7 - v5) + b * (v2 - v6) + c * (v3 - v1) + d * x + e * y + o * z
        )
        w[THETA + 3 * LANES + q] += 0.5 * (a * ua + b * ub + c * uc - square * t1)
        _put_three(w, FIRST + q, u0 + v0, u1 + v1, u2 + v2)
        _put_three(w, FIRST + 3 * LANES + q, u3 + v3, u4 + v4, u5 + v5)
        _put_three(w, FIRST + 6 * LANES + q, u6 + v6, u7 + v7, u8 + v8)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _stress(w, last):  # type: ignore[no-untyped-def]
    """Turn F̂₁ + F̂₂ into R₀ Σ P_n of the orders 1 … last (2 or 3) times the volume, in the same rows."""
    third = 1.0 if last == 3 else 0.0
    for q in range(LANES):
        a, b, c, d, e, o, x, y, z = _nine(w, TURNS + q)
        x, y, z = third * x, third * y, third * z
        bulk, rest, m = w[LOCAL_BULK + q], w[MEAN_BULK + q], w[SHEAR + q]
        p0, p1 = bulk * w[THETA + q] + rest * w[MEANS + q], bulk * w[THETA + LANES + q] + rest * w[MEANS + LANES + q]
        p2, p3 = (
            bulk * w[THETA + 2 * LANES + q] + rest * w[MEANS + 2 * LANES + q],
            third * (bulk * w[THETA + 3 * LANES + q] + rest * w[MEANS + 3 * LANES + q]),
        )
        one, two, three = p0 + p1 - m, p0 + third * p1 - m, third * (p0 - m)
        one += third * p2
        k, g, h = one * a + two * d + three * x, one * b + two * e + three * y, one * c + two * o + three * z
        # symmetric: two M₂ + three M₃
        half, dot = 0.5 * two, a * d + b * e + c * o
        spread = p1 + p2 + p3 - half * (a * a + b * b + c * c) - three * dot
        m00, m11, m22 = (
            half * a * a + three * a * d + spread,
            half * b * b + three * b * e + spread,
            half * c * c + three * c * o + spread,
        )
        m01 = half * a * b + 0.5 * three * (a * e + b * d)
        m02 = half * a * c + 0.5 * three * (a * o + c * d)
        m12 = half * b * c + 0.5 * three * (b * o + c * e)
        v = w[VOLUME + q]
        f0, f1, f2, f3, f4, f5, f6, f7, f8 = _nine(w, FIRST + q)
        P0, P1, P2 = v * (m * f0 + m00), v * (m * f1 + m01 - h), v * (m * f2 + m02 + g)
        P3, P4, P5 = v * (m * f3 + m01 + h), v * (m * f4 + m11), v * (m * f5 + m12 - k)
        P6, P7, P8 = v * (m * f6 + m02 - g), v * (m * f7 + m12 + k), v * (m * f8 + m22)
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = _nine(w, ROTATION + q)
        _put_three(w, FIRST + q, r0 * P0 + r1 * P3 + r2 * P6, r0 * P1 + r1 * P4 + r2 * P7, r0 * P2 + r1 * P5 + r2 * P8)
        _put_three(
            w, FIRST + 3 * LANES + q, r3 * P0 + r4 * P3 + r5 * P6, r3 * P1 + r4 * P4 + r5 * P7, r3 * P2 + r4 * P5 + r5 * P8
        )
        _put_three(
            w, FIRST + 6 * LANES + q, r6 * P0 + r7 * P3 + r8 * P6, r6 * P1 + r7 * P4 + r8 * P7, r6 * P2 + r7 * P5 + r8 * P8
        )


@njit(cache=True, fastmath=FAST, error_model="numpy")
def series_forces(terms, nodes, gradients, constants, frames, forces):  # type: ignore[no-untyped-def]
    """Add Σ_{n=1}^{N+1} of the coefficients of the internal forces [N] for x₁ … x_N (terms, shape (N, n, 3), N = 1 or 2) and x_{N+1} = 0."""
    N, groups, points, count = len(terms), gradients.shape[0], gradients.shape[1], gradients.shape[2] // 3
    X, wide, own = points * ROWS * LANES, 3 * count * LANES, (points + 3) * LANES
    v, w, f, g = np.zeros(ROWS * LANES), np.zeros(X + 2 * wide), frames.reshape(-1), constants.reshape(-1)
    room, base, first = v.ctypes.data, w.ctypes.data, gradients.ctypes.data
    for e in range(groups):
        for t in range(N):
            for a in range(count):
                to = X + t * wide + 3 * a * LANES
                for q in range(LANES):
                    n = nodes[e, a, q]
                    w[to + q], w[to + LANES + q], w[to + 2 * LANES + q] = terms[t, n, 0], terms[t, n, 1], terms[t, n, 2]
        for p in range(points):
            for k in range(18 * LANES):
                v[k] = 0.0
            for t in range(N):
                add_gradient(
                    gradients, room + 8 * t * SECOND, base + 8 * (X + t * wide), first + 4 * (e * points + p) * wide, count
                )
            for k in range(15 * LANES):
                v[ROTATION + k] = f[(e * points + p) * 15 * LANES + k]
            for q in range(LANES):
                v[VOLUME + q] = g[e * own + p * LANES + q]
            for k in range(3 * LANES):
                v[LOCAL_BULK + k] = g[e * own + points * LANES + k]
            _turn(v)
            for k in range(ROWS * LANES):
                w[p * ROWS * LANES + k] = v[k]
        _means(w, points)
        for k in range(X, X + wide):
            w[k] = 0.0
        for p in range(points):
            for k in range(ROWS * LANES):
                v[k] = w[p * ROWS * LANES + k]
            _stress(v, N + 1)
            add_divergence(gradients, base + 8 * X, room, first + 4 * (e * points + p) * wide, count)
        for a in range(count):
            to = X + 3 * a * LANES
            for q in range(LANES):
                n = nodes[e, a, q]
                forces[n, 0] += w[to + q]
                forces[n, 1] += w[to + LANES + q]
                forces[n, 2] += w[to + 2 * LANES + q]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _means(w, points):  # type: ignore[no-untyped-def]
    """Write the mean dilatations of LANES elements beside those of their points."""
    for k in range(4):
        for q in range(LANES):
            dilatation, volume = 0.0, 0.0
            for p in range(points):
                at = p * ROWS * LANES + q
                dilatation += w[at + VOLUME] * w[at + THETA + k * LANES]
                volume += w[at + VOLUME]
            for p in range(points):
                w[p * ROWS * LANES + MEANS + k * LANES + q] = dilatation / volume


@njit(cache=True)
def cable_series(nodes, weights, end, x, terms, tension, more, forces):  # type: ignore[no-untyped-def]
    """Add Σ_{n=1}^{N+1} of the coefficients of a cable's nodal forces, its tension being tension + s more."""
    N, count, width = len(terms), nodes.shape[0], nodes.shape[1]
    v, d, length = np.zeros((N + 2, count + 1, 3)), np.zeros((N + 2, count + 1, 3)), np.zeros(N + 2)
    v[0, count] = end
    for s in range(count):
        for a in range(width):
            for c in range(3):
                v[0, s, c] += weights[s, a] * x[nodes[s, a], c]
                for n in range(N):
                    v[n + 1, s, c] += weights[s, a] * terms[n, nodes[s, a], c]
    pull = np.zeros((count, 3))
    for s in range(count):
        for n in range(N + 2):
            square = 0.0
            for c in range(3):
                v[n, s, c] = v[n, s + 1, c] - v[n, s, c]
            for k in range(n + 1):
                for c in range(3):
                    square += v[k, s, c] * v[n - k, s, c]
            for k in range(1, n):
                square -= length[k] * length[n - k]
            length[n] = np.sqrt(square) if n == 0 else square / (2.0 * length[0])
            for c in range(3):
                known = v[n, s, c]
                for k in range(1, n + 1):
                    known -= length[k] * d[n - k, s, c]
                d[n, s, c] = known / length[0]
        for n in range(1, N + 2):
            for c in range(3):
                pull[s, c] += tension * d[n, s, c] + more * d[n - 1, s, c]
    for s in range(count):
        for c in range(3):
            at_point = pull[s, c] - (pull[s - 1, c] if s > 0 else 0.0)
            for a in range(width):
                forces[nodes[s, a], c] += weights[s, a] * at_point
