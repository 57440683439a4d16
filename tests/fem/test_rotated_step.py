"""Newton steps along which elements turn: first order, a closed form, fewer iterations to the same state."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import block_mesh

from femsense.core.pose import rotation_from_vector
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel, make_body
from femsense.fem.equilibrium import NewtonOptions, SolveOptions, solve_equilibrium
from femsense.fem.mesh import to_quadratic
from femsense.fem.rotated_step import corners_of, rotated_step
from femsense.fem.rotation import turning_compliance


def bar(quadratic: bool, *, on_an_edge: bool = False) -> BodyModel:
    mesh = block_mesh((4, 1, 1), (0.04, 0.01, 0.01))
    mesh = to_quadratic(mesh) if quadratic else mesh
    clamped = mesh.nodes[:, 0] < 1e-9
    if on_an_edge:
        clamped &= mesh.nodes[:, 1] < mesh.nodes[:, 1].min() + 1e-9
    return make_body(mesh, young_modulus=100e3, poisson_ratio=0.45, density=1000.0, clamped=clamped)


@pytest.mark.parametrize("quadratic", [False, True])
def test_a_small_step_is_the_straight_one_to_first_order(quadratic: bool) -> None:
    body = bar(quadratic)
    rng = np.random.default_rng(1)
    free = np.zeros(body.mesh.nodes.size)
    free[body.free_map.dofs] = 1.0
    x = body.mesh.nodes + 1e-3 * (free * rng.normal(size=free.size)).reshape(-1, 3)
    step = 1e-3 * (free * rng.normal(size=free.size)).reshape(-1, 3)
    apart = []
    for share in (1.0, 0.1, 0.01):
        there = rotated_step(body, x, share * step)
        assert there is not None
        assert np.abs(there[body.clamped] - x[body.clamped]).max() == 0.0
        apart.append(np.abs(there - x - share * step).max() / share**2)
    assert apart[2] == pytest.approx(apart[1], rel=0.1) and apart[2] > 0.0


@pytest.mark.parametrize("quadratic", [False, True])
def test_a_turn_about_a_hinge_is_a_rotation_without_stretch(quadratic: bool) -> None:
    body = bar(quadratic, on_an_edge=True)
    body.free_map.laplacian.append(corners_of(body))  # a hinge holds no body, but a Laplacian
    hinge, turn = body.mesh.nodes[body.clamped][0], np.array([0.0, 0.0, 0.7])
    arms = body.mesh.nodes - hinge
    there = rotated_step(body, body.mesh.nodes, np.cross(turn, arms))
    assert there is not None
    np.testing.assert_allclose(there, hinge + arms @ rotation_from_vector(turn).T, atol=1e-12)
    assert internal(body, there).energy < 1e-20


def test_where_nothing_is_clamped_there_is_no_turned_step() -> None:
    body = bar(False, on_an_edge=True)
    assert rotated_step(body, body.mesh.nodes, np.zeros_like(body.mesh.nodes)) is None


def test_an_element_that_is_shrunk_to_a_point_has_a_turning_compliance() -> None:
    found, still = np.full(6, np.nan), np.eye(3).reshape(9, 1)
    turning_compliance(np.zeros((9, 1)), still, 0, found)
    assert np.isfinite(found).all() and (found[[0, 3, 5]] > 0.0).all()
    turning_compliance(still, still, 0, found)
    np.testing.assert_allclose(found, [0.5, 0.0, 0.0, 0.5, 0.0, 0.5])  # (tr(V) I − V)⁻¹ of V = I


def test_fewer_newton_steps_lead_to_the_same_state() -> None:
    body, forces = bar(True), np.zeros((len(bar(True).mesh.nodes), 3))
    forces[body.mesh.nodes[:, 0] > 0.0399, 2] = -0.02
    turned = solve_equilibrium(body, nodal_forces=forces)
    straight = solve_equilibrium(body, nodal_forces=forces, options=SolveOptions(newton=NewtonOptions(curved=np.inf)))
    assert turned.converged and straight.converged
    np.testing.assert_allclose(turned.positions, straight.positions, atol=1e-9)
    assert turned.iterations < straight.iterations
