# mypy: allow-untyped-decorators
"""Hyperelastic laws with the interface of the corotational element: neo-Hookean and Gent.

    neo-Hookean  W = μ/2 (I₁ − 3) − μ ln J + λ/2 (ln J)²
    Gent         the first term becomes −μ jm/2 ln(1 − (I₁ − 3)/jm)

Of λ, λ' = min(λ, ¾ μ) acts on the J_q of each quadrature point and the rest on one J̄ = Σ w_q J_q / V, the volume of the element
against rest (Simo, Taylor & Pister 1985), so that ten nodes do not lock where ν is close to ½. With g_qa = F_q⁻ᵀ ∇N_a,
m_a = Σ w_q J_q g_qa / V, p = (λ − λ') ln J̄ / J̄, p_q = p J_q + λ' ln J_q and s = 1 (neo-Hookean) or jm/(jm − I₁ + 3) (Gent):

    force      f_a  = Σ w_q (μ s F_q ∇N_a + (p_q − μ) g_qa)
    tangent    K_ab = V (λ − λ') (1 − ln J̄)/J̄² m_a m_bᵀ + Σ w_q (μ s (∇N_a·∇N_b) I + 2 μ s²/jm (F_q∇N_a)(F_q∇N_b)ᵀ
                      + (p J_q + λ') g_qa g_qbᵀ + (μ − p_q) g_qb g_qaᵀ)

(Bonet & Wood 2008, ch. 6; Gent 1996). An inverted or over-stretched element has infinite energy, which the line search steps
back from.
"""

from __future__ import annotations

import numpy as np

from femsense.core.kernels import njit
from femsense.fem.corotational import LOCAL, add_blocks
from femsense.fem.linalg.simd_lanes import LANES
from femsense.fem.rotation import FAST, determinant


@njit(inline="always")
def _stiffness(count, quad, row, e, gradients, along, bulk, pressure, shear, second, inverse, forward, mean, K):  # type: ignore[no-untyped-def]
    """Write the stiffness of an element, K[a, i, j, b]."""
    for a in range(count):
        for i in range(3):
            side = bulk * mean[i, a]
            for b in range(a & -LANES, row):
                s0, s1, s2 = side * mean[0, b], side * mean[1, b], side * mean[2, b]
                for q in range(quad):
                    left, right = pressure[q] * inverse[q, i, a], shear[q] * inverse[q, i, b]
                    stretch = second[q] * forward[q, i, a]
                    s0 += left * inverse[q, 0, b] + right * inverse[q, 0, a] + stretch * forward[q, 0, b]
                    s1 += left * inverse[q, 1, b] + right * inverse[q, 1, a] + stretch * forward[q, 1, b]
                    s2 += left * inverse[q, 2, b] + right * inverse[q, 2, a] + stretch * forward[q, 2, b]
                K[a, i, 0, b], K[a, i, 1, b], K[a, i, 2, b] = s0, s1, s2
    for q in range(quad):
        for a in range(count):
            x, y, z = (along[q] * gradients[e, q, 0, a], along[q] * gradients[e, q, 1, a], along[q] * gradients[e, q, 2, a])
            for b in range(a, count):
                dot = x * gradients[e, q, 0, b] + y * gradients[e, q, 1, b] + z * gradients[e, q, 2, b]
                K[a, 0, 0, b] += dot
                K[a, 1, 1, b] += dot
                K[a, 2, 2, b] += dot


@njit(inline="always")
def _kernel(count, quad, row, x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    F, X, f = np.empty((9, quad)), np.empty((3, count)), np.empty((3, count))
    forward, inverse, mean = np.zeros((quad, 3, row)), np.zeros((quad, 3, row)), np.zeros((3, row))
    J, log_J, along, pressure, shear, second = (
        np.empty(quad),
        np.empty(quad),
        np.empty(quad),
        np.empty(quad),
        np.empty(quad),
        np.zeros(quad),
    )
    K = np.empty((count, 3, 3, row))
    energy = 0.0
    for e in range(len(tets)):
        for a in range(count):
            for i in range(3):
                X[i, a] = x[tets[e, a], i]
                f[i, a] = mean[i, a] = 0.0
        volume = now = 0.0
        local = min(lam[e], LOCAL * mu[e])
        for q in range(quad):
            stretch = -3.0
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for a in range(count):
                        s += X[i, a] * gradients[e, q, j, a]
                    F[3 * i + j, q] = s
                    stretch += s * s
            J[q] = determinant(F, q)
            if J[q] <= 0.0 or stretch >= limit:
                return np.inf
            volume += volumes[e, q]
            now += volumes[e, q] * J[q]
            first, scale = 0.5 * mu[e] * stretch, 1.0
            if limit < np.inf:
                first = -0.5 * mu[e] * limit * np.log(1.0 - stretch / limit)
                scale = limit / (limit - stretch)
                second[q] = 2.0 * volumes[e, q] * mu[e] * scale * scale / limit
            along[q] = volumes[e, q] * mu[e] * scale
            log_J[q] = np.log(J[q])
            energy += volumes[e, q] * (first - mu[e] * log_J[q] + 0.5 * local * log_J[q] * log_J[q])
        ratio = now / volume
        log_ratio = np.log(ratio)
        energy += 0.5 * (lam[e] - local) * volume * log_ratio * log_ratio
        for q in range(quad):
            w = volumes[e, q] * J[q]
            shared = w * (lam[e] - local) * log_ratio / ratio
            pressure[q] = shared + volumes[e, q] * local
            shear[q] = volumes[e, q] * (mu[e] - local * log_J[q]) - shared
            for i in range(3):
                j, k = 3 * ((i + 1) % 3), 3 * ((i + 2) % 3)
                c0 = (F[j + 1, q] * F[k + 2, q] - F[j + 2, q] * F[k + 1, q]) / J[q]
                c1 = (F[j + 2, q] * F[k, q] - F[j, q] * F[k + 2, q]) / J[q]
                c2 = (F[j, q] * F[k + 1, q] - F[j + 1, q] * F[k, q]) / J[q]
                f0, f1, f2 = F[3 * i, q], F[3 * i + 1, q], F[3 * i + 2, q]
                for a in range(count):
                    g0, g1, g2 = gradients[e, q, 0, a], gradients[e, q, 1, a], gradients[e, q, 2, a]
                    forward[q, i, a] = f0 * g0 + f1 * g1 + f2 * g2
                    inverse[q, i, a] = c0 * g0 + c1 * g1 + c2 * g2
                    mean[i, a] += w * inverse[q, i, a]
                    f[i, a] += along[q] * forward[q, i, a] - shear[q] * inverse[q, i, a]
        for a in range(count):
            for i in range(3):
                forces[tets[e, a], i] += f[i, a]
        if tangent:
            bulk = (lam[e] - local) * (1.0 - log_ratio) / (ratio * ratio * volume)
            _stiffness(count, quad, row, e, gradients, along, bulk, pressure, shear, second, inverse, forward, mean, K)
            add_blocks(count, K, slots, e, blocks)
    return energy


@njit(cache=True, nogil=True, fastmath=FAST)
def hyperelastic_tet4(x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    """Add internal forces [N] and, if asked, the stiffness blocks on and above the diagonal [N/m]; return the energy [J].

    Arrays are those of `Stencil`; `limit` is Gent's jm, inf for neo-Hookean. The same for ten nodes is `hyperelastic_tet10`.
    """
    return _kernel(4, 1, 4, x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks)


@njit(cache=True, nogil=True, fastmath=FAST)
def hyperelastic_tet10(x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks):  # type: ignore[no-untyped-def]
    """As `hyperelastic_tet4`, for quadratic elements: ten nodes and four integration points."""
    return _kernel(10, 4, 16, x, tets, gradients, volumes, mu, lam, limit, tangent, slots, forces, blocks)
