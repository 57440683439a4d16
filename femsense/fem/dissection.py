"""Orders of elimination: the cheaper of minimum degree and nested dissection for the graph of a mesh.

Minimum degree is the better one on thin limbs, dissection on solid bodies, where it leaves a quarter of the work. A part is cut in two
through the middle of its length; the fewest nodes that touch every edge across the cut (a minimum vertex cover, König 1931) separate
the halves and are eliminated after them (George 1973). Parts of `LEAF` nodes are left to minimum degree.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import maximum_bipartite_matching

from femsense.arrays import BoolArray, FloatArray, IntArray
from femsense.fem.cholesky import elimination_work, fill_reducing_order, minimum_degree

LEAF = 400
LITTLE_WORK = 1e8
"""Orders that cost less than so many multiplications of 3 × 3 blocks are not looked at twice."""
CUTS = (0.42, 0.46, 0.5, 0.54, 0.58)
"""Shares of the nodes on one side of the cuts that are tried."""
LONG = 0.6
"""Cuts across the other axes of a part are tried too where it is this long there, over its length."""


def elimination_order(rows: IntArray, columns: IntArray, free: BoolArray, places: FloatArray) -> IntArray:
    """Return the free nodes in an order of little work.

    Arguments:
        rows, columns: couplings between nodes, each once, shapes (k,).
        free: which nodes are eliminated, shape (n,).
        places: of the nodes at rest [m], shape (n, 3).
    """
    order = fill_reducing_order(rows, columns, free)
    graph = sp.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(free), len(free)))
    graph = (graph + graph.T).tocsr()
    work = elimination_work(graph, order)
    if work < LITTLE_WORK:
        return order
    nodes = np.flatnonzero(free)
    other = nodes[dissected(graph[nodes][:, nodes], places[nodes])]
    return other if elimination_work(graph, other) < work else order


def dissected(graph: sp.csr_matrix, places: FloatArray) -> IntArray:
    """Return the nodes of a symmetric graph by nested dissection, shape (n,); places (n, 3)."""
    if len(places) <= LEAF:
        return minimum_degree(graph)
    low, high, between = _halves(graph, places)
    parts = [part[dissected(graph[part][:, part], places[part])] for part in (low, high) if len(part)]
    return np.concatenate([*parts, between])


def _halves(graph: sp.csr_matrix, places: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the nodes of two parts of like size that nothing joins, and those between."""
    centred = places - places.mean(axis=0)
    _, lengths, axes = np.linalg.svd(centred, full_matrices=False)
    best, least = None, np.inf
    for axis in axes[lengths >= LONG * lengths[0]]:
        along = centred @ axis
        for share, limit in zip(CUTS, np.quantile(along, CUTS)):
            lower = along < limit
            between = _separator(graph, lower)
            size = len(between) * (1.0 + 8.0 * (share - 0.5) ** 2)
            if lower.any() and size < least:
                best, least = (lower, between), size
    if best is None:  # all nodes in one place
        best = np.arange(len(places)) < len(places) // 2, np.arange(len(places))
    lower, between = best
    inner = np.ones(len(places), dtype=bool)
    inner[between] = False
    return np.flatnonzero(inner & lower), np.flatnonzero(inner & ~lower), between


def _separator(graph: sp.csr_matrix, lower: BoolArray) -> IntArray:
    """Return the fewest nodes that every edge between the lower and the upper nodes has one of."""
    low, high = np.flatnonzero(lower), np.flatnonzero(~lower)
    across = graph[low][:, high]
    low, high = low[np.diff(across.indptr) > 0], high[np.unique(across.indices)]
    across = graph[low][:, high]
    partner = maximum_bipartite_matching(across, perm_type="column")
    mate = np.full(len(high), -1)
    mate[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    reached_low, reached_high = partner < 0, np.zeros(len(high), dtype=bool)
    front = np.flatnonzero(reached_low)
    while len(front):  # along edges upwards, along the matching down again
        up = np.unique(across[front].indices)
        up = up[~reached_high[up]]
        reached_high[up] = True
        front = mate[up]
        reached_low[front] = True
    return np.concatenate([low[~reached_low], high[reached_high]])
