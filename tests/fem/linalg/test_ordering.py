"""Orders of elimination: their work, and the one with less of it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from helpers import block_mesh

from femsense.fem.linalg.ordering import elimination_work, fill_reducing_order, minimum_degree, nested_dissection
from femsense.fem.mesh import TetMesh


def pairs_of(mesh: TetMesh) -> np.ndarray:
    return np.unique(np.sort(mesh.tets[:, [0, 1, 0, 2, 0, 3, 1, 2, 1, 3, 2, 3]].reshape(-1, 2), axis=1), axis=0)


def graph_of(mesh: TetMesh) -> sp.csr_matrix:
    pairs = pairs_of(mesh)
    upper = sp.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(mesh.nodes),) * 2)
    return (upper + upper.T).tocsr()


def order_of(mesh: TetMesh) -> np.ndarray:
    pairs = pairs_of(mesh)
    return fill_reducing_order(pairs[:, 0], pairs[:, 1], np.ones(len(mesh.nodes), dtype=bool))


def test_the_work_of_an_order_is_that_of_a_dense_factor() -> None:
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


def test_a_solid_is_cut_and_a_thin_bar_is_peeled() -> None:
    pytest.importorskip("pymetis")
    solid, bar = block_mesh((14, 14, 14)), block_mesh((160, 2, 2))
    for mesh, share in ((solid, 0.8), (bar, 1.0)):
        graph, order = graph_of(mesh), order_of(mesh)
        assert sorted(order) == list(range(len(mesh.nodes)))
        assert elimination_work(graph, order) <= share * elimination_work(graph, minimum_degree(graph))


def test_small_meshes_and_lone_nodes_are_left_to_minimum_degree() -> None:
    alone = sp.csr_matrix((5, 5))
    assert nested_dissection(alone, worth_cutting=3) == []
    chain = sp.diags_array([1.0, 1.0], offsets=[-1, 1], shape=(5, 5)).tocsr()
    assert sorted(nested_dissection(chain, worth_cutting=3)[0]) == list(range(5))
    assert nested_dissection(chain[:2][:, :2], worth_cutting=3) == []
