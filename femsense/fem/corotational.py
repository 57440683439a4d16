# mypy: allow-untyped-decorators
"""The corotational element: linear elasticity in the frame rotated by the polar decomposition F = V R.

Energy of an element with quadrature points q of volume w_q and V = Σ w_q:

    W = Σ w_q (μ ‖F_q − R_q‖² + λ'/2 θ_q²) + V (λ − λ')/2 θ²,    θ_q = tr(R_qᵀ F_q) − 3,    θ = Σ w_q θ_q / V,

R_q the closest rotation to F_q, λ' = min(λ, ¾ μ). The excess λ − λ' acts on θ, the mean dilatation of the element: in a tetrahedron with
ten nodes it imposes one constraint instead of four, and the element does not lock for ν close to ½. docs/method/elements.md derives the
factor ¾. With one point (four nodes) it is the textbook element, whatever λ'.
With h_qa = R_q ∇N_a, h_a = Σ w_q h_qa / V, V_q = F_q R_qᵀ, D_q = tr(V_q) I − V_q and p_q = λ' θ_q + (λ − λ') θ:

    force      f_a  = Σ w_q (2μ (F_q − R_q) + p_q R_q) ∇N_a
    tangent    K_ab = V (λ − λ') h_a h_bᵀ + Σ w_q (2μ (h_qa·h_qb) I + λ' h_qa h_qbᵀ − (p_q − 2μ) [h_qa]ₓ D_q⁻¹ [h_qb]ₓ)

which is the full second derivative, rotation included. References: Müller & Gross 2004 (warped stiffness), Chao et al. 2010
(the energy), McAdams et al. 2011 (its exact second derivative), Nagtegaal, Parks & Rice 1974 (mean dilatation).
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.kernels import njit
from femsense.fem.rotation import FAST, closest_rotation, closest_rotation_anyhow, determinant, turning_compliance

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


@njit(cache=True, fastmath=FAST)
def _four_rotations(F: FloatArray, R: FloatArray, flat_F: FloatArray, flat_R: FloatArray, change: FloatArray) -> None:
    """Write the rotations closest to the matrices of four points, see `closest_rotation`; `change` is work memory for four.

    The flat views let the compiler see that they do not overlap, so that it processes the four at once.
    """
    for q in range(4):
        size = 0.0
        for k in range(9):
            size += F[k, q] * F[k, q]
        change[q] = determinant(F, q) - 0.02 * (size / 3.0) ** 1.5
    if not min(change[0], change[1], change[2], change[3]) > 0.0:
        for q in range(4):
            closest_rotation(F, R, q)
        return
    r = flat_R
    for k in range(36):
        r[k] = flat_F[k]
    for _ in range(30):
        for q in range(4):
            a, b, c, d, e, f, g, h, i = r[q], r[4 + q], r[8 + q], r[12 + q], r[16 + q], r[20 + q], r[24 + q], r[28 + q], r[32 + q]
            u, v, w = e * i - f * h, f * g - d * i, d * h - e * g
            s = 0.5 / (a * u + b * v + c * w)
            A, B, C = s * u - 0.5 * a, s * v - 0.5 * b, s * w - 0.5 * c
            D, E, H = s * (c * h - b * i) - 0.5 * d, s * (a * i - c * g) - 0.5 * e, s * (b * g - a * h) - 0.5 * f
            J, K, L = s * (b * f - c * e) - 0.5 * g, s * (c * d - a * f) - 0.5 * h, s * (a * e - b * d) - 0.5 * i
            change[q] = A * A + B * B + C * C + D * D + E * E + H * H + J * J + K * K + L * L
            r[q], r[4 + q], r[8 + q], r[12 + q], r[16 + q] = a + A, b + B, c + C, d + D, e + E
            r[20 + q], r[24 + q], r[28 + q], r[32 + q] = f + H, g + J, h + K, i + L
        if max(change[0], change[1], change[2], change[3]) < 1e-17:
            return
    for q in range(4):
        closest_rotation_anyhow(F, R, q)


STEP = 112
"""Distance of two columns of the product in `_factors` [numbers]: nine for each of ten nodes, and ten of the other side from 96 on."""


@njit(inline="always")
def _factors(e, w, mu, pull, local, lam, F, R, H, mean, Dinv, T):  # type: ignore[no-untyped-def]
    """Write the two sides of the stiffness of ten nodes as a product, K_ab = Σ_k t_ak h_bk with k = point and direction,
    then the mean.

    T[k, 9 a + 3 i + j] is −t, T[k, 96 + b] is h.
    """
    volume = 0.0
    for q in range(4):
        volume += w[e, q]
        turning_compliance(F, R, q, Dinv)
        s = w[e, q] * (2.0 * mu - pull[q])
        d00, d01, d02, d11, d12, d22 = s * Dinv[0], s * Dinv[1], s * Dinv[2], s * Dinv[3], s * Dinv[4], s * Dinv[5]
        c, m = -local * w[e, q], -2.0 * mu * w[e, q]
        X, Y, Z = T[3 * q], T[3 * q + 1], T[3 * q + 2]
        for a in range(10):
            x, y, z = H[q, 0, a], H[q, 1, a], H[q, 2, a]
            z00, z01, z02 = y * d02 - z * d01, y * d12 - z * d11, y * d22 - z * d12  # z = (2μ − p) w [h]ₓ D⁻¹
            z10, z11, z12 = z * d00 - x * d02, z * d01 - x * d12, z * d02 - x * d22
            z20, z21, z22 = x * d01 - y * d00, x * d11 - y * d01, x * d12 - y * d02
            r = 9 * a
            X[r], X[r + 1], X[r + 2] = (c + m) * x, -z02, z01
            X[r + 3], X[r + 4], X[r + 5] = c * y, m * x - z12, z11
            X[r + 6], X[r + 7], X[r + 8] = c * z, -z22, m * x + z21
            Y[r], Y[r + 1], Y[r + 2] = m * y + z02, c * x, -z00
            Y[r + 3], Y[r + 4], Y[r + 5] = z12, (c + m) * y, -z10
            Y[r + 6], Y[r + 7], Y[r + 8] = z22, c * z, m * y - z20
            Z[r], Z[r + 1], Z[r + 2] = m * z - z01, z00, c * x
            Z[r + 3], Z[r + 4], Z[r + 5] = -z11, m * z + z10, c * y
            Z[r + 6], Z[r + 7], Z[r + 8] = -z21, z20, (c + m) * z
            X[96 + a], Y[96 + a], Z[96 + a] = x, y, z
    for i in range(3):
        for a in range(10):
            side = (lam - local) / volume * mean[i, a]
            for j in range(3):
                T[12 + j, 9 * a + 3 * i + j] = -side
            T[12 + i, 96 + a] = mean[i, a]


@njit(inline="always")
def _add_product(T, K, slots, blocks):  # type: ignore[no-untyped-def]
    """Add T's product to the blocks of the pairs a ≤ b; K is room for it."""
    for b in range(10):
        for row in range(8 * ((9 * b + 16) // 8)):  # a whole number of registers
            total = T[0, row] * T[0, 96 + b]
            for k in range(1, 15):
                total += T[k, row] * T[k, 96 + b]
            K[b, row] = total
    pair = 0
    for a in range(10):
        for b in range(a, 10):
            block = blocks[slots[pair]]
            pair += 1
            for i in range(9):
                block[i] -= K[b, 9 * a + i]


@njit(cache=True, fastmath=FAST)
def _tet10(x, tets, gradients, volumes, mu, lam, tangent, slots, forces, blocks, stretch):  # type: ignore[no-untyped-def]
    """The same for ten nodes and four points, see `corotational_tet4` and, for `stretch`, `stretched_tet10`."""
    F, R, X, f = np.empty((9, 4)), np.empty((9, 4)), np.empty((3, 10)), np.empty((3, 10))
    H, mean, room, flat_F, flat_R = np.empty((4, 3, 10)), np.empty((3, 10)), np.empty(4), F.reshape(36), R.reshape(36)
    pull, Dinv, T, K = np.empty(4), np.empty(6), np.zeros((16, STEP), blocks.dtype), np.empty((10, STEP), blocks.dtype)
    energy = 0.0
    for e in range(len(tets)):
        for a in range(10):
            for i in range(3):
                X[i, a] = x[tets[e, a], i]
                f[i, a] = mean[i, a] = 0.0
        theta = volume = 0.0
        local = min(lam[e], LOCAL * mu[e])
        for q in range(4):
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for a in range(10):
                        s += X[i, a] * gradients[e, q, j, a]
                    F[3 * i + j, q] = s
        _four_rotations(F, R, flat_F, flat_R, room)
        for q in range(4):
            trace = -3.0
            for k in range(9):
                trace += F[k, q] * R[k, q]
            pull[q] = local * trace
            energy += 0.5 * volumes[e, q] * local * trace * trace
            theta += volumes[e, q] * trace
            volume += volumes[e, q]
        theta /= volume
        energy += 0.5 * (lam[e] - local) * volume * theta * theta
        for q in range(4):
            pull[q] += (lam[e] - local) * theta
            w = volumes[e, q]
            norm = 0.0
            for i in range(3):
                r0, r1, r2 = R[3 * i, q], R[3 * i + 1, q], R[3 * i + 2, q]
                u0, u1, u2 = F[3 * i, q] - r0, F[3 * i + 1, q] - r1, F[3 * i + 2, q] - r2
                norm += u0 * u0 + u1 * u1 + u2 * u2
                m2, p = 2.0 * w * mu[e], w * pull[q]
                p0, p1, p2 = m2 * u0 + p * r0, m2 * u1 + p * r1, m2 * u2 + p * r2
                for a in range(10):
                    g0, g1, g2 = gradients[e, q, 0, a], gradients[e, q, 1, a], gradients[e, q, 2, a]
                    f[i, a] += p0 * g0 + p1 * g1 + p2 * g2
                    h = r0 * g0 + r1 * g1 + r2 * g2
                    H[q, i, a] = h
                    mean[i, a] += w * h
            energy += w * mu[e] * norm
        for a in range(10):
            for i in range(3):
                forces[tets[e, a], i] += f[i, a]
        if len(stretch) and not tangent:
            for q in range(4):
                for i in range(3):
                    for j in range(3):
                        stretch[e, q, 3 * i + j] = R[i, q] * F[j, q] + R[3 + i, q] * F[3 + j, q] + R[6 + i, q] * F[6 + j, q]
        if len(stretch) and tangent:
            theta = 0.0
            for q in range(4):
                trace = stretch[e, q, 0] + stretch[e, q, 4] + stretch[e, q, 8] - 3.0
                pull[q] = local * trace
                theta += volumes[e, q] / volume * trace
                for i in range(3):
                    for j in range(3):
                        F[3 * i + j, q] = (
                            R[3 * i, q] * stretch[e, q, j]
                            + R[3 * i + 1, q] * stretch[e, q, 3 + j]
                            + R[3 * i + 2, q] * stretch[e, q, 6 + j]
                        )
            for q in range(4):
                pull[q] += (lam[e] - local) * theta
        if tangent:
            _factors(e, volumes, mu[e], pull, local, lam[e], F, R, H, mean, Dinv, T)
            _add_product(T, K, slots[e], blocks)
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

    Arrays are those of `Stencil`; `limit` is not used. With one point λ' has no influence and no data are kept between points: twice as
    fast as the kernel for ten nodes, `corotational_tet10`.
    """
    F, R, P, H, D = np.empty((9, 1)), np.empty((9, 1)), np.empty(9), np.empty((4, 3)), np.empty(6)
    first = np.int64(0)  # a number that is written here would compile the rotations a second time
    energy = 0.0
    for e in range(len(tets)):
        n0, n1, n2, n3, G = tets[e, 0], tets[e, 1], tets[e, 2], tets[e, 3], gradients[e, 0]
        for i in range(3):
            x0, x1, x2, x3 = x[n0, i], x[n1, i], x[n2, i], x[n3, i]
            for j in range(3):
                F[3 * i + j, 0] = x0 * G[j, 0] + x1 * G[j, 1] + x2 * G[j, 2] + x3 * G[j, 3]
        closest_rotation(F, R, first)
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
            turning_compliance(F, R, first, D)
            _linear_stiffness(H, D, shear, bulk, turn, slots[e], blocks)
    return energy


@njit(cache=True, nogil=True, fastmath=FAST)
def corotational_tet10(x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    """The same for ten nodes and four points, see `corotational_tet4`."""
    return _tet10(x, tets, gradients, volumes, mu, lam, tangent, slots, forces, blocks, np.empty((0, 4, 9)))


@njit(cache=True, fastmath=FAST)
def stretched_tet10(x, tets, gradients, volumes, mu, lam, tangent, slots, forces, blocks, stretch):  # type: ignore[no-untyped-def]
    """The same, with the stress of another state in the stiffness.

    Without `tangent`, RᵀF is written to `stretch`, shape (m, 4, 9); with it,
    the stiffness uses the rotations R at x and the stored stretches, as if F were R times these (forces and energy are those of x).
    """
    return _tet10(x, tets, gradients, volumes, mu, lam, tangent, slots, forces, blocks, stretch)
