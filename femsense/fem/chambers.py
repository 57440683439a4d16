"""Pressure chambers: closed inner surfaces of the mesh, their volume and its derivatives.

A pressure p does the work p dV, so that a chamber adds −p V(x) to the potential: forces p dV/dx that follow the surface, and the
stiffness −p d²V/dx², symmetric because the surface is closed (Bonet & Wood, Nonlinear Continuum Mechanics, 8.5).
On a closed surface

    V = 1/3 ∮ x · n dA = Σ_faces Σ_abc T_abc x_a · (x_b × x_c),

where T is one antisymmetric tensor for all faces of a kind: exact for plane triangles and for the curved ones of 6 nodes.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel
from femsense.fem.body_parts import Chamber
from femsense.fem.cavities import _TRIPLE


def _volume_slopes(chamber: Chamber, positions: FloatArray) -> FloatArray:
    """Return 3 Σ_bc T_abc x_b × x_c of each node of each face [m²], shape (t, k, 3); positions count from the seed."""
    x = positions[chamber.faces] - chamber.seed
    first, second = np.triu_indices(x.shape[1], 1)
    across = np.cross(x[:, first], x[:, second])
    return np.asarray(6.0 * np.einsum("ap,tpc->tac", _TRIPLE[x.shape[1]][:, first, second], across))


def chamber_volume(chamber: Chamber, positions: FloatArray) -> float:
    """Return the volume that a chamber encloses [m³]."""
    x = positions[chamber.faces] - chamber.seed
    return float((_volume_slopes(chamber, positions) * x).sum()) / 3.0


def volume_gradient(chamber: Chamber, positions: FloatArray) -> FloatArray:
    """Return dV/dx [m²], shape (n, 3): the nodal forces of a pressure of one pascal."""
    gradient = np.zeros_like(positions)
    np.add.at(gradient, chamber.faces, _volume_slopes(chamber, positions))
    return gradient


def volume_changes(body: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the increase of the volume of each chamber since rest [m³], shape (c,)."""
    rest = body.mesh.nodes
    return np.array([chamber_volume(c, positions) - chamber_volume(c, rest) for c in body.chambers])


def add_pressure_stiffness(body: BodyModel, positions: FloatArray, pressures: FloatArray, blocks: FloatArray) -> None:
    """Add −p d²V/dx² of every chamber to stiffness blocks [N/m], shape (nb, 9); pressures [Pa], shape (c,).

    The block of nodes (a, b) is the cross product with one vector, linear in the positions.
    """
    for pressure, curvature in zip(pressures, body.chamber_curvature):
        if pressure != 0.0:
            w = pressure * (curvature @ positions)  # −p d²V = p [w]×
            blocks[:, [5, 6, 1]] -= w
            blocks[:, [7, 2, 3]] += w
