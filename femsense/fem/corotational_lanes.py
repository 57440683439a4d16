# mypy: allow-untyped-decorators
"""Forces of corotational elements, LANES of them at a time: where no stiffness is wanted.

The laws are those of `femsense.fem.corotational`.
"""

from __future__ import annotations

import numpy as np

from femsense.core.kernels import njit
from femsense.fem.corotational import LOCAL
from femsense.fem.linalg.simd_lanes import LANES, add_divergence, add_gradient
from femsense.fem.rotation import FAST, closest_rotation

DEFORMATION, VOLUME, TRACE, SHEAR, PULL, ROOM = (row * LANES for row in (9, 18, 19, 20, 21, 22))
"""Places of the rows of LANES numbers in a quadrature point's array, behind the nine rows of its rotation. With one array a compiler sees
that rows do not overlap."""
ROWS = 23


@njit(cache=True, inline="always")
def gathered(x, nodes, X):  # type: ignore[no-untyped-def]
    """Copy the positions (n, 3) of the nodes of LANES elements, (a, LANES), to rows of LANES numbers, three a node."""
    for a in range(len(nodes)):
        for q in range(LANES):
            n, to = nodes[a, q], 3 * a * LANES + q
            X[to], X[to + LANES], X[to + 2 * LANES] = x[n, 0], x[n, 1], x[n, 2]


@njit(cache=True, inline="always")
def scattered(X, nodes, forces):  # type: ignore[no-untyped-def]
    """Add such rows to the forces (n, 3) of the nodes."""
    for a in range(len(nodes)):
        for q in range(LANES):
            n, to = nodes[a, q], 3 * a * LANES + q
            forces[n, 0] += X[to]
            forces[n, 1] += X[to + LANES]
            forces[n, 2] += X[to + 2 * LANES]


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _begin_rotations(v):  # type: ignore[no-untyped-def]
    """Write the deformations of a point, shape (ROWS LANES,), to where rotations go,
    and to ROOM by how much they are from being too flat for that."""
    for q in range(LANES):
        a, b, c = v[DEFORMATION + q], v[DEFORMATION + LANES + q], v[DEFORMATION + 2 * LANES + q]
        d, e, f = v[DEFORMATION + 3 * LANES + q], v[DEFORMATION + 4 * LANES + q], v[DEFORMATION + 5 * LANES + q]
        g, h, i = v[DEFORMATION + 6 * LANES + q], v[DEFORMATION + 7 * LANES + q], v[DEFORMATION + 8 * LANES + q]
        v[q], v[LANES + q], v[2 * LANES + q] = a, b, c
        v[3 * LANES + q], v[4 * LANES + q], v[5 * LANES + q] = d, e, f
        v[6 * LANES + q], v[7 * LANES + q], v[8 * LANES + q] = g, h, i
        third = (a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i) / 3.0
        v[ROOM + q] = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) - 0.02 * third * np.sqrt(third)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _turn_on(v):  # type: ignore[no-untyped-def]
    """Take a Newton step of `closest_rotation` at a point; write the squares of the steps to ROOM."""
    for q in range(LANES):
        a, b, c = v[q], v[LANES + q], v[2 * LANES + q]
        d, e, f = v[3 * LANES + q], v[4 * LANES + q], v[5 * LANES + q]
        g, h, i = v[6 * LANES + q], v[7 * LANES + q], v[8 * LANES + q]
        s, t, u = e * i - f * h, f * g - d * i, d * h - e * g
        w = 0.5 / (a * s + b * t + c * u)
        A, B, C = w * s - 0.5 * a, w * t - 0.5 * b, w * u - 0.5 * c
        D, E, H = w * (c * h - b * i) - 0.5 * d, w * (a * i - c * g) - 0.5 * e, w * (b * g - a * h) - 0.5 * f
        J, K, L = w * (b * f - c * e) - 0.5 * g, w * (c * d - a * f) - 0.5 * h, w * (a * e - b * d) - 0.5 * i
        v[ROOM + q] = A * A + B * B + C * C + D * D + E * E + H * H + J * J + K * K + L * L
        v[q], v[LANES + q], v[2 * LANES + q] = a + A, b + B, c + C
        v[3 * LANES + q], v[4 * LANES + q], v[5 * LANES + q] = d + D, e + E, f + H
        v[6 * LANES + q], v[7 * LANES + q], v[8 * LANES + q] = g + J, h + K, i + L


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _rotations(v):  # type: ignore[no-untyped-def]
    """Write the closest rotations at the points of LANES elements, shape (q, ROWS LANES), see `closest_rotation`."""
    points, least = len(v), np.inf
    for p in range(points):
        _begin_rotations(v[p])
        for q in range(ROOM, ROOM + LANES):
            least = min(least, v[p, q])
    for _ in range(30 if least > 0.0 else 0):
        largest = 0.0
        for p in range(points):
            _turn_on(v[p])
            for q in range(ROOM, ROOM + LANES):
                largest = max(largest, v[p, q])
        if largest < 1e-17:
            return
    for p in range(points):
        matrices = v[p].reshape(ROWS, LANES)
        for q in range(LANES):
            closest_rotation(matrices[9:18], matrices[:9], q)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _dilate(v):  # type: ignore[no-untyped-def]
    """Write TRACE, tr(RᵀF) − 3, of a point."""
    for q in range(LANES):
        trace = -3.0
        for k in range(9):
            trace += v[k * LANES + q] * v[DEFORMATION + k * LANES + q]
        v[TRACE + q] = trace


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _stress(v):  # type: ignore[no-untyped-def]
    """Write SHEAR (F − R) + PULL R over the deformations of a point, and |F − R|² to ROOM."""
    for q in range(LANES):
        norm, shear, pull = 0.0, v[SHEAR + q], v[PULL + q]
        for k in range(9):
            r = v[k * LANES + q]
            u = v[DEFORMATION + k * LANES + q] - r
            norm += u * u
            v[DEFORMATION + k * LANES + q] = shear * u + pull * r
        v[ROOM + q] = norm


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def corotational_forces(x, nodes, gradients, volumes, mu, lam, limit, forces):  # type: ignore[no-untyped-def]
    """Add internal forces [N] to those of the body, LANES elements at a time; return the energy [J].

    Arrays are those of `Lanes` and `Stencil`; `limit` is not used.
    """
    points, count, wide = volumes.shape[1], nodes.shape[1], 3 * nodes.shape[1] * LANES
    v, X = np.empty((points, ROWS * LANES)), np.empty(wide)
    local, rest, theta, whole = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    first, energy = gradients.ctypes.data, 0.0
    for e in range(len(nodes)):
        gathered(x, nodes[e], X)
        v[:, DEFORMATION : DEFORMATION + 9 * LANES] = 0.0
        for p in range(points):
            at = v[p].ctypes.data + 8 * DEFORMATION
            add_gradient(gradients, at, X.ctypes.data, first + 8 * (e * points + p) * wide, count)
        _rotations(v)
        theta[:], whole[:], X[:] = 0.0, 0.0, 0.0
        for p in range(points):
            _dilate(v[p])
            for q in range(LANES):
                element = LANES * e + q
                w = volumes[element, p] if element < len(volumes) else 1e-300
                v[p, VOLUME + q] = w
                theta[q] += w * v[p, TRACE + q]
                whole[q] += w
        for q in range(LANES):
            element = LANES * e + q if LANES * e + q < len(volumes) else 0
            local[q] = min(lam[element], LOCAL * mu[element])
            rest[q], theta[q] = lam[element] - local[q], theta[q] / whole[q]
            energy += 0.5 * rest[q] * whole[q] * theta[q] * theta[q]
            for p in range(points):
                w = v[p, VOLUME + q]
                v[p, SHEAR + q], v[p, PULL + q] = 2.0 * w * mu[element], w * (local[q] * v[p, TRACE + q] + rest[q] * theta[q])
        for p in range(points):
            _stress(v[p])
            for q in range(LANES):
                energy += 0.5 * (v[p, SHEAR + q] * v[p, ROOM + q] + v[p, VOLUME + q] * local[q] * v[p, TRACE + q] ** 2)
            at = v[p].ctypes.data + 8 * DEFORMATION
            add_divergence(gradients, X.ctypes.data, at, first + 8 * (e * points + p) * wide, count)
        scattered(X, nodes[e], forces)
    return energy
