"""Compliance: symmetric, positive, and the derivative of equilibria that are solved anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic import bar_body, relative_error
from helpers import block_mesh

from femsense.core.errors import FemsenseError, InputError
from femsense.fem.body import BodyModel
from femsense.fem.compliance import compliance, direction_rows, tangent_at, tangent_near
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import embed_points

MESH = block_mesh((4, 1, 1))
POINTS = np.array([[0.1, 0.015, 0.03], [0.07, 0.0, 0.01], [0.05, 0.02, 0.035], [0.0, 0.0, 0.0]])
DIRECTIONS = np.array([[0.0, 0, 1], [0, 1, 0], [0.6, 0, 0.8], [1, 0, 0]])
TENSION = {"top": 1.5, "side": 0.8}


def bar(law: str = "corotational", quadratic: bool = False) -> BodyModel:
    body = bar_body(MESH, law=law, quadratic=quadratic, gravity=(0, 0, -9.81))
    return body.with_material(replace(body.material, stretch_limit=5.0)) if law == "gent" else body


def moved(body: BodyModel, state: Equilibrium) -> np.ndarray:
    """Return the displacement of the points along their directions, then the shortening of the cables."""
    at = embed_points(body.mesh, POINTS)
    return np.concatenate([np.einsum("pc,pc->p", at.positions(state.positions), DIRECTIONS), list(state.shortening.values())])


def solved(body: BodyModel, start: Equilibrium, tension: dict[str, float], force: np.ndarray | None = None) -> Equilibrium:
    state = solve_equilibrium(
        body, tension=tension, nodal_forces=force, start=start, options=SolveOptions(relative_tolerance=1e-13)
    )
    assert state.converged
    return state


@pytest.mark.parametrize("law", ["corotational", "neo_hookean", "gent"])
@pytest.mark.parametrize("quadratic", [False, True])
def test_compliance_is_the_derivative_of_equilibria_solved_anew(law: str, quadratic: bool) -> None:
    body = bar(law, quadratic)
    state = solve_equilibrium(body, tension=TENSION)
    W = compliance(body, state, points=POINTS, directions=DIRECTIONS)
    at, n, h = embed_points(body.mesh, POINTS), len(body.mesh.nodes), 1e-3
    for j in range(3):  # the fourth point is clamped
        f = at[j].spread(DIRECTIONS[j : j + 1], n)
        ahead, behind = (moved(body, solved(body, state, TENSION, s * h * f)) for s in (1, -1))
        np.testing.assert_allclose(W[:, j], (ahead - behind) / (2 * h), atol=1e-5 * np.abs(W).max())
    for j, name in enumerate(body.cable_names):
        ahead, behind = (moved(body, solved(body, state, {**TENSION, name: TENSION[name] + s * h})) for s in (1, -1))
        np.testing.assert_allclose(W[:, 4 + j], (ahead - behind) / (2 * h), atol=1e-5 * np.abs(W).max())


@pytest.mark.parametrize("law", ["corotational", "neo_hookean"])
def test_compliance_is_symmetric_and_never_negative(law: str) -> None:
    body = bar(law)
    W = compliance(body, solve_equilibrium(body, tension=TENSION), points=POINTS, directions=DIRECTIONS)
    assert W.shape == (6, 6)
    np.testing.assert_array_equal(W, W.T)
    assert np.linalg.eigvalsh(W).min() > -1e-12 * np.abs(W).max()
    assert np.abs(W[3]).max() == 0.0  # a clamped point does not move


def test_small_forces_at_two_points_are_reciprocal() -> None:
    """The displacement at A by a force at B is that at B by the same force at A, found by two equilibria."""
    body = bar()
    state = solve_equilibrium(body, tension=TENSION)
    at, h = embed_points(body.mesh, POINTS), 1e-4
    answer = [
        moved(body, solved(body, state, TENSION, h * at[j].spread(DIRECTIONS[j : j + 1], len(MESH.nodes)))) - moved(body, state)
        for j in (0, 1)
    ]
    assert answer[0][1] == pytest.approx(answer[1][0], rel=1e-3)


def test_compliance_of_cables_alone_is_their_block() -> None:
    body = bar()
    state = solve_equilibrium(body, tension=TENSION)
    whole = compliance(body, state, points=POINTS, directions=DIRECTIONS)
    np.testing.assert_allclose(compliance(body, state), whole[4:, 4:], rtol=1e-10)
    same = compliance(body, state, points=POINTS, directions=DIRECTIONS, tangent=tangent_at(body, state))
    np.testing.assert_allclose(same, whole, atol=1e-12 * np.abs(whole).max())


def test_compliance_of_a_soft_clamp_at_rest_is_that_of_its_springs() -> None:
    """A rigid bar on n springs k moves along x by force / (n k)."""
    body = bar_body(MESH, young_modulus=1e12, cables=False).with_clamp_stiffness(50.0)
    W = compliance(body, solve_equilibrium(body), points=[[0.1, 0.015, 0.015]], directions=[[1.0, 0, 0]])
    assert W[0, 0] == pytest.approx(1 / (4 * 50.0), rel=1e-4)


def test_held_cables_keep_their_length_in_the_response() -> None:
    body, h = bar(), 1e-3
    wanted = solve_equilibrium(body, tension=TENSION).shortening
    state = solve_equilibrium(body, shortening=wanted, options=SolveOptions(relative_tolerance=1e-13))
    force = embed_points(body.mesh, POINTS[:1]).spread(DIRECTIONS[:1], len(MESH.nodes))
    tangent = tangent_at(body, state)
    u = tangent.respond(force[None])[0]
    ahead, behind = (
        solve_equilibrium(
            body, shortening=wanted, nodal_forces=s * h * force, start=state, options=SolveOptions(relative_tolerance=1e-13)
        ).positions
        for s in (1, -1)
    )
    assert relative_error(u, (ahead - behind) / (2 * h)) < 1e-5
    np.testing.assert_allclose(tangent.held_rows @ u.ravel()[tangent.dofs], 0.0, atol=1e-12)


@pytest.mark.parametrize("stretch", [np.inf, 500.0])
@pytest.mark.parametrize("friction", [0.0, 0.2])
def test_the_response_to_a_held_cable_is_the_derivative_of_equilibria_solved_anew(stretch: float, friction: float) -> None:
    body, h = bar_body(MESH, gravity=(0, 0, -9.81), friction=friction), 1e-6
    body = body.with_cables(tuple(replace(c, stretch_stiffness=stretch) for c in body.cables))
    wanted = {"top": 0.004, "side": 0.003}
    state = solve_equilibrium(body, shortening=wanted, options=SolveOptions(relative_tolerance=1e-13))
    assert state.held.all()
    answer = tangent_at(body, state).respond_to_held()
    for j, name in enumerate(wanted):
        ahead, behind = (
            solve_equilibrium(
                body,
                shortening={**wanted, name: wanted[name] + s * h},
                start=state,
                options=SolveOptions(before=tuple(np.zeros(len(c.path)) for c in body.cables), relative_tolerance=1e-13),
            ).positions
            for s in (1, -1)
        )
        assert relative_error(answer[j], (ahead - behind) / (2 * h)) < (1e-5 if friction == 0 else 0.02)


def test_direction_rows_map_displacements_to_those_of_points() -> None:
    rng = np.random.default_rng(0)
    at, u = embed_points(MESH, POINTS), rng.normal(0, 1, MESH.nodes.shape)
    rows = direction_rows(at, DIRECTIONS, len(MESH.nodes))
    np.testing.assert_allclose(rows @ u.ravel(), np.einsum("pc,pc->p", at.positions(u), DIRECTIONS))


def test_points_and_directions_must_fit() -> None:
    body = bar()
    with pytest.raises(InputError, match="differ in shape"):
        compliance(body, solve_equilibrium(body), points=POINTS, directions=DIRECTIONS[:2])


def test_a_body_that_nothing_holds_has_no_compliance() -> None:
    body = bar_body(MESH, clamped=False)
    with pytest.raises(FemsenseError, match="clamp more nodes"):
        compliance(body, solve_equilibrium(body))


def test_the_kept_factor_answers_about_as_a_new_one_and_an_absent_one_exactly_so() -> None:
    body = bar()
    state = solve_equilibrium(body, tension=TENSION)
    assert state.factor is not None
    force = embed_points(body.mesh, POINTS[:1]).spread(DIRECTIONS[:1], len(MESH.nodes))[None]
    exact = tangent_at(body, state).respond(force)
    assert 0.0 < relative_error(tangent_near(body, state).respond(force), exact) < 0.02
    np.testing.assert_array_equal(tangent_near(body, replace(state, factor=None)).respond(force), exact)
