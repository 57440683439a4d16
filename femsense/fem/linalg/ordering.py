# mypy: allow-untyped-decorators
"""Elimination orders with little fill, and their cost."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from femsense.core.arrays import BoolArray, IntArray
from femsense.core.kernels import njit

# --- analysis ------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _elimination_tree(indptr: IntArray, indices: IntArray) -> IntArray:
    n = len(indptr) - 1
    parent, ancestor = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for j in range(n):
        for p in range(indptr[j], indptr[j + 1]):
            i = indices[p]
            while i != -1 and i < j:
                above = ancestor[i]
                ancestor[i] = j
                if above == -1:
                    parent[i] = j
                i = above
    return parent


@njit(cache=True)
def _structures(indptr: IntArray, indices: IntArray, parent: IntArray) -> tuple[IntArray, IntArray]:
    """Return the rows below the diagonal of each column of the factor, as indptr and indices (sorted)."""
    n = len(parent)
    start = np.zeros(n + 1, np.int64)
    rows = np.empty(8 * len(indices) + 64, np.int64)
    mark = np.full(n, -1, np.int64)
    head, follow = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    end = 0
    for j in range(n):
        if end + n - j > len(rows):
            more = np.empty(2 * len(rows) + n, np.int64)
            for p in range(end):
                more[p] = rows[p]
            rows = more
        mark[j] = j
        for p in range(indptr[j], indptr[j + 1]):
            i = indices[p]
            if i > j and mark[i] != j:
                mark[i] = j
                rows[end] = i
                end += 1
        child = np.int64(head[j])
        while child != -1:
            for p in range(start[child], start[child + 1]):
                i = rows[p]
                if mark[i] != j:
                    mark[i] = j
                    rows[end] = i
                    end += 1
            child = follow[child]
        start[j + 1] = end
        if parent[j] != -1:
            follow[j] = head[parent[j]]
            head[parent[j]] = j
    return start, _sorted(start, rows, n)


@njit(cache=True)
def _sorted(start: IntArray, rows: IntArray, n: int) -> IntArray:
    """Return the rows of each column in rising order: column by column to their rows, then row by row back to their columns."""
    end = start[n]
    begin, columns, ordered = np.zeros(n + 1, np.int64), np.empty(end, np.int64), np.empty(end, np.int64)
    for p in range(end):
        begin[rows[p] + 1] += 1
    for i in range(n):
        begin[i + 1] += begin[i]
    place = begin.copy()
    for j in range(n):
        for p in range(start[j], start[j + 1]):
            columns[place[rows[p]]] = j
            place[rows[p]] += 1
    place = start.copy()
    for i in range(n):
        for p in range(begin[i], begin[i + 1]):
            ordered[place[columns[p]]] = i
            place[columns[p]] += 1
    return ordered


WORTH_PEELING = 10_000
"""Number of free nodes from which on minimum degree is not tried if METIS is installed: SuperLU takes a second for that order, and minutes
on huge meshes. With 19 000 to 58 000 nodes, nested dissection halved the work on a solid bar and on thin limbs (`body.py orders`)."""
WORTH_CUTTING = 500
"""Number of nodes below which nested dissection is not tried: a factor then takes a millisecond in any order."""


def fill_reducing_order(rows: IntArray, columns: IntArray, free: BoolArray) -> IntArray:
    """Return the free nodes in an order of little fill for the couplings rows–columns.

    It is the cheaper one of multiple minimum degree (by SuperLU) and, if METIS is installed, nested dissection, which suits thick bodies.
    """
    n = len(free)
    upper = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    nodes = np.flatnonzero(free)
    graph = sp.csr_matrix((upper + upper.T)[nodes][:, nodes])
    orders = nested_dissection(graph)
    if len(nodes) < WORTH_PEELING or not orders:
        orders.insert(0, minimum_degree(graph))
    best = min(orders, key=lambda order: elimination_work(graph, order)) if len(orders) > 1 else orders[0]
    return np.asarray(nodes[best])


def minimum_degree(graph: sp.csr_matrix) -> IntArray:
    """Return the nodes of a symmetric graph by multiple minimum degree, shape (n,)."""
    dominant = (graph + sp.diags_array(np.asarray(graph.sum(axis=1)).ravel() + 1.0)).tocsc()
    lu = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(np.argsort(lu.perm_c))


def nested_dissection(graph: sp.csr_matrix, *, worth_cutting: int = WORTH_CUTTING) -> list[IntArray]:
    """Return the order of METIS; none for few nodes, and none if nodes without neighbours exist, because METIS crashes on them.

    Arguments:
        graph: not 0 for coupled nodes, shape (n, n).
        worth_cutting: smallest number of nodes.
    """
    between = sp.csr_matrix(graph - sp.diags_array(graph.diagonal()))
    between.eliminate_zeros()
    if graph.shape[0] < worth_cutting or (np.diff(between.indptr) == 0).any():
        return []
    try:
        import pymetis
    except ImportError:
        return []
    neighbours = pymetis.CSRAdjacency(between.indptr, between.indices)
    return [np.asarray(pymetis.nested_dissection(adjacency=neighbours)[0], np.int64)]


def elimination_work(graph: sp.csr_matrix, order: IntArray) -> float:
    """Return the multiplications of a factor of some nodes of a symmetric graph in an order: Σ (entries of a column)²."""
    part = graph[order][:, order].tocsc()
    part.sort_indices()
    indptr, indices = part.indptr.astype(np.int64), part.indices.astype(np.int64)
    start, _ = _structures(indptr, indices, _elimination_tree(indptr, indices))
    return float((np.diff(start + np.arange(len(start))).astype(np.float64) ** 2).sum())
