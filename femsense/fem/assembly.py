# mypy: allow-untyped-decorators
"""Internal energy, forces and stiffness of a body, and the reduced sparse matrix of its free unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, IntArray, read_only
from femsense.core.kernels import njit
from femsense.fem.body import BodyModel
from femsense.fem.clamp import add_followers, clamp_energy_and_forces, followers_of, ties_of
from femsense.fem.corotational import corotational_tet4, corotational_tet10, stretched_tet10
from femsense.fem.corotational_lanes import corotational_forces
from femsense.fem.hyperelastic import hyperelastic_tet4, hyperelastic_tet10
from femsense.fem.hyperelastic_lanes import hyperelastic_forces
from femsense.fem.stencil import block_row_numbers, lanes_of

KERNELS = {
    ("corotational", 4): corotational_tet4,
    ("corotational", 10): corotational_tet10,
    ("hyperelastic", 4): hyperelastic_tet4,
    ("hyperelastic", 10): hyperelastic_tet10,
}
FORCES = {"corotational": corotational_forces, "hyperelastic": hyperelastic_forces}
"""Kernels for forces without stiffness."""


@dataclass(frozen=True, eq=False, slots=True)
class Internal:
    """Internal energy and its derivatives at one configuration."""

    energy: float
    """[J]; inf where an element is inverted (hyperelastic laws)."""
    forces: FloatArray
    """dW/dx [N], shape (n, 3)."""
    blocks: FloatArray | None
    """d²W/dx² [N/m], shape (nb, 9), in the stencil's pattern (one half of it); None if not asked for."""


def internal(
    body: BodyModel,
    positions: FloatArray,
    *,
    tangent: bool = True,
    room: FloatArray | None = None,
    stretch: FloatArray | None = None,
) -> Internal:
    """Return internal energy [J], nodal forces [N] and, if `tangent`, stiffness blocks [N/m] of a body at node positions [m], shape (n, 3).

    The clamp's springs, where the body has them, belong to it; of a plate that turns, the blocks hold the sparse part only
    (see `clamp.with_turning_plate`). `room`, an array (nb, 9), takes the blocks; it may be of single precision.
    `stretch`, for corotational elements of ten nodes,
    keeps the stress of one state for the stiffness of another (`stretched_tet10`).
    """
    stencil, material = body.stencil, body.material
    mu, lam = material.lame()
    forces = np.zeros_like(body.mesh.nodes)
    blocks = np.zeros((len(stencil.block_columns) if tangent else 0, 9)) if room is None else room
    blocks[:] = 0.0
    law = "corotational" if material.law == "corotational" else "hyperelastic"
    limit = material.stretch_limit if material.law == "gent" else np.inf
    x = read_only(positions)
    mesh = x, stencil.tets, stencil.gradients, stencil.volumes, mu, lam
    if stretch is None and not tangent:
        lanes = lanes_of(stencil)
        energy = FORCES[law](x, lanes.nodes, lanes.gradients, stencil.volumes, mu, lam, limit, forces)
    elif stretch is None:
        energy = KERNELS[law, body.mesh.tets.shape[1]](*mesh, limit, tangent, stencil.slots, forces, blocks)
    else:
        energy = stretched_tet10(*mesh, tangent, stencil.slots, forces, blocks, stretch)
    ties = ties_of(body)
    if ties is not None:
        extra, slopes = clamp_energy_and_forces(body, ties, positions)
        energy += extra
        forces[ties.nodes] += slopes
        if tangent:
            blocks[np.ix_(diagonal_slots(body)[ties.nodes], np.array([0, 4, 8]))] += ties.stiffness
    followers = followers_of(body)
    if followers is not None:
        energy += add_followers(followers, positions, forces, blocks if tangent else None)
    return Internal(float(energy), forces, blocks if tangent else None)


def element_forces(body: BodyModel, positions: FloatArray) -> FloatArray:
    """Return the internal forces of each element [N], shape (m, k, 3); in every law they are proportional to its modulus."""
    stencil, material = body.stencil, body.material
    mu, lam = material.lame()
    x = read_only(positions[stencil.tets].reshape(-1, 3))
    apart = np.arange(stencil.tets.size).reshape(stencil.tets.shape)
    forces = np.zeros_like(x)
    kernel = KERNELS["corotational" if material.law == "corotational" else "hyperelastic", body.mesh.tets.shape[1]]
    limit = material.stretch_limit if material.law == "gent" else np.inf
    mesh = x, apart, stencil.gradients, stencil.volumes, mu, lam
    kernel(*mesh, limit, False, stencil.slots, forces, np.zeros((0, 9)))
    return forces.reshape(*apart.shape, 3)


@njit(cache=True, nogil=True)
def add_elements(tets: IntArray, forces: FloatArray, weights: FloatArray, total: FloatArray) -> None:
    """Add the forces of elements (m, k, 3), each times its weight (m,), to nodal forces (n, 3)."""
    for e in range(len(tets)):
        if weights[e] != 0.0:
            for a in range(tets.shape[1]):
                for i in range(3):
                    total[tets[e, a], i] += weights[e] * forces[e, a, i]


def diagonal_slots(body: BodyModel) -> IntArray:
    """Return the slot of the diagonal block of every node, shape (n,)."""
    rows = block_row_numbers(body.stencil)
    slots = np.zeros(len(body.mesh.nodes), dtype=np.int64)
    on = np.flatnonzero(rows == body.stencil.block_columns[:-1])
    slots[rows[on]] = on
    return slots


def reduced_values(body: BodyModel, blocks: FloatArray) -> FloatArray:
    """Return the stiffness entries of the free unknowns [N/m], shape (nnz,), in the order of the free map's pattern."""
    values = np.empty(len(body.free_map.source))  # NumPy asks for large pages, a kernel would not: half the time
    _gather(blocks.ravel(), body.free_map.source, values)
    return values


@njit(cache=True, nogil=True)
def _gather(values: FloatArray, source: IntArray, result: FloatArray) -> None:
    for k in range(len(source)):
        result[k] = values[source[k]]


def reduced_matrix(body: BodyModel, blocks: FloatArray) -> sp.csc_matrix:
    """Return the stiffness of the free unknowns [N/m], shape (f, f), in factor order."""
    pattern = body.free_map.pattern
    return sp.csc_matrix((reduced_values(body, blocks), pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
