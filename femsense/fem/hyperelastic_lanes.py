# mypy: allow-untyped-decorators
"""Forces of hyperelastic elements, LANES of them at a time: where no stiffness is wanted.

The laws are those of `femsense.fem.hyperelastic`.
"""

from __future__ import annotations

import numpy as np

from femsense.core.kernels import njit
from femsense.fem.corotational import LOCAL
from femsense.fem.corotational_lanes import gathered, scattered
from femsense.fem.linalg.simd_lanes import LANES, add_divergence, add_gradient
from femsense.fem.rotation import FAST

VOLUME, JACOBIAN, STRETCH, LOGARITHM, ALONG, ACROSS = (row * LANES for row in (9, 10, 11, 12, 13, 14))
"""Places of the rows of LANES numbers in a quadrature point's array, behind the nine rows of F."""
ROWS = 15


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _deform(v):  # type: ignore[no-untyped-def]
    """Write JACOBIAN, det F, and STRETCH, |F|² − 3, of a point, shape (ROWS LANES,)."""
    for q in range(LANES):
        a, b, c = v[q], v[LANES + q], v[2 * LANES + q]
        d, e, f = v[3 * LANES + q], v[4 * LANES + q], v[5 * LANES + q]
        g, h, i = v[6 * LANES + q], v[7 * LANES + q], v[8 * LANES + q]
        v[JACOBIAN + q] = a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)
        v[STRETCH + q] = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i - 3.0


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _stress(v):  # type: ignore[no-untyped-def]
    """Write ALONG F − ACROSS cof F / J over the F of a point."""
    for q in range(LANES):
        a, b, c = v[q], v[LANES + q], v[2 * LANES + q]
        d, e, f = v[3 * LANES + q], v[4 * LANES + q], v[5 * LANES + q]
        g, h, i = v[6 * LANES + q], v[7 * LANES + q], v[8 * LANES + q]
        s, w = v[ALONG + q], v[ACROSS + q] / v[JACOBIAN + q]
        v[q], v[LANES + q], v[2 * LANES + q] = (
            s * a - w * (e * i - f * h),
            s * b - w * (f * g - d * i),
            s * c - w * (d * h - e * g),
        )
        v[3 * LANES + q], v[4 * LANES + q] = s * d - w * (c * h - b * i), s * e - w * (a * i - c * g)
        v[5 * LANES + q], v[6 * LANES + q] = s * f - w * (b * g - a * h), s * g - w * (b * f - c * e)
        v[7 * LANES + q], v[8 * LANES + q] = s * h - w * (c * d - a * f), s * i - w * (a * e - b * d)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def hyperelastic_forces(x, nodes, gradients, volumes, mu, lam, limit, forces):  # type: ignore[no-untyped-def]
    """Add internal forces [N] to those of the body, LANES elements at a time; return the energy [J], inf where an element is inverted or over-stretched.

    Arrays are those of `Lanes` and `Stencil`; `limit` is Gent's jm, inf for neo-Hookean.
    """
    points, count, wide = volumes.shape[1], nodes.shape[1], 3 * nodes.shape[1] * LANES
    v, X = np.empty((points, ROWS * LANES)), np.empty(wide)
    ratio, whole = np.empty(LANES), np.empty(LANES)
    first, energy = gradients.ctypes.data, 0.0
    for e in range(len(nodes)):
        gathered(x, nodes[e], X)
        v[:, : 9 * LANES] = 0.0
        ratio[:], whole[:] = 0.0, 0.0
        for p in range(points):
            add_gradient(gradients, v[p].ctypes.data, X.ctypes.data, first + 8 * (e * points + p) * wide, count)
            _deform(v[p])
            for q in range(LANES):
                element = LANES * e + q
                if element >= len(volumes):  # the last group is filled up with elements that do not count
                    v[p, JACOBIAN + q] = v[p, STRETCH + q] = 1.0
                J = v[p, JACOBIAN + q]
                if J <= 0.0 or v[p, STRETCH + q] >= limit:
                    return np.inf
                w = volumes[element, p] if element < len(volumes) else 1e-300
                v[p, VOLUME + q], v[p, LOGARITHM + q] = w, np.log(J)
                ratio[q] += w * J
                whole[q] += w
        for q in range(LANES):
            element = LANES * e + q if LANES * e + q < len(volumes) else 0
            local, shear = min(lam[element], LOCAL * mu[element]), mu[element]
            rest, ratio[q] = lam[element] - local, ratio[q] / whole[q]
            log_ratio = np.log(ratio[q])
            energy += 0.5 * rest * whole[q] * log_ratio * log_ratio
            for p in range(points):
                w, log_J, stretch = v[p, VOLUME + q], v[p, LOGARITHM + q], v[p, STRETCH + q]
                first_term, scale = 0.5 * stretch, 1.0
                if limit < np.inf:
                    first_term, scale = -0.5 * limit * np.log(1.0 - stretch / limit), limit / (limit - stretch)
                energy += w * (shear * (first_term - log_J) + 0.5 * local * log_J * log_J)
                v[p, ALONG + q] = w * shear * scale
                v[p, ACROSS + q] = w * (shear - local * log_J - rest * log_ratio / ratio[q] * v[p, JACOBIAN + q])
        X[:] = 0.0
        for p in range(points):
            _stress(v[p])
            add_divergence(gradients, X.ctypes.data, v[p].ctypes.data, first + 8 * (e * points + p) * wide, count)
        scattered(X, nodes[e], forces)
    return energy
