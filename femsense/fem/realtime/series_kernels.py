# mypy: allow-untyped-decorators
"""Terms of the series of forces of elements, LANES at a time, and of cables; compiled.

See `femsense.fem.realtime.power_series`.
"""

from __future__ import annotations

import numpy as np

from femsense.core.kernels import njit
from femsense.fem.linalg.simd_lanes import LANES, add_divergence, add_gradient
from femsense.fem.rotation import FAST, closest_rotation

ROWS = 54
"""Rows of LANES numbers for a quadrature point. All rows stand in one array at fixed places: a compiler then sees that they do not overlap,
and works on LANES elements at once."""
FIRST, SECOND = 0, 9 * LANES
"""Places in a point's array of F₁ (then F̂₁ + F̂₂, then a stress) and of F₂, nine rows each."""
TURNS, THETA, MEANS = 18 * LANES, 27 * LANES, 31 * LANES
"""Places in a point's array of a₁, a₂ and a₃ (three rows each), of θ₀ … θ₃ (a row each), and of their means over the element."""
ROTATION, STRETCH = 35 * LANES, 44 * LANES
"""Places in a point's array of R₀ (nine rows) and of S₀ (00 01 02 11 12 22)."""
VOLUME, LOCAL_BULK, MEAN_BULK, SHEAR = 50 * LANES, 51 * LANES, 52 * LANES, 53 * LANES
"""Places in a point's array of volume, λ', λ − λ' and 2μ, a row each."""


@njit(cache=True, fastmath=FAST, error_model="numpy")
def element_frames(x, nodes, gradients, frames):  # type: ignore[no-untyped-def]
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
    """Add Σ_{n=1}^{N+1} of the coefficients of the internal forces [N] for x₁ … x_N (terms, shape (N, n, 3),
    N = 1 or 2) and x_{N+1} = 0."""
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
