# mypy: allow-untyped-decorators
"""The corotational element: linear elasticity in the frame that the polar decomposition F = V R turns along.

Energy of an element with quadrature points q of volume w_q and V = Σ w_q:

    W = Σ w_q (μ ‖F_q − R_q‖² + λ'/2 θ_q²) + V (λ − λ')/2 θ²,    θ_q = tr(R_qᵀ F_q) − 3,    θ = Σ w_q θ_q / V,

R_q the closest rotation to F_q, λ' = min(λ, ¾ μ). What λ exceeds λ' by acts on θ, one number an element, the mean
dilatation: that part of a tetrahedron with ten nodes asks for one thing, not four, and the element does not lock where ν is
close to ½. Why ¾ stands in docs/elements.md. With one point (four nodes) it is the textbook element, whatever λ'.
With h_qa = R_q ∇N_a, h_a = Σ w_q h_qa / V, V_q = F_q R_qᵀ, D_q = tr(V_q) I − V_q and p_q = λ' θ_q + (λ − λ') θ:

    force      f_a  = Σ w_q (2μ (F_q − R_q) + p_q R_q) ∇N_a
    tangent    K_ab = V (λ − λ') h_a h_bᵀ + Σ w_q (2μ (h_qa·h_qb) I + λ' h_qa h_qbᵀ − (p_q − 2μ) [h_qa]ₓ D_q⁻¹ [h_qb]ₓ)

which is the full second derivative, rotation included. References: Müller & Gross 2004 (warped stiffness), Chao et al. 2010
(the energy), McAdams et al. 2011 (its exact second derivative), Nagtegaal, Parks & Rice 1974 (mean dilatation).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from femsense.arrays import FloatArray

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Rounding may differ; infinities and NaN are kept."""
LANES = 8
"""Rows of ten node values are padded to a multiple of this, so that processors can take them in whole registers."""


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
    """Write the rotation (det +1) that is closest to F_q (Newton of Higham 1986; the SVD where F_q is flat or inverted).

    Matrices are columns, row by row, shape (9, quad).
    """
    size = 0.0
    for k in range(9):
        size += F[k, q] * F[k, q]
    if not determinant(F, q) > 0.02 * (size / 3.0) ** 1.5:
        closest_rotation_by_svd(F, R, q)
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
        closest_rotation_by_svd(F, R, q)
        return
    R[0, q], R[1, q], R[2, q], R[3, q], R[4, q], R[5, q], R[6, q], R[7, q], R[8, q] = a, b, c, d, e, f, g, h, i


@njit(cache=True)
def closest_rotation_by_svd(F: FloatArray, R: FloatArray, q: int) -> None:
    """Write the rotation that is closest to F_q, flat or inverted as it may be."""
    U, _, Vt = np.linalg.svd(np.ascontiguousarray(F[:, q]).reshape(3, 3))
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        U[:, 2] *= -1.0
    R[:, q] = (U @ Vt).ravel()


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


LOCAL = 0.75
"""λ up to this share of μ acts at each quadrature point, the rest on the mean dilatation of an element."""


@njit(inline="always")
def add_blocks(count, K, slots, e, blocks):  # type: ignore[no-untyped-def]
    """Add the blocks a ≤ b of K[a, i, j, b] where they belong."""
    pair = 0
    for a in range(count):
        for b in range(a, count):
            slot = slots[e, pair]
            pair += 1
            for i in range(3):
                for j in range(3):
                    blocks[slot, 3 * i + j] += K[a, i, j, b]


@njit(inline="always")
def _stiffness(count, quad, row, e, w, mu, pull, local, lam, F, R, H, mean, Dinv, Z, K):  # type: ignore[no-untyped-def]
    """Write the stiffness of an element, K[a, i, j, b]."""
    volume = 0.0
    for q in range(quad):
        volume += w[e, q]
        turning_compliance(F, R, q, Dinv)
        s = w[e, q] * (2.0 * mu - pull[q])
        d00, d01, d02, d11, d12, d22 = s * Dinv[0], s * Dinv[1], s * Dinv[2], s * Dinv[3], s * Dinv[4], s * Dinv[5]
        for a in range(count):  # Z = (2μ − λθ) w [h]ₓ D⁻¹
            x, y, z = H[q, 0, a], H[q, 1, a], H[q, 2, a]
            Z[a, 0, 3 * q], Z[a, 0, 3 * q + 1], Z[a, 0, 3 * q + 2] = y * d02 - z * d01, y * d12 - z * d11, y * d22 - z * d12
            Z[a, 1, 3 * q], Z[a, 1, 3 * q + 1], Z[a, 1, 3 * q + 2] = z * d00 - x * d02, z * d01 - x * d12, z * d02 - x * d22
            Z[a, 2, 3 * q], Z[a, 2, 3 * q + 1], Z[a, 2, 3 * q + 2] = x * d01 - y * d00, x * d11 - y * d01, x * d12 - y * d02
    for a in range(count):
        for i in range(3):
            side = (lam - local) / volume * mean[i, a]
            for b in range(a & -LANES, row):
                s0, s1, s2 = side * mean[0, b], side * mean[1, b], side * mean[2, b]
                for q in range(quad):
                    z0, z1, z2 = Z[a, i, 3 * q], Z[a, i, 3 * q + 1], Z[a, i, 3 * q + 2]
                    z = local * w[e, q] * H[q, i, a]
                    s0 += z1 * H[q, 2, b] - z2 * H[q, 1, b] + z * H[q, 0, b]
                    s1 += z2 * H[q, 0, b] - z0 * H[q, 2, b] + z * H[q, 1, b]
                    s2 += z0 * H[q, 1, b] - z1 * H[q, 0, b] + z * H[q, 2, b]
                K[a, i, 0, b], K[a, i, 1, b], K[a, i, 2, b] = s0, s1, s2
    for q in range(quad):
        s = 2.0 * mu * w[e, q]
        for a in range(count):
            x, y, z = s * H[q, 0, a], s * H[q, 1, a], s * H[q, 2, a]
            for b in range(a & -LANES, row):
                dot = x * H[q, 0, b] + y * H[q, 1, b] + z * H[q, 2, b]
                K[a, 0, 0, b] += dot
                K[a, 1, 1, b] += dot
                K[a, 2, 2, b] += dot


@njit(inline="always")
def _kernel(count, quad, row, x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    F, R, X, f = np.empty((9, quad)), np.empty((9, quad)), np.empty((3, count)), np.empty((3, count))
    H, mean = np.zeros((quad, 3, row)), np.zeros((3, row))
    pull, Dinv, Z, K = np.empty(quad), np.empty(6), np.empty((count, 3, 3 * quad)), np.empty((count, 3, 3, row))
    energy = 0.0
    for e in range(len(tets)):
        for a in range(count):
            for i in range(3):
                X[i, a] = x[tets[e, a], i]
                f[i, a] = mean[i, a] = 0.0
        theta = volume = 0.0
        local = min(lam[e], LOCAL * mu[e])
        for q in range(quad):
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for a in range(count):
                        s += X[i, a] * gradients[e, q, j, a]
                    F[3 * i + j, q] = s
            closest_rotation(F, R, q)
            trace = -3.0
            for k in range(9):
                trace += F[k, q] * R[k, q]
            pull[q] = local * trace
            energy += 0.5 * volumes[e, q] * local * trace * trace
            theta += volumes[e, q] * trace
            volume += volumes[e, q]
        theta /= volume
        energy += 0.5 * (lam[e] - local) * volume * theta * theta
        for q in range(quad):
            pull[q] += (lam[e] - local) * theta
            w = volumes[e, q]
            norm = 0.0
            for i in range(3):
                r0, r1, r2 = R[3 * i, q], R[3 * i + 1, q], R[3 * i + 2, q]
                u0, u1, u2 = F[3 * i, q] - r0, F[3 * i + 1, q] - r1, F[3 * i + 2, q] - r2
                norm += u0 * u0 + u1 * u1 + u2 * u2
                m2, p = 2.0 * w * mu[e], w * pull[q]
                p0, p1, p2 = m2 * u0 + p * r0, m2 * u1 + p * r1, m2 * u2 + p * r2
                for a in range(count):
                    g0, g1, g2 = gradients[e, q, 0, a], gradients[e, q, 1, a], gradients[e, q, 2, a]
                    f[i, a] += p0 * g0 + p1 * g1 + p2 * g2
                    h = r0 * g0 + r1 * g1 + r2 * g2
                    H[q, i, a] = h
                    mean[i, a] += w * h
            energy += w * mu[e] * norm
        for a in range(count):
            for i in range(3):
                forces[tets[e, a], i] += f[i, a]
        if tangent:
            _stiffness(count, quad, row, e, volumes, mu[e], pull, local, lam[e], F, R, H, mean, Dinv, Z, K)
            add_blocks(count, K, slots, e, blocks)
    return energy


@njit(inline="always")
def _linear_forces(tet, G, R, P, H, forces):  # type: ignore[no-untyped-def]
    """Add the forces P ∇N of four nodes to those of the body, and write H = R ∇N, shape (4, 3)."""
    for a in range(4):
        g0, g1, g2, n = G[0, a], G[1, a], G[2, a], tet[a]
        forces[n, 0] += P[0] * g0 + P[1] * g1 + P[2] * g2
        forces[n, 1] += P[3] * g0 + P[4] * g1 + P[5] * g2
        forces[n, 2] += P[6] * g0 + P[7] * g1 + P[8] * g2
        H[a, 0] = R[0, 0] * g0 + R[1, 0] * g1 + R[2, 0] * g2
        H[a, 1] = R[3, 0] * g0 + R[4, 0] * g1 + R[5, 0] * g2
        H[a, 2] = R[6, 0] * g0 + R[7, 0] * g1 + R[8, 0] * g2


@njit(inline="always")
def _linear_stiffness(H, D, shear, bulk, turn, slots, blocks):  # type: ignore[no-untyped-def]
    """Add shear (h_a·h_b) I + bulk h_a h_bᵀ + turn [h_a]ₓ D⁻¹ [h_b]ₓ of the pairs a ≤ b of four nodes."""
    d00, d01, d02, d11, d12, d22 = turn * D[0], turn * D[1], turn * D[2], turn * D[3], turn * D[4], turn * D[5]
    pair = 0
    for a in range(4):
        x, y, z = H[a, 0], H[a, 1], H[a, 2]
        z00, z01, z02 = y * d02 - z * d01, y * d12 - z * d11, y * d22 - z * d12
        z10, z11, z12 = z * d00 - x * d02, z * d01 - x * d12, z * d02 - x * d22
        z20, z21, z22 = x * d01 - y * d00, x * d11 - y * d01, x * d12 - y * d02
        bx, by, bz = bulk * x, bulk * y, bulk * z
        for b in range(a, 4):
            u, v, w = H[b, 0], H[b, 1], H[b, 2]
            dot = shear * (x * u + y * v + z * w)
            to = blocks[slots[pair]]
            pair += 1
            to[0] += z01 * w - z02 * v + bx * u + dot
            to[1] += z02 * u - z00 * w + bx * v
            to[2] += z00 * v - z01 * u + bx * w
            to[3] += z11 * w - z12 * v + by * u
            to[4] += z12 * u - z10 * w + by * v + dot
            to[5] += z10 * v - z11 * u + by * w
            to[6] += z21 * w - z22 * v + bz * u
            to[7] += z22 * u - z20 * w + bz * v
            to[8] += z20 * v - z21 * u + bz * w + dot


@njit(cache=True, nogil=True, fastmath=FAST)
def corotational_tet4(x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    """Add internal forces [N] and, if asked, the stiffness blocks on and above the diagonal [N/m]; return the energy [J].

    Arrays are those of `Stencil`; `limit` is not used. With one point λ' does not matter, and nothing is kept from point to point:
    twice as fast as the kernel of ten nodes would be. For these see `corotational_tet10`.
    """
    F, R, P, H, D = np.empty((9, 1)), np.empty((9, 1)), np.empty(9), np.empty((4, 3)), np.empty(6)
    energy = 0.0
    for e in range(len(tets)):
        n0, n1, n2, n3, G = tets[e, 0], tets[e, 1], tets[e, 2], tets[e, 3], gradients[e, 0]
        for i in range(3):
            x0, x1, x2, x3 = x[n0, i], x[n1, i], x[n2, i], x[n3, i]
            for j in range(3):
                F[3 * i + j, 0] = x0 * G[j, 0] + x1 * G[j, 1] + x2 * G[j, 2] + x3 * G[j, 3]
        closest_rotation(F, R, 0)
        trace = -3.0
        for k in range(9):
            trace += F[k, 0] * R[k, 0]
        shear, bulk = 2.0 * volumes[e, 0] * mu[e], volumes[e, 0] * lam[e]
        turn, norm = shear - bulk * trace, 0.0
        for k in range(9):
            norm += (F[k, 0] - R[k, 0]) ** 2
            P[k] = shear * F[k, 0] - turn * R[k, 0]
        energy += 0.5 * (shear * norm + bulk * trace * trace)
        _linear_forces(tets[e], G, R, P, H, forces)
        if tangent:
            turning_compliance(F, R, 0, D)
            _linear_stiffness(H, D, shear, bulk, turn, slots[e], blocks)
    return energy


@njit(cache=True, nogil=True, fastmath=FAST)
def corotational_tet10(x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    """The same for ten nodes and four points, see `corotational_tet4`."""
    return _kernel(10, 4, 16, x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks)
