# mypy: allow-untyped-decorators
"""Rotations closest to 3 × 3 matrices, and how they turn along.

Plain loops over small arrays, which compile in a moment and need no linear-algebra library.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.kernels import njit

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Fast-math flags of LLVM that change rounding only: infinities and NaN are kept."""


@njit(cache=True)
def rotation_of(covariance: FloatArray, R: FloatArray) -> None:
    """Write the rotation R (3, 3) with the largest trace(R C), for C = Σ w p qᵀ: it turns p to q.

    Horn 1987: its quaternion is the eigenvector of the largest eigenvalue of a symmetric 4 × 4 matrix, found by Jacobi
    rotations. Always proper, also for flat and mirrored clouds.
    """
    C = covariance
    K, V = np.zeros((4, 4)), np.zeros((4, 4))
    for i in range(4):
        V[i, i] = 1.0
    K[0, 0] = C[0, 0] + C[1, 1] + C[2, 2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        K[0, i + 1] = K[i + 1, 0] = C[j, k] - C[k, j]
        K[i + 1, i + 1] = C[i, i] - C[j, j] - C[k, k]
        K[j + 1, k + 1] = K[k + 1, j + 1] = C[j, k] + C[k, j]
    diagonalise(K, V)
    best = 0
    for i in range(1, 4):
        if K[i, i] > K[best, best]:
            best = i
    w, x, y, z = V[0, best], V[1, best], V[2, best], V[3, best]
    n = w * w + x * x + y * y + z * z
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z) / n, 2.0 * (x * y - z * w) / n, 2.0 * (x * z + y * w) / n
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + z * w) / n, 1.0 - 2.0 * (x * x + z * z) / n, 2.0 * (y * z - x * w) / n
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - y * w) / n, 2.0 * (y * z + x * w) / n, 1.0 - 2.0 * (x * x + y * y) / n


@njit(cache=True)
def diagonalise(K: FloatArray, V: FloatArray) -> None:
    """Turn a symmetric 4 × 4 matrix into its eigenvalues on the diagonal, V (identity before) into its eigenvectors.

    Cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, 8.5).
    """
    for _ in range(20):
        off, size = 0.0, 0.0
        for i in range(4):
            size += K[i, i] * K[i, i]
            for j in range(i):
                off += K[i, j] * K[i, j]
        if off <= 1e-32 * size or off == 0.0:
            return
        for p in range(3):
            for q in range(p + 1, 4):
                if K[p, q] != 0.0:
                    jacobi_rotation(K, V, p, q)


@njit(cache=True)
def jacobi_rotation(K: FloatArray, V: FloatArray, p: int, q: int) -> None:
    """Turn K in the plane p, q so that K[p, q] vanishes, and V along."""
    ratio = (K[q, q] - K[p, p]) / (2.0 * K[p, q])
    t = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
    if ratio < 0.0:
        t = -t
    c = 1.0 / np.sqrt(1.0 + t * t)
    s = t * c
    for i in range(4):
        a, b = K[i, p], K[i, q]
        K[i, p], K[i, q] = c * a - s * b, s * a + c * b
    for i in range(4):
        a, b = K[p, i], K[q, i]
        K[p, i], K[q, i] = c * a - s * b, s * a + c * b
    for i in range(4):
        a, b = V[i, p], V[i, q]
        V[i, p], V[i, q] = c * a - s * b, s * a + c * b


@njit(cache=True)
def closest_rotation_anyhow(F: FloatArray, R: FloatArray, q: int) -> None:
    """Write the rotation that is closest to F_q, flat or inverted as it may be."""
    covariance, rotation = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            covariance[i, j] = F[3 * j + i, q]
    rotation_of(covariance, rotation)
    for i in range(3):
        for j in range(3):
            R[3 * i + j, q] = rotation[i, j]


@njit(cache=True, fastmath=FAST)
def determinant(F: FloatArray, q: int) -> float:
    """Return det F_q, the matrix of a point being a column of F, row by row, shape (9, quad)."""
    return float(
        F[0, q] * (F[4, q] * F[8, q] - F[5, q] * F[7, q])
        - F[1, q] * (F[3, q] * F[8, q] - F[5, q] * F[6, q])
        + F[2, q] * (F[3, q] * F[7, q] - F[4, q] * F[6, q])
    )


@njit(cache=True, fastmath=FAST)
def closest_rotation(F: FloatArray, R: FloatArray, q: int) -> None:
    """Write the rotation (det +1) that is closest to F_q (Newton of Higham 1986;
    Horn's quaternion where F_q is flat or inverted).

    Matrices are columns, row by row, shape (9, quad).
    """
    size = 0.0
    for k in range(9):
        size += F[k, q] * F[k, q]
    if not determinant(F, q) > 0.02 * (size / 3.0) ** 1.5:
        closest_rotation_anyhow(F, R, q)
        return
    a, b, c, d, e, f, g, h, i = F[0, q], F[1, q], F[2, q], F[3, q], F[4, q], F[5, q], F[6, q], F[7, q], F[8, q]
    for _ in range(30):
        u, v, w = e * i - f * h, f * g - d * i, d * h - e * g
        s = 0.5 / (a * u + b * v + c * w)
        A, B, C = 0.5 * a + s * u, 0.5 * b + s * v, 0.5 * c + s * w
        D, E, H = 0.5 * d + s * (c * h - b * i), 0.5 * e + s * (a * i - c * g), 0.5 * f + s * (b * g - a * h)
        J, K, L = 0.5 * g + s * (b * f - c * e), 0.5 * h + s * (c * d - a * f), 0.5 * i + s * (a * e - b * d)
        change = (A - a) ** 2 + (B - b) ** 2 + (C - c) ** 2 + (D - d) ** 2 + (E - e) ** 2
        change += (H - f) ** 2 + (J - g) ** 2 + (K - h) ** 2 + (L - i) ** 2
        a, b, c, d, e, f, g, h, i = A, B, C, D, E, H, J, K, L
        if change < 1e-17:  # quadratic: the next change is below 1e-16
            break
    else:
        closest_rotation_anyhow(F, R, q)
        return
    R[0, q], R[1, q], R[2, q], R[3, q], R[4, q], R[5, q], R[6, q], R[7, q], R[8, q] = a, b, c, d, e, f, g, h, i


@njit(cache=True, fastmath=FAST)
def turning_compliance(F: FloatArray, R: FloatArray, q: int, out: FloatArray) -> None:
    """Write the six entries 00 01 02 11 12 22 of D_q⁻¹; a singular D_q (a body shrunk to a point) gets a small shift."""
    a = F[3, q] * R[3, q] + F[4, q] * R[4, q] + F[5, q] * R[5, q]
    b = F[6, q] * R[6, q] + F[7, q] * R[7, q] + F[8, q] * R[8, q]
    c = F[0, q] * R[0, q] + F[1, q] * R[1, q] + F[2, q] * R[2, q]
    d00, d11, d22 = a + b, b + c, c + a
    d01 = -(F[0, q] * R[3, q] + F[1, q] * R[4, q] + F[2, q] * R[5, q])
    d02 = -(F[0, q] * R[6, q] + F[1, q] * R[7, q] + F[2, q] * R[8, q])
    d12 = -(F[3, q] * R[6, q] + F[4, q] * R[7, q] + F[5, q] * R[8, q])
    size = abs(d00) + abs(d11) + abs(d22) + 1e-12
    for _ in range(2):
        c00, c01, c02 = d11 * d22 - d12 * d12, d02 * d12 - d01 * d22, d01 * d12 - d02 * d11
        det = d00 * c00 + d01 * c01 + d02 * c02
        if abs(det) >= 1e-9 * size**3:
            break
        d00, d11, d22 = d00 + 1e-3 * size, d11 + 1e-3 * size, d22 + 1e-3 * size
    out[0], out[1], out[2] = c00 / det, c01 / det, c02 / det
    out[3], out[4], out[5] = (d00 * d22 - d02 * d02) / det, (d01 * d02 - d00 * d12) / det, (d00 * d11 - d01 * d01) / det
