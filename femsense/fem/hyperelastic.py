# mypy: allow-untyped-decorators
"""Hyperelastic laws with the interface of the corotational element: neo-Hookean and Gent.

    neo-Hookean  W = μ/2 (I₁ − 3) − μ ln J + λ/2 (ln J)²
    Gent         the first term becomes −μ jm/2 ln(1 − (I₁ − 3)/jm)

With g_a = F⁻ᵀ ∇N_a, s = 1 (neo-Hookean) or jm/(jm − I₁ + 3) (Gent), f_a = μ s F ∇N_a + (λ ln J − μ) g_a and
K_ab = μ s (∇N_a·∇N_b) I + 2 μ s²/jm (F∇N_a)(F∇N_b)ᵀ + λ g_a g_bᵀ + (μ − λ ln J) g_b g_aᵀ (Bonet & Wood 2008, ch. 6; Gent 1996).
An inverted or over-stretched element has infinite energy, which the line search steps back from.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from femsense.arrays import FloatArray, IntArray
from femsense.fem.corotational import cofactor, determinant


@njit(cache=True)
def hyperelastic_kernel(
    x: FloatArray, tets: IntArray, gradients: FloatArray, volumes: FloatArray, mu: FloatArray, lam: FloatArray,
    limit: float, tangent: bool, slots: IntArray, forces: FloatArray, blocks: FloatArray,
) -> float:  # fmt: skip
    """Add internal forces [N] and, if asked, stiffness blocks [N/m]; return the energy [J]. `limit`: Gent's jm, inf for neo-Hookean."""
    m, quad, count = gradients.shape[0], gradients.shape[1], gradients.shape[2]
    F, work = np.empty((3, 3)), np.empty((3, 3))
    Fg, g_inv = np.empty((count, 3)), np.empty((count, 3))
    energy = 0.0
    for e in range(m):
        for q in range(quad):
            vol = volumes[e, q]
            g = gradients[e, q]
            stretch = -3.0
            for i in range(3):
                for j in range(3):
                    s = 0.0
                    for a in range(count):
                        s += x[tets[e, a], i] * g[a, j]
                    F[i, j] = s
                    stretch += s * s
            J = determinant(F)
            if J <= 0.0 or stretch >= limit:
                return np.inf
            log_J = np.log(J)
            first, second, scale = 0.5 * mu[e] * stretch, 0.0, 1.0
            if limit < np.inf:
                first = -0.5 * mu[e] * limit * np.log(1.0 - stretch / limit)
                scale = limit / (limit - stretch)
                second = 2.0 * vol * mu[e] * scale * scale / limit
            energy += vol * (first - mu[e] * log_J + 0.5 * lam[e] * log_J * log_J)
            cofactor(F, work)
            along, across = vol * mu[e] * scale, vol * (lam[e] * log_J - mu[e])
            for a in range(count):
                for i in range(3):
                    Fg[a, i] = F[i, 0] * g[a, 0] + F[i, 1] * g[a, 1] + F[i, 2] * g[a, 2]
                    g_inv[a, i] = (work[i, 0] * g[a, 0] + work[i, 1] * g[a, 1] + work[i, 2] * g[a, 2]) / J
                    forces[tets[e, a], i] += along * Fg[a, i] + across * g_inv[a, i]
            if not tangent:
                continue
            for a in range(count):
                for b in range(count):
                    block = blocks[slots[e, a, b]]
                    dot = along * (g[a, 0] * g[b, 0] + g[a, 1] * g[b, 1] + g[a, 2] * g[b, 2])
                    for i in range(3):
                        for j in range(3):
                            block[3 * i + j] += (
                                vol * lam[e] * g_inv[a, i] * g_inv[b, j]
                                - across * g_inv[b, i] * g_inv[a, j]
                                + second * Fg[a, i] * Fg[b, j]
                            )
                        block[4 * i] += dot
    return energy
