"""Static equilibrium: certificates, work, held cables, scale laws, and what happens where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic import bar_body
from helpers import block_mesh

from femsense.core.errors import InputError
from femsense.core.work import counting
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.cables import cable_forces
from femsense.fem.equilibrium import ADVICE, Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh
from femsense.fem.newton_state import NewtonOptions

MESH = block_mesh((4, 1, 1))
LAWS = ("corotational", "neo_hookean", "gent")


def bar(
    law: str = "corotational", *, quadratic: bool = False, mesh: TetMesh = MESH, gravity: tuple[float, ...] = (0.0, 0.0, -9.81)
) -> BodyModel:
    body = bar_body(mesh, law=law, quadratic=quadratic, gravity=gravity)
    return body.with_material(replace(body.material, stretch_limit=5.0)) if law == "gent" else body


def unbalanced(body: BodyModel, state: Equilibrium) -> float:
    """Return the largest unbalanced nodal force [N], put together anew."""
    force = body.dead_load() + state.nodal_forces - internal(body, state.positions).forces
    for cable, tensions in zip(body.cables, state.segment_tensions):
        force = force + cable_forces(cable, state.positions, tensions, len(force))
    free = np.ones(len(force), dtype=bool)
    free[body.clamped] = False
    return float(np.linalg.norm(force[free], axis=1).max())


# Certificates


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("quadratic", [False, True])
def test_forces_balance_and_the_clamp_holds(law: str, quadratic: bool) -> None:
    body = bar(law, quadratic=quadratic)
    state = solve_equilibrium(body, tension={"top": 1.5}, shortening={"side": 0.004})
    assert state.converged and state.advice == ADVICE["converged"]
    assert unbalanced(body, state) == pytest.approx(state.residual_n, abs=1e-12)
    assert unbalanced(body, state) < 1e-7
    np.testing.assert_array_equal(state.positions[body.clamped], body.mesh.nodes[body.clamped])
    assert state.tension["top"] == 1.5 and state.shortening["side"] == pytest.approx(0.004, abs=1e-11)


def test_with_friction_the_reported_residual_is_that_of_the_state() -> None:
    body = bar_body(MESH, friction=0.4)
    first = solve_equilibrium(body, tension={"side": 1.0})
    for state in (
        first,
        solve_equilibrium(body, tension={"top": 0.5, "side": 1.5}, start=first, options=SolveOptions(reuse_factor=True)),
    ):
        assert state.residual_n < 1e-7
        assert unbalanced(body, state) == pytest.approx(state.residual_n, abs=1e-12)


@pytest.mark.parametrize("law", LAWS)
def test_warm_and_cold_starts_meet(law: str) -> None:
    body = bar(law)
    cold = solve_equilibrium(body, tension={"top": 2.0, "side": 1.0})
    other = solve_equilibrium(body, tension={"side": 3.0})
    for reuse in (False, True):
        warm = solve_equilibrium(body, tension={"top": 2.0, "side": 1.0}, start=other, options=SolveOptions(reuse_factor=reuse))
        np.testing.assert_allclose(warm.positions, cold.positions, atol=1e-9)
    again = solve_equilibrium(body, tension={"top": 2.0, "side": 1.0}, start=cold)
    assert again.iterations <= 1


def test_a_free_standing_body_at_rest_needs_no_step() -> None:
    state = solve_equilibrium(bar(gravity=(0, 0, 0)))
    assert state.converged and state.iterations == 0
    np.testing.assert_array_equal(state.positions, MESH.nodes)


@pytest.mark.parametrize("law", LAWS)
def test_work_of_the_load_is_the_stored_energy(law: str) -> None:
    """∫ F · du along the loading path, by Simpson's rule."""
    body, P = bar(law, gravity=(0, 0, 0)), np.zeros_like(MESH.nodes)
    P[np.argmax(MESH.nodes.sum(axis=1))] = [0.3, -0.2, -0.4]
    shares = np.linspace(0, 1, 9)
    states: list[Equilibrium] = []
    for s in shares:
        states.append(solve_equilibrium(body, nodal_forces=s * P, start=states[-1] if states else None))
    along = np.array([(P * s.positions).sum() for s in states])
    slope = np.gradient(along, shares, edge_order=2)  # du/ds · P
    work = np.trapezoid(shares * slope, shares)
    energy = internal(body, states[-1].positions).energy
    assert work == pytest.approx(energy, rel=0.01)
    # F(s) u'(s) integrated by parts is exact in the end points: s·u − ∫ u ds
    simpson = np.ones(9)
    simpson[1:-1:2], simpson[2:-1:2] = 4, 2
    exact = along[-1] - float(simpson @ along) / 24
    assert exact == pytest.approx(energy, rel=1e-4)


def test_small_loads_superpose_and_double() -> None:
    body = bar(gravity=(0, 0, 0))
    rng = np.random.default_rng(0)
    a, b = 1e-5 * rng.normal(0, 1, (2, *MESH.nodes.shape))

    def move(forces: np.ndarray) -> np.ndarray:
        options = SolveOptions(relative_tolerance=1e-13)
        return solve_equilibrium(body, nodal_forces=forces, options=options).positions - MESH.nodes

    np.testing.assert_allclose(move(a + b), move(a) + move(b), atol=1e-4 * np.abs(move(a)).max())
    np.testing.assert_allclose(move(2 * a), 2 * move(a), atol=1e-4 * np.abs(move(a)).max())


# Invariance


def test_the_order_of_nodes_and_elements_does_not_matter() -> None:
    rng = np.random.default_rng(1)
    order = rng.permutation(len(MESH.nodes))  # new → old
    place = np.argsort(order)
    shuffled = TetMesh(MESH.nodes[order], place[MESH.tets][rng.permutation(len(MESH.tets))])
    a = solve_equilibrium(bar(), tension={"top": 2.0, "side": 0.5})
    b = solve_equilibrium(bar(mesh=shuffled), tension={"top": 2.0, "side": 0.5})
    np.testing.assert_allclose(b.positions[place], a.positions, atol=1e-9)
    np.testing.assert_allclose(list(b.shortening.values()), list(a.shortening.values()), atol=1e-10)


@pytest.mark.parametrize("scale", [1e-2, 30.0])
def test_a_scaled_body_under_forces_scaled_by_the_square_has_the_same_shape(scale: float) -> None:
    big = TetMesh(MESH.nodes * scale, MESH.tets)
    small = bar()
    a = solve_equilibrium(small, tension={"top": 1.0, "side": 0.5})
    b = solve_equilibrium(bar(mesh=big, gravity=(0, 0, -9.81 / scale)), tension={"top": scale**2, "side": 0.5 * scale**2})
    assert a.converged and b.converged
    np.testing.assert_allclose(b.positions / scale, a.positions, atol=1e-8)
    assert b.shortening["top"] / scale == pytest.approx(a.shortening["top"], rel=1e-6)


def test_a_turned_world_turns_the_shape() -> None:
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    body = bar()
    turned_mesh = TetMesh(MESH.nodes @ R.T, MESH.tets)
    cables = tuple(tie_cable(turned_mesh, c.name, c.path.positions(MESH.nodes) @ R.T, R @ c.pull_point) for c in body.cables)
    turned = make_body(
        turned_mesh,
        young_modulus=150e3,
        poisson_ratio=0.4,
        density=1000.0,
        clamped=body.clamped,
        cables=cables,
        gravity=R @ body.gravity,
    )
    a, b = (solve_equilibrium(m, tension={"top": 1.0, "side": 2.0}) for m in (body, turned))
    np.testing.assert_allclose(b.positions, a.positions @ R.T, atol=1e-9)


def test_gravity_and_its_nodal_forces_are_the_same() -> None:
    body = bar()
    weightless = body.with_gravity([0, 0, 0])
    a, b = solve_equilibrium(body), solve_equilibrium(weightless, nodal_forces=body.weight())
    np.testing.assert_allclose(b.positions, a.positions, atol=1e-10)
    c = solve_equilibrium(weightless.with_dead_forces(body.weight()))
    np.testing.assert_allclose(c.positions, a.positions, atol=1e-10)


# Held cables


def test_holding_a_cable_where_a_tension_brought_it_gives_that_tension_back() -> None:
    body = bar()
    pulled = solve_equilibrium(body, tension={"top": 1.2, "side": 0.7})
    held = solve_equilibrium(body, shortening=pulled.shortening)
    assert held.converged and held.held.all()
    np.testing.assert_allclose(list(held.tension.values()), [1.2, 0.7], rtol=1e-6)
    np.testing.assert_allclose(held.positions, pulled.positions, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_a_held_cable_is_taut_at_its_length_or_slack_and_shorter(seed: int) -> None:
    body, rng = bar(), np.random.default_rng(seed)
    wanted = {name: float(v) for name, v in zip(body.cable_names, rng.uniform(-0.01, 0.01, 2))}
    state = solve_equilibrium(body, shortening=wanted)
    assert state.converged
    for name, held in zip(body.cable_names, state.held):
        assert state.tension[name] >= -1e-12
        if held:
            assert state.shortening[name] == pytest.approx(wanted[name], abs=1e-10)
        else:
            assert state.tension[name] == 0 and state.shortening[name] >= wanted[name] - 1e-9


def test_a_command_below_the_geometry_leaves_the_cable_slack() -> None:
    body = bar()
    alone = solve_equilibrium(body)
    state = solve_equilibrium(body, shortening={"top": alone.shortening["top"] - 0.003})
    assert not state.held[0] and state.tension["top"] == 0
    np.testing.assert_allclose(state.positions, alone.positions, atol=1e-9)


def test_a_bilateral_cable_pushes() -> None:
    body = bar()
    target = solve_equilibrium(body).shortening["top"] - 0.003
    state = solve_equilibrium(body, shortening={"top": target}, bilateral=True)
    assert state.converged and state.tension["top"] < 0
    assert state.shortening["top"] == pytest.approx(target, abs=1e-11)
    assert unbalanced(body, state) < 1e-7


def test_a_slack_cable_becomes_taut_again_from_a_slack_start() -> None:
    body = bar()
    slack = solve_equilibrium(body, shortening={"top": -0.02, "side": 0.004})
    taut = solve_equilibrium(body, shortening={"top": 0.004, "side": 0.004}, start=slack)
    cold = solve_equilibrium(body, shortening={"top": 0.004, "side": 0.004})
    assert not slack.held[0] and taut.held[0] and taut.tension["top"] > 0
    np.testing.assert_allclose(taut.positions, cold.positions, atol=1e-8)


# Where there is none


def test_nothing_clamped_is_singular_and_says_what_to_do() -> None:
    body = bar_body(MESH, clamped=False, gravity=(0, 0, -9.81))
    state = solve_equilibrium(body)
    assert state.status == "singular" and not state.converged
    assert "clamp more nodes" in state.advice


def on_a_hinge(gravity: list[float]) -> BodyModel:
    """Return a bar that is clamped at two nodes, one above the other along z: it turns about them."""
    return make_body(MESH, young_modulus=1e5, poisson_ratio=0.4, density=1000.0, gravity=gravity, clamped=[0, 1])


@pytest.mark.parametrize("gravity", [[0.0, -9.81, 0.0], [3.0, -9.0, 0.0]])
def test_a_body_on_a_hinge_hangs_below_it(gravity: list[float]) -> None:
    body = on_a_hinge(gravity)
    state = solve_equilibrium(body)
    assert not body.is_clamped() and bar().is_clamped()
    assert state.converged and unbalanced(body, state) < 1e-7
    share = np.linalg.norm(body.weight(), axis=1)
    centre = share @ state.positions[:, :2] / share.sum()
    down = np.array(gravity[:2]) / np.linalg.norm(gravity)
    assert centre @ down > 0.04 and abs(centre @ [-down[1], down[0]]) < 1e-6


def test_a_hinge_that_nothing_turns_is_singular_and_says_what_to_do() -> None:
    state = solve_equilibrium(on_a_hinge([0.0, 0.0, -9.81]))
    assert state.status == "singular" and "clamp more nodes" in state.advice


def test_a_body_on_springs_is_clamped() -> None:
    body = bar().with_clamp_stiffness(100.0)
    state = solve_equilibrium(body)
    assert body.is_clamped() and state.converged
    sag = body.mesh.nodes[body.clamp_nodes] - state.positions[body.clamp_nodes]
    np.testing.assert_allclose(100.0 * sag.sum(axis=0), -body.weight().sum(axis=0), atol=1e-6)  # the springs carry the weight


@pytest.mark.parametrize("law", LAWS)
def test_an_absurd_load_is_no_equilibrium_and_says_why(law: str) -> None:
    with counting() as work:
        state = solve_equilibrium(bar(law), tension={"top": 1e6, "side": 1e5})
    assert state.status == "overload" and state.reached < 1.0 and state.iterations < 500
    assert work.equilibria > 2  # what is tried on the way is work, too
    soon = solve_equilibrium(
        bar(law), tension={"top": 1e6, "side": 1e5}, options=SolveOptions(newton=NewtonOptions(most_steps=9))
    )
    assert soon.status == "overload" and soon.iterations < state.iterations
    assert state.advice == ADVICE[state.status]
    assert np.isfinite(state.positions).all() and state.residual_n > 1e-6


@pytest.mark.parametrize("seed", range(6))
def test_random_loads_are_balanced(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = bar(LAWS[seed % 3], quadratic=bool(seed % 2))
    forces = rng.normal(0, 10 ** rng.uniform(-3, 0.0), body.mesh.nodes.shape)
    state = solve_equilibrium(body, tension={"top": float(rng.uniform(0, 5))}, nodal_forces=forces)
    assert state.converged and state.reached == 1.0
    assert unbalanced(body, state) < 1e-6


@pytest.mark.parametrize(
    ("arguments", "texts"),
    [
        ({"tension": {"north": 1.0}}, ["unknown cable", "tension", "north", "top, side"]),
        ({"shortening": {"north": 1.0}}, ["unknown cable", "shortening"]),
        ({"tension": {"top": float("nan")}}, ["must be finite", "tension[top]"]),
        ({"shortening": {"side": float("inf")}}, ["must be finite", "shortening[side]"]),
        ({"tension": {"top": -1.0}}, ["a cable cannot push", "tension[top]", "-1 N"]),
        ({"tension": {"top": 1.0}, "shortening": {"top": 0.0}}, ["either pulled or held", "top"]),
        ({"nodal_forces": np.full((20, 3), np.nan)}, ["nodal_forces", "finite"]),
        ({"nodal_forces": np.zeros((7, 3))}, ["wrong shape", "nodal_forces", "(7, 3)"]),
    ],
)
def test_inputs_that_cannot_be(arguments: dict[str, object], texts: list[str]) -> None:
    with pytest.raises(InputError) as error:
        solve_equilibrium(bar(), **arguments)  # type: ignore[arg-type]
    for text in texts:
        assert text in str(error.value)


def test_a_start_of_another_mesh_is_refused() -> None:
    with pytest.raises(InputError, match="belongs to another mesh"):
        solve_equilibrium(bar(), start=solve_equilibrium(bar(mesh=block_mesh((1, 1, 1)))))


def test_every_status_has_advice() -> None:
    assert all(len(text) > 20 for text in ADVICE.values())
