"""Elastic energy of each element of a deformed body."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel


def energy_density(body: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the energy density μ E:E + λ/2 (tr E)² of each element [J/m³], shape (m,), the mean over its volume.

    E = (FᵀF − I)/2 is Green's strain: the density is that of St Venant and Kirchhoff,
    which a rigid motion does not change and to which all laws of the package go at small strains.

    Arguments:
        body: its mesh at rest and its moduli.
        positions: node positions [m], shape (n, 3).
    """
    stencil = body.stencil
    F = np.einsum("mai,mqca->mqic", positions[stencil.tets], stencil.gradients)
    strain = 0.5 * (np.swapaxes(F, 2, 3) @ F - np.eye(3))
    mu, lam = (v[:, None] for v in body.material.lame())
    density = mu * np.sum(strain**2, axis=(2, 3)) + 0.5 * lam * np.trace(strain, axis1=2, axis2=3) ** 2
    return np.asarray(np.average(density, axis=1, weights=stencil.volumes))
