"""Mesh-dependent data: gradients at the quadrature points and the sparsity pattern of the stiffness."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.fem.linalg.factorization import Pattern
from femsense.fem.linalg.iterative import Level
from femsense.fem.linalg.ordering import fill_reducing_order
from femsense.fem.linalg.simd_lanes import LANES
from femsense.fem.mesh import EDGES, TetMesh, shape_slopes, shape_values

_A, _B = 0.5854101966249685, 0.1381966011250105
QUADRATURE = np.array([[_A, _B, _B, _B], [_B, _A, _B, _B], [_B, _B, _A, _B], [_B, _B, _B, _A]])
"""Four points of degree 2 (barycentric coordinates), equal weights (Keast 1986, rule 2)."""


@dataclass(frozen=True, eq=False, slots=True)
class Lanes:
    """The elements of a mesh in groups of LANES, the element being the last axis (see `in_lanes`)."""

    nodes: IntArray
    """shape (g, a, LANES)."""
    gradients: FloatArray
    """Of the shape functions [1/m], shape (g, q, 3 a, LANES)."""


@dataclass(frozen=True, eq=False, slots=True)
class Stencil:
    """Gradients, volumes and block pattern of a mesh.

    The stiffness is symmetric: only its 3×3 blocks of nodes i ≤ j are kept. A block array has one more row, at the end. Blocks i > j are added
    to that row, which is never read.
    """

    tets: IntArray
    """Nodes of each element in rising order, shape (m, a)."""
    gradients: FloatArray
    """Gradients of the shape functions of `tets` [1/m], shape (m, q, 3, a): element, quadrature point, direction, node."""
    volumes: FloatArray
    """Volume of each quadrature point [m³], shape (m, q)."""
    node_volume: FloatArray
    """∫ N dV [m³], shape (n,)."""
    slots: IntArray
    """Where the blocks of the node pairs (a ≤ b) of an element go, shape (m, a (a + 1) / 2)."""
    block_rows: IntArray
    """Block pattern in CSR: indptr, shape (n + 1,)."""
    block_columns: IntArray
    """Block pattern in CSR: indices ≥ their row, shape (nb,); the last entry is −1, for an unused row."""
    lanes: list[Lanes] = field(default_factory=list)
    """Cached result of `lanes_of`."""


@dataclass(frozen=True, eq=False, slots=True)
class FreeMap:
    """The free unknowns in the order of elimination, and the positions of their stiffness entries."""

    dofs: IntArray
    """Unknowns 3·node + direction, in factor order, shape (f,)."""
    pattern: Pattern
    """Pattern of the reduced matrix."""
    source: IntArray
    """For each entry of the reduced matrix, its place in the flat block array, shape (nnz,)."""
    laplacian: list[Any] = field(default_factory=list)
    """The factor that `rotated_step.rotated_step` needs, once it was needed (None where there is none)."""


def make_stencil(mesh: TetMesh, cliques: list[IntArray] | None = None) -> tuple[Stencil, tuple[IntArray, ...]]:
    """Return gradients, volumes and pattern of a mesh.

    Arguments:
        mesh: the mesh at rest.
        cliques: sets of nodes coupled in addition to the elements (segments of cables), arrays (s, k) of node indices.

    Returns:
        the stencil, and for each clique array the slots of its node pairs, shape (s, k, k).
    """
    tets, gradients, volumes, node_volume = _geometry(mesh)
    rows, columns, slots = _block_pattern(len(mesh.nodes), [tets, *(cliques or [])])
    first, second = np.triu_indices(tets.shape[1])
    stencil = Stencil(
        freeze(tets, np.int32),
        freeze(gradients),
        freeze(volumes),
        freeze(node_volume),
        freeze(slots[0][:, first, second], np.int32),
        freeze(rows, np.int64),
        freeze(columns, np.int64),
    )
    return stencil, slots[1:]


def reshaped(stencil: Stencil, mesh: TetMesh) -> Stencil:
    """Return the stencil of the same elements with other node positions at rest; the sparsity patterns are unchanged."""
    _, gradients, volumes, node_volume = _geometry(mesh)
    return replace(stencil, gradients=freeze(gradients), volumes=freeze(volumes), node_volume=freeze(node_volume), lanes=[])


def _geometry(mesh: TetMesh) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the sorted nodes of the elements (m, a), gradients, volumes of their quadrature points,
    and volumes of the nodes (n,)."""
    quadratic = mesh.is_quadratic
    points = QUADRATURE if quadratic else np.full((1, 4), 0.25)
    slopes = shape_slopes(points, quadratic=quadratic)  # (q, a, 4)
    local = slopes[:, :, 1:] - slopes[:, :, :1]  # dN/dξ for ξ = L1..L3
    x = mesh.nodes[mesh.tets]
    jacobian = np.einsum("mac,qai->mqci", x, local)
    inverse = np.linalg.inv(jacobian)
    order = np.argsort(mesh.tets, axis=1)
    gradients = np.take_along_axis(np.einsum("qai,mqic->mqca", local, inverse), order[:, None, None, :], axis=3)
    tets = np.take_along_axis(mesh.tets, order, axis=1)
    volumes = np.linalg.det(jacobian) / (6.0 * len(points))
    node_volume = np.zeros(len(mesh.nodes))
    values = _moments(mesh, volumes)
    np.add.at(node_volume, mesh.tets, values)
    return tets, gradients, volumes, node_volume


def in_lanes(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values of elements, shape (m, …), in groups, shape (g, …, LANES); copies of the first element fill the last group."""
    count = len(values)
    groups = -(-count // LANES)
    which = np.concatenate([np.arange(count), np.zeros(groups * LANES - count, dtype=np.int64)])
    return np.ascontiguousarray(np.moveaxis(values[which].reshape(groups, LANES, *values.shape[1:]), 1, -1))


def lanes_of(stencil: Stencil) -> Lanes:
    """Return the elements of a mesh in groups of LANES, for vector instructions."""
    if not stencil.lanes:
        m, q, _, a = stencil.gradients.shape
        gradients = in_lanes(stencil.gradients.transpose(0, 1, 3, 2).reshape(m, q, 3 * a))
        stencil.lanes.append(Lanes(freeze(in_lanes(stencil.tets), np.int32), freeze(gradients)))
    return stencil.lanes[0]


def _moments(mesh: TetMesh, volumes: FloatArray) -> FloatArray:
    """Return ∫ N dV of each node of each element [m³], shape (m, a); exact where edges are straight."""
    if not mesh.is_quadratic:
        return np.repeat(volumes / 4.0, 4, axis=1)
    return np.asarray(np.einsum("mq,qa->ma", volumes, shape_values(QUADRATURE, quadratic=True)))


def _block_pattern(n: int, groups: list[IntArray]) -> tuple[IntArray, IntArray, tuple[IntArray, ...]]:
    """Return indptr and indices of the pairs i ≤ j of n nodes that groups (g, k) of nodes couple,
    and the slots of their pairs."""
    pairs = [(group[:, :, None] * n + group[:, None, :]) for group in groups]
    below = np.concatenate([(group[:, :, None] > group[:, None, :]).ravel() for group in groups])
    flat = np.concatenate([p.ravel() for p in pairs])
    keys = np.unique(flat[~below])
    place = np.where(below, len(keys), np.searchsorted(keys, flat))
    indptr = np.searchsorted(keys, np.arange(n + 1) * n)
    ends = np.cumsum([p.size for p in pairs])[:-1]
    slots = tuple(freeze(part.reshape(p.shape), np.int64) for part, p in zip(np.split(place, ends), pairs))
    return indptr, np.append(keys % n, -1), slots


def make_free_map(stencil: Stencil, mesh: TetMesh, fixed: IntArray) -> FreeMap:
    """Return the map from blocks to the matrix of the unknowns that are not fixed, ordered for little fill."""
    n = len(mesh.nodes)
    rows = block_row_numbers(stencil)
    columns = stencil.block_columns[:-1]
    free_node = np.zeros(n, dtype=bool)
    free_node[rows], free_node[columns] = True, True
    free_node[fixed] = False
    order = fill_reducing_order(rows, columns, free_node)
    place = np.full(n, -1)
    place[order] = np.arange(len(order))
    slot = np.flatnonzero((place[rows] >= 0) & (place[columns] >= 0))
    other = slot[rows[slot] != columns[slot]]  # the same blocks seen from the other half
    i = np.concatenate([place[rows[slot]], place[columns[other]]])
    j = np.concatenate([place[columns[slot]], place[rows[other]]])
    where = np.concatenate([9 * slot, 9 * other])
    turned = np.arange(len(where)) >= len(slot)
    sort = np.lexsort((i, j))
    pattern, source = _entries(i[sort], j[sort], where[sort], turned[sort], len(order))
    dofs = (3 * order[:, None] + np.arange(3)).ravel()
    grid = Level(freeze(mesh.nodes[order]), freeze(_edge_ends(mesh, place)[order], np.int64))
    return FreeMap(freeze(dofs, np.int64), replace(pattern, grid=grid), source)


def _edge_ends(mesh: TetMesh, place: IntArray) -> IntArray:
    """Return the places of the ends of the edge that each node is in the middle of, twice its own for a corner, shape (n, 2)."""
    ends = np.column_stack([place, place])
    if mesh.is_quadratic:
        ends[mesh.tets[:, 4:]] = place[mesh.tets[:, EDGES]]
    return ends


def _entries(i: IntArray, j: IntArray, where: IntArray, turned: BoolArray, size: int) -> tuple[Pattern, IntArray]:
    """Return pattern and sources of the matrix of the 3×3 blocks (i, j), sorted by column, that begin at `where`."""
    count = np.bincount(j, minlength=size)
    first = np.concatenate([[0], np.cumsum(count)])
    rank = np.arange(len(j)) - first[j]
    r, c = np.arange(3)[:, None], np.arange(3)
    to = (9 * first[j] + 3 * rank)[:, None, None] + 3 * count[j][:, None, None] * c + r
    indices, source = np.empty(9 * len(j), dtype=np.int32), np.empty(9 * len(j), dtype=np.int32)
    indices[to] = 3 * i[:, None, None] + r + 0 * c
    source[to] = where[:, None, None] + np.where(turned[:, None, None], 3 * c + r, 3 * r + c)
    indptr = np.concatenate([[0], np.cumsum(np.repeat(3 * count, 3))])
    return Pattern(freeze(indptr, np.int32), freeze(indices, np.int32)), freeze(source, np.int32)


def block_row_numbers(stencil: Stencil) -> IntArray:
    """Return the row of each kept block, shape (nb − 1,)."""
    return np.repeat(np.arange(len(stencil.block_rows) - 1), np.diff(stencil.block_rows))
