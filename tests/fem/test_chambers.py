"""Pressure chambers: finding them, their volume and its derivatives, closed forms, reciprocity, held volumes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from analytic import central_gradient, relative_error
from helpers import block_mesh
from hollow import hollow_bar, shell, without_box
from hollow_bar_cable import SEED, hollow

from femsense.core.errors import InputError
from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.body import BodyModel, make_body
from femsense.fem.cavities import find_chamber
from femsense.fem.chambers import add_pressure_stiffness, chamber_volume, volume_gradient
from femsense.fem.compliance import compliance, tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import TetMesh

SIZE = (0.1, 0.03, 0.03)
P = 4e3


def two_storeys(*, quadratic: bool = False) -> TetMesh:
    """A bar with two cavities, one above the other."""
    mesh = block_mesh((6, 3, 5), SIZE)
    low = without_box(mesh, [0.1 / 6, 0.01, 0.006], [0.1 * 5 / 6, 0.02, 0.012])
    return without_box(low, [0.1 / 6, 0.01, 0.018], [0.1 * 5 / 6, 0.02, 0.024])


def moved(mesh: TetMesh, seed: int = 0) -> np.ndarray:
    return mesh.nodes + np.random.default_rng(seed).normal(0.0, 5e-4, mesh.nodes.shape)


# Finding


@pytest.mark.parametrize("quadratic", [False, True])
def test_volume_of_a_box_and_of_its_image_under_a_linear_map(quadratic: bool) -> None:
    mesh = hollow_bar(quadratic=quadratic)
    chamber = find_chamber(mesh, "core", SEED)
    F = np.array([[1.2, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.2, 1.1]])
    box = 0.1 * 4 / 6 * 0.01 * 0.01
    assert chamber_volume(chamber, mesh.nodes) == pytest.approx(box, rel=1e-12)
    assert chamber_volume(chamber, mesh.nodes @ F.T + 0.3) == pytest.approx(np.linalg.det(F) * box, rel=1e-10)


def test_a_quadratic_surface_follows_the_sphere() -> None:
    error = []
    for quadratic in (False, True):
        mesh = shell(0.02, 0.04, quadratic=quadratic)
        chamber = find_chamber(mesh, "ball", [0.001, 0.0, 0.0])
        error.append(abs(chamber_volume(chamber, mesh.nodes) / (4 / 3 * np.pi * 0.02**3) - 1))
    assert error[0] == pytest.approx(0.034, abs=0.005) and error[1] < 2e-4


@pytest.mark.parametrize(
    ("seed", "message"),
    [
        ([0.005, 0.015, 0.015], "lies in the material"),
        ([0.05, 0.015, 0.05], "outside of the body"),
        ([0.05, 0.0149, 0.01], "in the material"),
    ],
)
def test_seeds_that_are_not_in_a_cavity(seed: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_chamber(hollow_bar(), "core", seed)


def test_an_open_cavity_is_refused_with_the_share_of_the_hole() -> None:
    mesh = without_box(hollow_bar(), [0.08, 0.01, 0.01], [0.11, 0.02, 0.02])
    with pytest.raises(InputError, match=r"(?s)open to the outside.*% of the directions"):
        find_chamber(mesh, "core", SEED)


def test_two_chambers_in_one_cavity_are_refused_and_two_cavities_are_two_chambers() -> None:
    mesh = hollow_bar()
    twins = tuple(find_chamber(mesh, name, [x, 0.015, 0.015]) for name, x in (("a", 0.03), ("b", 0.07)))
    with pytest.raises(InputError, match=r"(?s)share a surface.*'a' and 'b'"):
        make_body(mesh, young_modulus=1e5, poisson_ratio=0.4, chambers=twins)
    storeys = two_storeys()
    low, high = (find_chamber(storeys, n, [0.05, 0.015, z]) for n, z in (("low", 0.009), ("high", 0.021)))
    assert not np.intersect1d(low.faces, high.faces).size
    assert chamber_volume(low, storeys.nodes) == pytest.approx(0.1 * 4 / 6 * 0.01 * 0.006, rel=1e-9)


# Derivatives


@pytest.mark.parametrize("quadratic", [False, True])
def test_gradient_and_stiffness_are_slopes_of_the_volume(quadratic: bool) -> None:
    mesh = hollow_bar(quadratic=quadratic, cells=(3, 3, 3))
    chamber = find_chamber(mesh, "core", SEED)
    body = make_body(mesh, young_modulus=1e5, poisson_ratio=0.4, chambers=(chamber,))
    x = moved(mesh)
    gradient = volume_gradient(chamber, x)
    wanted = central_gradient(lambda y: chamber_volume(chamber, y), x, 1e-5).reshape(x.shape)
    assert relative_error(gradient, wanted) < 1e-7
    blocks = np.zeros((len(body.stencil.block_columns), 9))
    add_pressure_stiffness(body, x, np.array([2.5]), blocks)
    K = np.zeros((x.size, x.size))
    K[np.ix_(body.free_map.dofs, body.free_map.dofs)] = reduced_matrix(body, blocks).toarray()
    slope = central_gradient(lambda y: volume_gradient(chamber, y).ravel(), x, 1e-4).T
    assert relative_error(K, -2.5 * slope) < 1e-7
    np.testing.assert_allclose(K, K.T, atol=1e-12 * np.abs(K).max())


@pytest.mark.parametrize("quadratic", [False, True])
def test_a_closed_cavity_pushes_on_itself_alone(quadratic: bool) -> None:
    """∮ n dA = 0 and ∮ x × n dA = 0."""
    mesh = hollow_bar(quadratic=quadratic)
    chamber, x = find_chamber(mesh, "core", SEED), moved(mesh)
    force = volume_gradient(chamber, x)
    area = np.abs(force).sum()
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * area
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-13 * area


# Equilibrium


@pytest.mark.parametrize(("quadratic", "layers", "bound"), [(False, 2, 0.19), (False, 4, 0.16), (True, 2, 6e-3)])
def test_a_thick_sphere_swells_as_lame_says(quadratic: bool, layers: int, bound: float) -> None:
    """u(r) = p a³ / (E (b³ − a³)) ((1 − 2ν) r + (1 + ν) b³ / (2 r²)); Timoshenko & Goodier, § 136."""
    a, b, E, nu, p = 0.02, 0.04, 1e5, 0.3, 100.0
    mesh = shell(a, b, layers=layers, quadratic=quadratic)
    radius = np.linalg.norm(mesh.nodes, axis=1)
    body = make_body(
        mesh,
        young_modulus=E,
        poisson_ratio=nu,
        clamped=radius > b - 1e-6,
        chambers=(find_chamber(mesh, "ball", [0.0, 0.0, 1e-3]),),
    ).with_clamp_stiffness(1e-4)
    state = solve_equilibrium(body, pressure={"ball": p})
    swelling = ((state.positions - mesh.nodes) * mesh.nodes).sum(axis=1) / radius
    wanted = p * a**3 / (E * (b**3 - a**3)) * ((1 - 2 * nu) * radius + (1 + nu) * b**3 / (2 * radius**2))
    inner, outer = radius < a + 1e-6, radius > b - 1e-6
    assert state.converged
    assert abs(swelling[inner].mean() / wanted[inner].mean() - 1) < bound
    assert abs(swelling[outer].mean() / wanted[outer].mean() - 1) < bound
    assert abs(state.volume["ball"] / (4 * np.pi * a**2 * wanted[inner].mean()) - 1) < 1.2 * bound


def unbalanced(body: BodyModel, state: Equilibrium) -> float:
    """Return the largest unbalanced nodal force without cables [N], put together anew."""
    force = body.dead_load() - internal(body, state.positions).forces
    for chamber in body.chambers:
        force = force + state.pressure[chamber.name] * volume_gradient(chamber, state.positions)
    force[body.clamped] = 0.0
    return float(np.linalg.norm(force, axis=1).max())


@pytest.mark.parametrize("law", ["corotational", "neo_hookean"])
@pytest.mark.parametrize("quadratic", [False, True])
def test_forces_balance_under_pressure(law: str, quadratic: bool) -> None:
    body = hollow(law, quadratic=quadratic)
    state = solve_equilibrium(body, pressure={"core": 2 * P})
    assert state.converged and unbalanced(body, state) < 1e-7
    assert unbalanced(body, state) == pytest.approx(state.residual_n, abs=1e-12)
    assert state.pressure == {"core": 2 * P} and state.volume["core"] > 0.04 * chamber_volume(body.chambers[0], body.mesh.nodes)


def test_the_cavity_may_touch_the_clamp() -> None:
    mesh = hollow_bar()
    clamped = mesh.nodes[:, 0] < 0.1 / 6 + 1e-9
    body = make_body(mesh, young_modulus=150e3, poisson_ratio=0.4, clamped=clamped, chambers=(find_chamber(mesh, "core", SEED),))
    assert clamped[body.chambers[0].faces].any()
    state = solve_equilibrium(body, pressure={"core": P})
    assert state.converged and unbalanced(body, state) < 1e-7


def test_work_of_the_pressure_is_the_stored_energy() -> None:
    """∫ p dV along the loading path, by Simpson's rule."""
    body = hollow("neo_hookean", gravity=(0, 0, 0))
    pressures = np.linspace(0.0, 3 * P, 13)
    states = [solve_equilibrium(body, pressure={"core": p}) for p in pressures]
    volume = np.array([s.volume["core"] for s in states])
    h = pressures[1] - pressures[0]
    weights = np.array([1] + [4, 2] * 5 + [4, 1]) * h / 3
    work = pressures[-1] * volume[-1] - weights @ volume
    assert work == pytest.approx(internal(body, states[-1].positions).energy, rel=1e-4)


def test_a_held_volume_and_a_given_pressure_are_the_same_state() -> None:
    body = hollow("neo_hookean")
    given = solve_equilibrium(body, pressure={"core": P}, tension={"top": 1.0})
    held = solve_equilibrium(body, volume={"core": given.volume["core"]}, tension={"top": 1.0})
    assert held.converged and held.held.tolist() == [False, True]
    assert held.pressure["core"] == pytest.approx(P, rel=1e-7)
    np.testing.assert_allclose(held.positions, given.positions, atol=1e-9)
    both = solve_equilibrium(body, volume={"core": given.volume["core"]}, shortening={"top": given.shortening["top"]}, start=held)
    assert (
        both.converged
        and both.pressure["core"] == pytest.approx(P, rel=1e-6)
        and both.tension["top"] == pytest.approx(1.0, rel=1e-6)
    )
    sucked = solve_equilibrium(body, volume={"core": -1e-7})
    assert sucked.converged and sucked.pressure["core"] < 0


def test_pressure_and_cable_are_reciprocal() -> None:
    """dδ/dp = dV/dT: the compliance is symmetric, and its entries are the slopes of equilibria solved anew."""
    body = hollow("neo_hookean")

    def solve(T: float, p: float) -> Equilibrium:
        return solve_equilibrium(body, tension={"top": T}, pressure={"core": p}, options=SolveOptions(relative_tolerance=1e-12))

    state = solve(1.0, P)
    W = compliance(body, state)
    assert W.shape == (2, 2) and W[0, 1] == W[1, 0] != 0.0
    more, less = solve(1.0, P + 1), solve(1.0, P - 1)
    stronger, weaker = solve(1.001, P), solve(0.999, P)
    slopes = [
        [(stronger.shortening["top"] - weaker.shortening["top"]) / 2e-3, (more.shortening["top"] - less.shortening["top"]) / 2],
        [(stronger.volume["core"] - weaker.volume["core"]) / 2e-3, (more.volume["core"] - less.volume["core"]) / 2],
    ]
    np.testing.assert_allclose(W, slopes, rtol=2e-5)


def test_a_held_chamber_is_stiff_in_the_tangent() -> None:
    body = hollow("neo_hookean")
    force = np.zeros((1, *body.mesh.nodes.shape))
    force[0, np.argmax(body.mesh.nodes.sum(axis=1))] = [0.0, 0.0, -1e-3]
    held = solve_equilibrium(body, volume={"core": 1e-6})
    again = solve_equilibrium(body, volume={"core": 1e-6}, nodal_forces=force[0], start=held)
    move = tangent_at(body, held).respond(force)[0]
    assert relative_error(move, again.positions - held.positions) < 2e-2
    assert abs((volume_gradient(body.chambers[0], held.positions) * move).sum()) < 1e-18


def test_the_upper_chamber_bends_the_bar_down() -> None:
    mesh = two_storeys()
    chambers = tuple(find_chamber(mesh, n, [0.05, 0.015, z]) for n, z in (("low", 0.009), ("high", 0.021)))
    body = make_body(mesh, young_modulus=150e3, poisson_ratio=0.4, clamped=mesh.nodes[:, 0] < 1e-9, chambers=chambers)
    end = mesh.nodes[:, 0] > 0.1 - 1e-9
    down, up, none = (
        (solve_equilibrium(body, pressure=p).positions - mesh.nodes)[end].mean(axis=0)
        for p in ({"high": 2 * P}, {"low": 2 * P}, {})
    )
    assert down[2] < -2e-4 and up[2] == pytest.approx(-down[2], rel=0.2) and abs(none).max() == 0.0


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"pressure": {"cor": 1.0}}, r"(?s)unknown chamber.*core"),
        ({"volume": {"cor": 1.0}}, r"(?s)unknown chamber.*core"),
        ({"pressure": {"core": 1.0}, "volume": {"core": 0.0}}, "either under pressure or held"),
        ({"pressure": {"core": float("nan")}}, "finite"),
    ],
)
def test_wrong_pressures_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        solve_equilibrium(hollow(), **given)
