"""Linear tetrahedra that make a body too stiff."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from analytic import bar_body
from helpers import block_mesh

from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import surface_triangles, vertex_normals
from femsense.model.linear_elements import excess_stiffness, warn_of_linear_elements
from femsense.model.robot import spread_features


def body(cells: tuple[int, int, int], *, quadratic: bool = False) -> BodyModel:
    return bar_body(block_mesh(cells), quadratic=quadratic, cables=False)


def test_what_quadratic_elements_move_farther_is_what_equilibria_say() -> None:
    coarse, fine = body((6, 2, 2)), body((6, 2, 2), quadratic=True)
    nodes = spread_features(coarse, 8)
    normals = vertex_normals(coarse.mesh.nodes, surface_triangles(coarse.mesh))[nodes]
    ratios = []
    for node, normal in zip(nodes, normals):
        moves = []
        for one in (coarse, fine):
            forces = np.zeros_like(one.mesh.nodes)
            forces[node] = -1e-5 * normal
            moves.append((solve_equilibrium(one, nodal_forces=forces).positions - one.mesh.nodes)[: len(coarse.mesh.nodes)])
        ratios.append((moves[0] * moves[1]).sum() / (moves[0] ** 2).sum() - 1.0)
    assert excess_stiffness(coarse) == pytest.approx(np.median(ratios), rel=1e-3)
    assert excess_stiffness(coarse) > 0.3


def test_a_finer_mesh_is_less_too_stiff_and_a_quadratic_one_not_at_all() -> None:
    assert excess_stiffness(body((12, 4, 4))) < 0.6 * excess_stiffness(body((6, 2, 2)))
    assert excess_stiffness(body((6, 2, 2), quadratic=True)) == 0.0


def test_it_is_said_where_it_matters() -> None:
    with pytest.warns(UserWarning, match="linear tetrahedra make this body too stiff"):
        warn_of_linear_elements(body((6, 2, 2)), where="bar")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_linear_elements(body((6, 2, 2), quadratic=True), where="bar")
