"""Orders of elimination: separators that separate with the fewest nodes, and less work on solid bodies."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from helpers import block_mesh

from femsense.fem import dissection
from femsense.fem.cholesky import elimination_work, minimum_degree
from femsense.fem.dissection import dissected, elimination_order
from femsense.fem.mesh import TetMesh


def graph_of(mesh: TetMesh) -> sp.csr_matrix:
    pairs = np.unique(np.sort(mesh.tets[:, [0, 1, 0, 2, 0, 3, 1, 2, 1, 3, 2, 3]].reshape(-1, 2), axis=1), axis=0)
    upper = sp.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(mesh.nodes),) * 2)
    return (upper + upper.T).tocsr()


def test_the_halves_are_not_joined_and_no_node_is_spared(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = block_mesh((8, 5, 4))
    graph = graph_of(mesh)
    monkeypatch.setattr(dissection, "CUTS", (0.5,))
    low, high, between = dissection._halves(graph, mesh.nodes)
    assert sorted([*low, *high, *between]) == list(range(len(mesh.nodes)))
    assert graph[low][:, high].nnz == 0
    assert len(between) == 6 * 5  # one layer of the 9 × 6 × 5 nodes
    assert abs(len(low) - len(high)) <= 2 * 30


def test_a_separator_is_a_smallest_cover() -> None:
    """Random bipartite graphs against all subsets."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        across = np.triu(rng.random((8, 8)) < 0.35, 1)
        across[:4, :4] = across[4:, 4:] = False
        graph = sp.csr_matrix((across | across.T).astype(float))
        found = dissection._separator(graph, np.arange(8) < 4)
        edges = np.argwhere(across)
        sizes = [bin(s).count("1") for s in range(256) if all(s >> a & 1 or s >> b & 1 for a, b in edges)]
        assert len(found) == min(sizes) and all(a in found or b in found for a, b in edges)


def test_work_is_that_of_a_dense_factor() -> None:
    """Against the pattern of a factor eliminated one by one."""
    graph = graph_of(block_mesh((3, 2, 2)))
    order = minimum_degree(graph)
    filled = graph.toarray()[np.ix_(order, order)] != 0
    work = 0
    for k in range(len(filled)):
        below = k + 1 + np.flatnonzero(filled[k + 1 :, k])
        filled[np.ix_(below, below)] = True
        work += (1 + len(below)) ** 2
    assert elimination_work(graph, order) == work


def test_a_solid_is_dissected_and_a_thin_bar_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dissection, "LITTLE_WORK", 0.0)
    for cells, solid in (((16, 16, 16), True), ((200, 1, 1), False)):
        mesh = block_mesh(cells, cells)
        graph, free = graph_of(mesh), np.ones(len(mesh.nodes), dtype=bool)
        free[:10] = False
        upper = sp.triu(graph).tocoo()
        order = elimination_order(upper.row, upper.col, free, mesh.nodes)
        assert np.array_equal(np.sort(order), np.flatnonzero(free))
        nodes = np.flatnonzero(free)
        degree = elimination_work(graph, nodes[minimum_degree(graph[nodes][:, nodes])])
        assert (elimination_work(graph, order) < 0.7 * degree) == solid and elimination_work(graph, order) <= degree


def test_nodes_in_one_place_are_ordered_too() -> None:
    graph = sp.csr_matrix(np.ones((500, 500)) - np.eye(500))
    assert np.array_equal(np.sort(dissected(graph, np.zeros((500, 3)))), np.arange(500))
