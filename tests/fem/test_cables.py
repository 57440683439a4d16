"""Cables: derivatives, bends, friction of the capstan, and a cable that is a spring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic import central_gradient, relative_error
from helpers import block_mesh

from femsense.core.errors import InputError
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.body_parts import Cable
from femsense.fem.cables import (
    add_cable_stiffness,
    bend_angles,
    cable_forces,
    cable_length,
    pull_rows,
    segments,
    shortening,
)
from femsense.fem.capstan import capstan_tensions
from femsense.fem.equilibrium import SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh, to_quadratic

PATH = [[0.1, 0.03, 0.02], [0.08, 0.012, 0.028], [0.05, 0.02, 0.01], [0.03, 0.005, 0.02]]  # through several elements


def cable_body(quadratic: bool, *, friction: float = 0.0, paths: int = 2) -> BodyModel:
    mesh = block_mesh((4, 2, 2))
    mesh = to_quadratic(mesh) if quadratic else mesh
    cables = (
        tie_cable(mesh, "bent", PATH, [-0.01, 0.01, 0.03], exit_direction=[0.0, 0.0, -2.0], friction=friction),
        tie_cable(mesh, "short", [[0.1, 0.0, 0.0]], [0.0, -0.02, -0.01], friction=friction),
    )[:paths]
    return make_body(mesh, young_modulus=100e3, poisson_ratio=0.4, clamped=mesh.nodes[:, 0] < 1e-9, cables=cables)


def moved(mesh: TetMesh, seed: int = 0) -> np.ndarray:
    return mesh.nodes + np.random.default_rng(seed).normal(0, 3e-3, mesh.nodes.shape)


def capstan(before: list[float], angles: list[float], mu: float, motor: float) -> list[float]:
    """Return the tensions along a cable, going outwards, by the words of the definition."""
    result, inner = [0.0] * len(before), motor
    for j in reversed(range(len(before))):
        low, high = inner * np.exp(-mu * angles[j]), inner * np.exp(mu * angles[j])
        result[j] = low if before[j] < low else high if before[j] > high else before[j]
        inner = result[j]
    return result


# Kinematics


@pytest.mark.parametrize("quadratic", [False, True])
def test_length_is_the_sum_of_its_segments(quadratic: bool) -> None:
    body = cable_body(quadratic)
    points = np.vstack([PATH, [-0.01, 0.01, 0.03]])
    assert cable_length(body.cables[0], body.mesh.nodes) == pytest.approx(
        np.linalg.norm(np.diff(points, axis=0), axis=1).sum(), rel=1e-12
    )
    np.testing.assert_allclose(shortening(body, body.mesh.nodes), 0.0, atol=1e-15)
    directions, lengths = segments(body.cables[0], moved(body.mesh))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    assert len(lengths) == len(PATH)


@pytest.mark.parametrize("quadratic", [False, True])
def test_pull_rows_are_the_slope_of_the_shortening(quadratic: bool) -> None:
    body = cable_body(quadratic)
    x = moved(body.mesh)
    slope = central_gradient(lambda y: shortening(body, y), x, 1e-7).T
    assert relative_error(pull_rows(body, x), slope) < 1e-7


@pytest.mark.parametrize("quadratic", [False, True])
@pytest.mark.parametrize("tensions", [[2.0, 2.0, 2.0, 2.0], [0.5, 0.9, 1.7, 2.0]])
def test_geometric_stiffness_is_the_slope_of_the_cable_forces(quadratic: bool, tensions: list[float]) -> None:
    body, t = cable_body(quadratic), (np.array(tensions), np.array([0.7]))
    x, n = moved(body.mesh), len(body.mesh.nodes)
    force = lambda y: sum(cable_forces(c, y, s, n) for c, s in zip(body.cables, t)).ravel()  # noqa: E731
    wanted = -central_gradient(force, x, 1e-6)
    blocks = np.zeros((len(body.stencil.block_columns), 9))
    add_cable_stiffness(body, x, t, blocks)
    rows = np.repeat(np.arange(n), np.diff(body.stencil.block_rows))
    K = np.zeros((n, 3, n, 3))
    for row, column, block in zip(rows, body.stencil.block_columns, blocks):
        K[row, :, column] = block.reshape(3, 3)
        K[column, :, row] = block.reshape(3, 3).T
    K = K.reshape(3 * n, 3 * n)
    assert relative_error(K, wanted) < 1e-6
    assert np.linalg.eigvalsh(K).min() > -1e-9 * np.abs(K).max()  # a pulling cable only stiffens


def test_forces_of_a_cable_balance_the_pull_at_its_end() -> None:
    body = cable_body(False)
    x, cable = moved(body.mesh), body.cables[0]
    directions, _ = segments(cable, x)
    forces = cable_forces(cable, x, np.full(4, 3.0), len(x))
    np.testing.assert_allclose(forces.sum(axis=0), 3.0 * directions[-1], atol=1e-12)
    unequal = np.array([1.0, 2, 3, 4])[:, None] * directions
    at_points = unequal - np.vstack([np.zeros(3), unequal[:-1]])
    wanted = np.zeros_like(x)
    np.add.at(wanted, cable.path.nodes, cable.path.weights[:, :, None] * at_points[:, None, :])
    np.testing.assert_allclose(cable_forces(cable, x, np.array([1.0, 2, 3, 4]), len(x)), wanted, atol=1e-12)


def test_shares_scale_the_segments() -> None:
    body = cable_body(False)
    x, shares = moved(body.mesh), [np.array([0.2, 0.5, 0.8, 1.0]), np.array([0.9])]
    rows = pull_rows(body, x, shares)
    for row, cable, share in zip(rows, body.cables, shares):
        np.testing.assert_allclose(row.reshape(-1, 3), cable_forces(cable, x, share, len(x)))


# Bends and friction


def test_bends_of_a_known_path() -> None:
    mesh = block_mesh((2, 2, 2), (2.0, 2.0, 2.0))
    cable = tie_cable(
        mesh, "c", [[1.0, 2.0, 1.0], [1.0, 1.0, 1.0], [0.5, 1.0, 1.0]], [-1.0, 1.0, 1.0], exit_direction=[-1, 0, -1]
    )
    np.testing.assert_allclose(bend_angles(cable, mesh.nodes), [np.pi / 2, 0.0, np.pi / 4], atol=1e-7)
    np.testing.assert_allclose(bend_angles(replace(cable, exit_direction=None), mesh.nodes), [np.pi / 2, 0.0, 0.0], atol=1e-7)


def spring(friction: float, count: int) -> Cable:
    body = cable_body(False, friction=friction, paths=1)
    return replace(body.cables[0], path=body.cables[0].path[:count])


@pytest.mark.parametrize("seed", range(5))
def test_rubbing_is_that_of_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, angles = rng.uniform(0, 3, 4), rng.uniform(0, 2, 4)
    cable, motor = spring(0.3, 4), rng.uniform(0, 3)
    np.testing.assert_allclose(
        capstan_tensions(cable, angles, before, motor), capstan(before.tolist(), angles.tolist(), 0.3, motor), rtol=1e-12
    )


def test_pulling_loses_sticking_keeps_letting_go_gains() -> None:
    cable, angles = spring(0.5, 1), np.array([1.2])
    loss = np.exp(-0.5 * 1.2)
    up = capstan_tensions(cable, angles, np.zeros(1), 2.0)
    assert up[0] == pytest.approx(2.0 * loss)
    assert capstan_tensions(cable, angles, up, 2.0 * loss**1.5)[0] == up[0]  # inside the band: nothing moves
    assert capstan_tensions(cable, angles, up, 0.5)[0] == pytest.approx(0.5 / loss)  # slides back
    assert capstan_tensions(cable, angles, up, 0.0)[0] == 0.0


def test_without_friction_the_tension_is_the_same_everywhere() -> None:
    np.testing.assert_array_equal(capstan_tensions(spring(0.0, 4), np.full(4, 1.0), np.array([3.0, 0, 1, 9]), 2.0), 2.0)


def test_friction_and_shape_rest_together() -> None:
    body = cable_body(False, friction=0.4)
    before = tuple(np.zeros(len(c.path)) for c in body.cables)
    state = solve_equilibrium(body, tension={"bent": 2.0, "short": 0.5})
    assert state.converged
    for cable, found, motor, past in zip(body.cables, state.segment_tensions, state.tension.values(), before):
        angles = bend_angles(cable, state.positions)
        np.testing.assert_allclose(found, capstan(past.tolist(), angles.tolist(), 0.4, motor), rtol=1e-8)
    assert state.segment_tensions[0][0] < 0.7 * 2.0


def test_friction_remembers_the_direction_of_motion() -> None:
    body = cable_body(False, friction=0.4)
    up = solve_equilibrium(body, tension={"bent": 1.0})
    high = solve_equilibrium(body, tension={"bent": 2.0}, start=up)
    down = solve_equilibrium(body, tension={"bent": 1.0}, start=high)
    assert up.converged and high.converged and down.converged
    assert (down.segment_tensions[0] > up.segment_tensions[0] * 1.1).all()
    again = solve_equilibrium(
        body, tension={"bent": 1.0}, start=down, options=SolveOptions(before=tuple(np.zeros(len(c.path)) for c in body.cables))
    )
    np.testing.assert_allclose(again.positions, up.positions, atol=1e-8)


def test_a_held_cable_with_friction_keeps_its_length() -> None:
    body = cable_body(False, friction=0.3)
    state = solve_equilibrium(body, shortening={"bent": 0.005})
    assert state.converged and state.shortening["bent"] == pytest.approx(0.005, abs=1e-11)
    angles = bend_angles(body.cables[0], state.positions)
    np.testing.assert_allclose(
        state.segment_tensions[0], capstan([0.0] * 4, angles.tolist(), 0.3, state.tension["bent"]), rtol=1e-7
    )


def test_a_body_without_friction_forgets_the_losses_of_its_start() -> None:
    rubbing = solve_equilibrium(cable_body(False, friction=0.3), tension={"bent": 2.0})
    assert np.ptp(rubbing.segment_tensions[0]) > 0.05
    cold = solve_equilibrium(cable_body(False), tension={"bent": 2.0})
    warm = solve_equilibrium(cable_body(False), tension={"bent": 2.0}, start=rubbing)
    np.testing.assert_allclose(warm.positions, cold.positions, atol=1e-9)
    held_still = solve_equilibrium(
        cable_body(False), tension={"bent": 2.0}, options=SolveOptions(along=tuple(t / 2.0 for t in rubbing.segment_tensions))
    )
    np.testing.assert_allclose(held_still.segment_tensions[0], rubbing.segment_tensions[0], rtol=1e-9)


# A cable that is a spring


def test_a_stretching_cable_shortens_by_its_command_less_its_stretch() -> None:
    body = cable_body(False)
    soft = body.with_cables((replace(body.cables[0], stretch_stiffness=400.0), body.cables[1]))
    state = solve_equilibrium(soft, shortening={"bent": 0.006})
    assert state.converged and state.tension["bent"] > 0
    assert state.shortening["bent"] + state.tension["bent"] / 400.0 == pytest.approx(0.006, abs=1e-11)
    stiff = solve_equilibrium(body, shortening={"bent": 0.006})
    assert state.tension["bent"] < stiff.tension["bent"]
    same = solve_equilibrium(body, tension={"bent": state.tension["bent"]})
    np.testing.assert_allclose(same.positions, state.positions, atol=1e-9)


# Failures


def test_an_exit_direction_without_length_is_refused() -> None:
    with pytest.raises(InputError, match="exit_direction of cable c"):
        tie_cable(block_mesh((1, 1, 1)), "c", PATH, [0, 0, 0], exit_direction=[0, 0, 0])


def test_the_cables_of_a_body_are_named() -> None:
    body = cable_body(False)
    assert body.cable_names == ("bent", "short")
    np.testing.assert_allclose(body.cables[0].exit_direction, [0, 0, -1])
