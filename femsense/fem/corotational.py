# mypy: allow-untyped-decorators
"""The corotational element: linear elasticity in the frame that the polar decomposition F = V R turns along.

Energy density  w = μ ‖F − R‖² + λ/2 (tr(Rᵀ F) − 3)², R the closest rotation to F. With h_a = R ∇N_a, V = F Rᵀ and
D = tr(V) I − V:

    force      f_a  = (2μ (F − R) + λ tr(V − I) R) ∇N_a
    tangent    K_ab = 2μ (h_a·h_b) I + λ h_a h_bᵀ − c [h_a]ₓ D⁻¹ [h_b]ₓ,   c = λ tr(V − I) − 2μ

which is the full second derivative, rotation included. References: Müller & Gross 2004 (warped stiffness),
Chao et al. 2010 (the energy), McAdams et al. 2011 (its exact second derivative).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from femsense.arrays import FloatArray, IntArray


@njit(cache=True)
def determinant(A: FloatArray) -> float:
    """Return det A of a 3 × 3 matrix."""
    return float(
        A[0, 0] * (A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1])
        - A[0, 1] * (A[1, 0] * A[2, 2] - A[1, 2] * A[2, 0])
        + A[0, 2] * (A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0])
    )


@njit(cache=True)
def cofactor(A: FloatArray, out: FloatArray) -> None:
    """Write the cofactor matrix (det A · A⁻ᵀ) of a 3 × 3 matrix."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, 0] = A[j, 1] * A[k, 2] - A[j, 2] * A[k, 1]
        out[i, 1] = A[j, 2] * A[k, 0] - A[j, 0] * A[k, 2]
        out[i, 2] = A[j, 0] * A[k, 1] - A[j, 1] * A[k, 0]


@njit(cache=True)
def closest_rotation(F: FloatArray, R: FloatArray, work: FloatArray) -> None:
    """Write the rotation (det +1) that is closest to F (Newton of Higham 1986; the SVD where F is flat or inverted)."""
    size = 0.0
    for i in range(3):
        for j in range(3):
            size += F[i, j] * F[i, j]
            R[i, j] = F[i, j]
    if determinant(F) > 0.02 * (size / 3.0) ** 1.5:
        for _ in range(30):
            det = determinant(R)
            cofactor(R, work)
            change = 0.0
            for i in range(3):
                for j in range(3):
                    new = 0.5 * (R[i, j] + work[i, j] / det)
                    change = max(change, abs(new - R[i, j]))
                    R[i, j] = new
            if change < 1e-9:  # quadratic: the next change is below 1e-17
                return
    U, _, Vt = np.linalg.svd(F)
    if determinant(U) * determinant(Vt) < 0.0:
        for i in range(3):
            U[i, 2] = -U[i, 2]
    for i in range(3):
        for j in range(3):
            R[i, j] = U[i, 0] * Vt[0, j] + U[i, 1] * Vt[1, j] + U[i, 2] * Vt[2, j]


@njit(cache=True)
def inverse_symmetric(A: FloatArray, out: FloatArray) -> None:
    """Write the inverse of a symmetric 3 × 3 matrix; one that is singular gets a small shift."""
    det = determinant(A)
    size = abs(A[0, 0]) + abs(A[1, 1]) + abs(A[2, 2]) + 1e-12  # all nodes in one point give A = 0
    if abs(det) < 1e-9 * size**3:
        for i in range(3):
            A[i, i] += 1e-3 * size
        det = determinant(A)
    cofactor(A, out)
    for i in range(3):
        for j in range(3):
            out[i, j] /= det


@njit(cache=True)
def corotational_kernel(
    x: FloatArray, tets: IntArray, gradients: FloatArray, volumes: FloatArray, mu: FloatArray, lam: FloatArray,
    limit: float, tangent: bool, slots: IntArray, forces: FloatArray, blocks: FloatArray,
) -> float:  # fmt: skip
    """Add internal forces [N] and, if asked, stiffness blocks [N/m]; return the energy [J]. `limit` is not used."""
    m, quad, count = gradients.shape[0], gradients.shape[1], gradients.shape[2]
    F, R, V, D = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    Dinv, work, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    h = np.empty((count, 3))
    G = np.empty((count, 3, 3))
    energy = 0.0
    for e in range(m):
        for q in range(quad):
            vol = volumes[e, q]
            g = gradients[e, q]
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for a in range(count):
                        s += x[tets[e, a], i] * g[a, j]
                    F[i, j] = s
            closest_rotation(F, R, work)
            trace, norm = -3.0, 0.0
            for i in range(3):
                for j in range(3):
                    trace += F[i, j] * R[i, j]
                    norm += (F[i, j] - R[i, j]) ** 2
            energy += vol * (mu[e] * norm + 0.5 * lam[e] * trace * trace)
            for i in range(3):
                for j in range(3):
                    P[i, j] = vol * (2.0 * mu[e] * (F[i, j] - R[i, j]) + lam[e] * trace * R[i, j])
            for a in range(count):
                for i in range(3):
                    forces[tets[e, a], i] += P[i, 0] * g[a, 0] + P[i, 1] * g[a, 1] + P[i, 2] * g[a, 2]
            if not tangent:
                continue
            for i in range(3):
                for j in range(3):
                    V[i, j] = F[i, 0] * R[j, 0] + F[i, 1] * R[j, 1] + F[i, 2] * R[j, 2]
            total = V[0, 0] + V[1, 1] + V[2, 2]
            for i in range(3):
                for j in range(3):
                    D[i, j] = (total if i == j else 0.0) - 0.5 * (V[i, j] + V[j, i])
            inverse_symmetric(D, Dinv)
            c = vol * (lam[e] * trace - 2.0 * mu[e])
            for a in range(count):
                for i in range(3):
                    h[a, i] = R[i, 0] * g[a, 0] + R[i, 1] * g[a, 1] + R[i, 2] * g[a, 2]
            for a in range(count):  # G_a = −c [h_a]ₓ D⁻¹
                for j in range(3):
                    G[a, 0, j] = -c * (h[a, 1] * Dinv[2, j] - h[a, 2] * Dinv[1, j])
                    G[a, 1, j] = -c * (h[a, 2] * Dinv[0, j] - h[a, 0] * Dinv[2, j])
                    G[a, 2, j] = -c * (h[a, 0] * Dinv[1, j] - h[a, 1] * Dinv[0, j])
            mu2, lame = 2.0 * mu[e] * vol, lam[e] * vol
            for a in range(count):
                for b in range(count):
                    block = blocks[slots[e, a, b]]
                    dot = mu2 * (h[a, 0] * h[b, 0] + h[a, 1] * h[b, 1] + h[a, 2] * h[b, 2])
                    for i in range(3):
                        la = lame * h[a, i]
                        block[3 * i] += la * h[b, 0] + G[a, i, 1] * h[b, 2] - G[a, i, 2] * h[b, 1]
                        block[3 * i + 1] += la * h[b, 1] + G[a, i, 2] * h[b, 0] - G[a, i, 0] * h[b, 2]
                        block[3 * i + 2] += la * h[b, 2] + G[a, i, 0] * h[b, 1] - G[a, i, 1] * h[b, 0]
                        block[4 * i] += dot
    return energy
