"""What depends on the mesh alone: gradients at the quadrature points and the fixed sparsity pattern of the stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from femsense.arrays import FloatArray, IntArray, freeze
from femsense.fem.linear import Pattern, make_pattern
from femsense.fem.mesh import TetMesh, shape_slopes, shape_values

_A, _B = 0.5854101966249685, 0.1381966011250105
QUADRATURE = np.array([[_A, _B, _B, _B], [_B, _A, _B, _B], [_B, _B, _A, _B], [_B, _B, _B, _A]])
"""Four points of degree 2 (barycentric coordinates), equal weights (Keast 1986, rule 2)."""


@dataclass(frozen=True, eq=False, slots=True)
class Stencil:
    """Gradients, volumes and block pattern of a mesh."""

    gradients: FloatArray
    """Shape function gradients [1/m], shape (m, q, a, 3): element, quadrature point, node, direction."""
    volumes: FloatArray
    """Volume of each quadrature point [m³], shape (m, q)."""
    node_volume: FloatArray
    """∫ N dV [m³], shape (n,)."""
    slots: IntArray
    """Where the 3×3 block of nodes (a, b) of an element goes, shape (m, a, a)."""
    block_rows: IntArray
    """Block pattern in CSR: indptr, shape (n + 1,)."""
    block_columns: IntArray
    """Block pattern in CSR: indices, shape (nb,)."""


@dataclass(frozen=True, eq=False, slots=True)
class FreeMap:
    """The free unknowns in the order in which they are factorised, and where their stiffness entries stand."""

    dofs: IntArray
    """Unknowns 3·node + direction, in factor order, shape (f,)."""
    pattern: Pattern
    """Pattern of the reduced matrix."""
    source: IntArray
    """For each entry of the reduced matrix, its place in the flat block array, shape (nnz,)."""


def make_stencil(mesh: TetMesh, cliques: list[IntArray] | None = None) -> tuple[Stencil, tuple[IntArray, ...]]:
    """Return gradients, volumes and pattern of a mesh.

    Arguments:
        mesh: the mesh at rest.
        cliques: sets of nodes that are coupled beside the elements (segments of cables), arrays (s, k) of node indices.

    Returns:
        the stencil, and for each clique array the slots of its node pairs, shape (s, k, k).
    """
    quadratic = mesh.is_quadratic
    points = QUADRATURE if quadratic else np.full((1, 4), 0.25)
    slopes = shape_slopes(points, quadratic=quadratic)  # (q, a, 4)
    local = slopes[:, :, 1:] - slopes[:, :, :1]  # dN/dξ for ξ = L1..L3
    x = mesh.nodes[mesh.tets]
    jacobian = np.einsum("mac,qai->mqci", x, local)
    inverse = np.linalg.inv(jacobian)
    gradients = np.einsum("qai,mqic->mqac", local, inverse)
    volumes = np.linalg.det(jacobian) / (6.0 * len(points))
    node_volume = np.zeros(len(mesh.nodes))
    values = _moments(mesh, volumes)
    np.add.at(node_volume, mesh.tets, values)
    rows, columns, slots = _block_pattern(len(mesh.nodes), [mesh.tets, *(cliques or [])])
    stencil = Stencil(
        freeze(gradients), freeze(volumes), freeze(node_volume), slots[0], freeze(rows, np.int64), freeze(columns, np.int64)
    )
    return stencil, slots[1:]


def _moments(mesh: TetMesh, volumes: FloatArray) -> FloatArray:
    """Return ∫ N dV of each node of each element [m³], shape (m, a); exact where edges are straight."""
    if not mesh.is_quadratic:
        return np.repeat(volumes / 4.0, 4, axis=1)
    return np.asarray(np.einsum("mq,qa->ma", volumes, shape_values(QUADRATURE, quadratic=True)))


def _block_pattern(n: int, groups: list[IntArray]) -> tuple[IntArray, IntArray, tuple[IntArray, ...]]:
    """Return indptr and indices of the graph of n nodes that groups (g, k) of nodes couple, and the slots of their pairs."""
    pairs = [(group[:, :, None] * n + group[:, None, :]) for group in groups]
    keys, place = np.unique(np.concatenate([p.ravel() for p in pairs]), return_inverse=True)
    indptr = np.searchsorted(keys, np.arange(n + 1) * n)
    ends = np.cumsum([p.size for p in pairs])[:-1]
    slots = tuple(freeze(part.reshape(p.shape), np.int64) for part, p in zip(np.split(place.ravel(), ends), pairs))
    return indptr, keys % n, slots


def make_free_map(stencil: Stencil, mesh: TetMesh, fixed: IntArray) -> FreeMap:
    """Return the map from blocks to the matrix of the unknowns that are not fixed, ordered for little fill."""
    n = len(mesh.nodes)
    free_node = np.ones(n, dtype=bool)
    free_node[fixed] = False
    free_node[np.diff(stencil.block_rows) == 0] = False
    order = fill_reducing_order(stencil, np.flatnonzero(free_node))
    place = np.full(n, -1)
    place[order] = np.arange(len(order))
    rows = np.repeat(np.arange(n), np.diff(stencil.block_rows))
    keep = (place[rows] >= 0) & (place[stencil.block_columns] >= 0)
    block = np.flatnonzero(keep)
    i, j = place[rows[keep]], place[stencil.block_columns[keep]]
    ci, cj = np.divmod(np.arange(9), 3)
    matrix = sp.coo_matrix(
        ((block[:, None] * 9 + np.arange(9)).ravel() + 1, ((3 * i[:, None] + ci).ravel(), (3 * j[:, None] + cj).ravel())),
        shape=(3 * len(order), 3 * len(order)),
    ).tocsc()
    matrix.sort_indices()
    dofs = (3 * order[:, None] + np.arange(3)).ravel()
    pattern = make_pattern(freeze(matrix.indptr, np.int32), freeze(matrix.indices, np.int32))
    return FreeMap(freeze(dofs, np.int64), pattern, freeze(matrix.data - 1, np.int64))


def fill_reducing_order(stencil: Stencil, free: IntArray) -> IntArray:
    """Return the free nodes in an order of little fill (multiple minimum degree on the node graph, by SuperLU)."""
    n = len(stencil.block_rows) - 1
    graph = sp.csr_matrix((np.ones(len(stencil.block_columns)), stencil.block_columns, stencil.block_rows), shape=(n, n))
    part = graph[free][:, free]
    dominant = (part + sp.diags_array(np.asarray(part.sum(axis=1)).ravel() + 1.0)).tocsc()
    lu = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return free[np.argsort(lu.perm_c)]
