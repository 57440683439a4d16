"""Effects that change shape or support: a finer mesh, another size, a clamp that gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import bar_body, central_gradient, dense_stiffness
from arm import WIDTH, arm
from helpers import block_mesh, write_block_robot

from femsense.core.errors import InputError
from femsense.core.pose import rotation_from_vector
from femsense.fem.assembly import internal
from femsense.fem.body import make_body
from femsense.fem.clamp import plate_at, ties_of
from femsense.fem.compliance import compliance, tangent_at
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import to_quadratic
from femsense.io.robot_toml import load_robot
from femsense.model.effects import apply_effects, build_entry, find_effect
from femsense.model.remeshing import body_on_mesh, finer_mesh, robot_on_mesh

OUTSIDE = "ignore:.*outside the mesh.*:UserWarning"
TURN = 0.05
"""A plate that gives about as much as the arm bends [N m/rad]."""


def applied(robot, name, **keys):
    return apply_effects(robot, [{"name": name, **keys}])


# The plate


def disturbed(body, seed=0, size=2e-3):
    x = body.mesh.nodes @ rotation_from_vector([0.2, -0.4, 0.3]).T
    return x + np.random.default_rng(seed).normal(0, size, x.shape)


@pytest.mark.parametrize(("spring", "turn"), [(300.0, np.inf), (300.0, TURN), (np.inf, TURN)])
def test_forces_and_stiffness_of_the_clamp_are_slopes_of_its_energy(spring, turn):
    body = bar_body(block_mesh((2, 1, 1)), cables=False).with_clamp_stiffness(spring, turn=turn)
    body = replace(
        body, material=replace(body.material, young_modulus=body.material.young_modulus * (1.0 if np.isfinite(spring) else 1e-3))
    )
    x = disturbed(body)
    slope = central_gradient(lambda y: np.array([internal(body, y, tangent=False).energy]), x, 1e-6).ravel()
    forces = internal(body, x, tangent=False).forces.ravel()
    np.testing.assert_allclose(forces, slope, atol=1e-6 * np.abs(forces).max())
    K = central_gradient(lambda y: internal(body, y, tangent=False).forces.ravel(), x, 1e-7)
    if np.isfinite(turn):
        right = np.random.default_rng(1).normal(size=K.shape[0])
        at = tangent_at(body, replace(solve_equilibrium(body), positions=x))
        answer = at.respond(right.reshape(1, -1, 3))[0].ravel()
        np.testing.assert_allclose(K @ answer, right, atol=2e-4 * np.abs(right).max())
    else:
        np.testing.assert_allclose(dense_stiffness(body, x), K, atol=1e-5 * np.abs(K).max())


def test_a_turning_clamp_is_a_fixed_one_in_a_turned_world():
    """The law: turn the body with its clamp back, and it is a body with a fixed clamp under loads that are turned back."""
    robot = arm((5, 2, 2), gravity=(1.0, 2.0, -9.81))
    pull = {"up": 1.0, "left": 0.6}
    body = applied(robot, "base_compliance", rotation_stiffness_nm_rad=TURN).body
    state = solve_equilibrium(body, tension=pull)
    turn, center = plate_at(body, ties_of(body), state.positions).turn, body.clamp_center
    assert 0.2 < np.linalg.norm(turn) < 1.5
    back = rotation_from_vector(-turn)
    cables = tuple(replace(c, pull_point=center + back @ (c.pull_point - center)) for c in robot.body.cables)
    world = replace(robot.body, cables=cables).with_gravity(back @ robot.body.gravity)
    fixed = solve_equilibrium(world, tension=pull)
    expected = center + (fixed.positions - center) @ back
    assert np.abs(state.positions - expected).max() < 1e-4 * np.abs(expected - body.mesh.nodes).max()


def test_the_plate_turns_by_the_moment_of_all_loads():
    body = applied(arm((5, 2, 2)), "base_compliance", rotation_stiffness_nm_rad=TURN).body
    state = solve_equilibrium(body)
    moment = np.cross(state.positions - body.clamp_center, body.dead_load()).sum(axis=0)
    np.testing.assert_allclose(TURN * plate_at(body, ties_of(body), state.positions).turn, moment, atol=1e-8)
    held = state.positions[body.clamped] - body.clamp_center
    rigid = plate_at(body, ties_of(body), state.positions).arms
    assert np.abs(held - rigid).max() < 1e-3 * np.abs(rigid - (body.mesh.nodes[body.clamped] - body.clamp_center)).max()


def test_both_springs_give_more_than_each():
    robot, sag = arm((5, 2, 2)), {}
    for key, keys in {"none": {}, "nodes": {"stiffness_n_m": 100.0}, "plate": {"rotation_stiffness_nm_rad": 0.5}}.items():
        sag[key] = solve_equilibrium(applied(robot, "base_compliance", **keys).body if keys else robot.body).positions[:, 2].min()
    both = applied(robot, "base_compliance", stiffness_n_m=100.0, rotation_stiffness_nm_rad=0.5).body
    lowest = solve_equilibrium(both).positions[:, 2].min()
    assert lowest < min(sag["nodes"], sag["plate"]) and max(sag["nodes"], sag["plate"]) < sag["none"]
    assert lowest - sag["none"] == pytest.approx(sag["nodes"] + sag["plate"] - 2 * sag["none"], rel=0.05)


def test_compliance_on_a_turning_clamp_is_the_derivative_of_equilibria_solved_anew():
    body = applied(arm((5, 2, 2)), "base_compliance", rotation_stiffness_nm_rad=TURN).body
    pull = {"up": 0.5, "down": 0.0, "left": 0.2, "right": 0.0}
    state = solve_equilibrium(body, tension=pull)
    tip = body.mesh.nodes[[np.argmax(body.mesh.nodes @ [1.0, 0.1, 0.1])]]
    W = compliance(body, state, points=np.repeat(tip, 3, axis=0), directions=np.eye(3))
    node, h = int(np.argmax(body.mesh.nodes @ [1.0, 0.1, 0.1])), 1e-5
    for axis in range(3):
        force = np.zeros_like(state.positions)
        force[node, axis] = h
        moved = [solve_equilibrium(body, tension=pull, nodal_forces=s * force, start=state).positions[node] for s in (1, -1)]
        np.testing.assert_allclose(W[:3, axis], (moved[0] - moved[1]) / (2 * h), rtol=1e-4, atol=1e-6 * np.abs(W[:3, :3]).max())
    more = [solve_equilibrium(body, tension={**pull, "up": 0.5 + s * h}, start=state).positions[node] for s in (1, -1)]
    np.testing.assert_allclose(W[:3, 3], (more[0] - more[1]) / (2 * h), rtol=1e-4, atol=1e-6 * np.abs(W[:3, 3]).max())


# Another size


def test_a_body_of_another_size_is_that_of_a_mesh_of_that_size():
    robot, scale = arm((4, 2, 2)), 1.07
    grown = applied(robot, "geometry", scale=scale)
    center = robot.body.mesh.nodes[robot.body.clamped].mean(axis=0)
    mesh = replace(robot.body.mesh, nodes=center + scale * (robot.body.mesh.nodes - center))
    anew = make_body(
        mesh,
        young_modulus=300e3,
        poisson_ratio=0.45,
        density=1070.0,
        clamped=robot.body.clamped,
        cables=robot.body.cables,
        gravity=robot.body.gravity,
    )
    pull = {"up": 1.0}
    np.testing.assert_allclose(
        solve_equilibrium(grown.body, tension=pull).positions, solve_equilibrium(anew, tension=pull).positions, atol=1e-10
    )
    np.testing.assert_allclose(grown.markers.positions(grown.body.mesh.nodes), grown.marker_points, atol=1e-12)
    np.testing.assert_allclose(grown.marker_points - center, scale * (robot.marker_points - center), atol=1e-12)
    assert all((a.pull_point == b.pull_point).all() for a, b in zip(grown.body.cables, robot.body.cables))


def test_under_its_own_weight_a_larger_body_sags_with_the_square_of_its_size():
    sag = [
        solve_equilibrium(applied(arm((4, 2, 2), gravity=(0, 0, -0.2)), "geometry", scale=s).body).positions[:, 2].min()
        + WIDTH / 2 * s
        for s in (1.0, 1.2)
    ]
    assert sag[1] / sag[0] == pytest.approx(1.2**2, rel=0.01)


# A finer mesh


@pytest.mark.filterwarnings(OUTSIDE)
def test_quadratic_elements_are_those_that_the_file_could_have_declared(tmp_path: Path):
    linear = load_robot(write_block_robot(tmp_path / "a", effects=[{"name": "discretisation", "element": "tet10"}]))
    declared = load_robot(write_block_robot(tmp_path / "b", mesh__element="tet10"))
    pull = {"top": 1.0}
    for field in ("clamped", "clamp_nodes"):
        np.testing.assert_array_equal(np.sort(getattr(linear.body, field)), np.sort(getattr(declared.body, field)))
    a, b = (solve_equilibrium(r.body, tension=pull).positions for r in (linear, declared))
    np.testing.assert_allclose(linear.markers.positions(a), declared.markers.positions(b), atol=1e-9)


def test_refining_brings_a_linear_mesh_closer_to_quadratic_elements():
    robot = arm((4, 2, 2), gravity=(0, 0, -3.0))
    coarse = robot_on_mesh(robot, finer_mesh(robot.body.mesh, "tet4", 0))
    finer = applied(coarse, "discretisation", refinements=1)
    fine = applied(coarse, "discretisation", refinements=1, element="tet10")
    tips = {}
    for name, r in (("plain", coarse), ("finer", finer), ("fine", fine)):
        tips[name] = r.markers.positions(solve_equilibrium(r.body).positions)[-1, 2]
    assert abs(tips["finer"] - tips["fine"]) < 0.7 * abs(tips["plain"] - tips["fine"])
    assert tips["fine"] < tips["finer"] < tips["plain"] + 1e-3


def test_a_finer_mesh_keeps_what_the_robot_has():
    robot = apply_effects(
        arm((3, 2, 2)),
        [
            {"name": "soft_region", "center_m": [0.08, 0, 0], "radius_m": 0.03, "scale": 0.5},
            {"name": "cable_friction", "coefficient": 0.2},
            {"name": "payload", "point_m": [0.1, 0, 0], "force_n": [0, 0, -0.1]},
            {"name": "base_compliance", "stiffness_n_m": 300.0},
            {"name": "hyperelastic", "law": "gent", "jm": 3.0},
            {"name": "stiffness", "scale": 1.5},
        ],
    )
    fine = applied(robot, "discretisation", refinements=1)
    assert len(fine.body.mesh.tets) == 8 * len(robot.body.mesh.tets) and fine.body.mesh.is_quadratic
    assert fine.body.material.law == "gent" and fine.body.material.stretch_limit == 3.0
    assert [c.friction for c in fine.body.cables] == [0.2] * 4 and fine.body.clamp_stiffness == 300.0
    np.testing.assert_allclose(fine.body.dead_forces.sum(axis=0), robot.body.dead_forces.sum(axis=0), atol=1e-12)
    np.testing.assert_allclose(
        np.cross(fine.body.mesh.nodes, fine.body.dead_forces).sum(axis=0),
        np.cross(robot.body.mesh.nodes, robot.body.dead_forces).sum(axis=0),
        atol=1e-12,
    )
    volume = lambda body: float((body.stencil.volumes.sum(axis=1) * body.material.young_modulus).sum())  # noqa: E731
    assert volume(fine.body) == pytest.approx(volume(robot.body), rel=1e-9)
    np.testing.assert_allclose(fine.markers.positions(fine.body.mesh.nodes), robot.marker_points, atol=1e-12)
    np.testing.assert_allclose(fine.body.mesh.nodes[fine.features], robot.body.mesh.nodes[robot.features], atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "texts"),
    [
        ({}, ["neither element nor refinements"]),
        ({"element": "hex8"}, ["unknown element", "tet4 | tet10"]),
        ({"refinements": 1.5}, ["not a whole number", "0 … 3"]),
        ({"refinements": True}, ["not a whole number"]),
        ({"refinements": 9}, ["not a whole number"]),
    ],
)
def test_errors_of_discretisation(keys, texts):
    with pytest.raises(InputError) as error:
        applied(arm((2, 1, 1)), "discretisation", **keys)
    assert all(text in str(error.value) for text in texts)


def test_quadratic_meshes_need_no_other_elements():
    body = bar_body(to_quadratic(block_mesh((2, 1, 1))))
    assert body_on_mesh(body, body.mesh).mesh is body.mesh


@pytest.mark.parametrize(
    ("name", "true", "key"), [("soft_region", [0.06, 0.0, 0.0], "center_m"), ("payload", [0.072, 0.003, 0.01], "point_m")]
)
def test_seeds_near_by_come_closer_to_a_place(name, true, key):
    robot = arm((7, 2, 2))
    effect = find_effect(name)
    far = [float(np.linalg.norm(np.array(seed[key]) - true)) for seed in effect.seeds(robot)]
    nearby = effect.nearby(robot, effect.seeds(robot)[int(np.argmin(far))])
    assert min(float(np.linalg.norm(np.array(seed[key]) - true)) for seed in nearby) < 0.8 * min(far)
    if name == "payload":  # and these again, to a part of an element
        close = min(nearby, key=lambda seed: float(np.linalg.norm(np.array(seed[key]) - true)))
        closer = [np.linalg.norm(np.array(seed[key]) - true) for seed in effect.nearby(robot, close)]
        assert min(closer) < 0.03 * robot.body.reach
    for seed in nearby:
        parameters = effect.parameters(robot, "tension")
        effect.apply(robot, build_entry(parameters, [p.null for p in parameters], seed))


def test_soft_regions_are_tried_inside_the_body_too():
    seeds = find_effect("soft_region").seeds(arm((8, 2, 2)))
    inside = [seed["center_m"] for seed in seeds if np.abs(seed["center_m"][1:]).max() < 3e-3]
    along = np.unique(np.round([place[0] for place in inside], 4))
    np.testing.assert_allclose(along, np.arange(0.00625, 0.1, 0.0125), atol=3e-3)  # the middles of eight slices


def test_bodies_of_other_materials_share_what_the_finer_mesh_needs():
    robot = arm((4, 2, 2))
    softer = robot.with_body(
        robot.body.with_stiffness_scale(np.linspace(0.5, 1.0, len(robot.body.mesh.tets))).with_gravity((0.0, 1.0, 2.0))
    )
    mesh = finer_mesh(robot.body.mesh, None, 1)
    one, other = robot_on_mesh(robot, mesh).body, robot_on_mesh(softer, mesh).body
    assert one.free_map is other.free_map and one.stencil is other.stencil
    for body, of in ((one, robot.body), (other, softer.body)):
        corners, centres = of.mesh.nodes[of.mesh.tets[:, :4]], mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
        inside = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)) @ (centres[None] - corners[:, :1]).transpose(
            0, 2, 1
        )
        holder = np.minimum(inside.min(axis=1), 1.0 - inside.sum(axis=1)).argmax(axis=0)
        np.testing.assert_array_equal(body.material.young_modulus, of.material.young_modulus[holder])
        assert body.material.density == of.material.density and body.material.law == of.material.law
        assert body.material.poisson_ratio == pytest.approx(np.repeat(of.material.poisson_ratio, 8))
        np.testing.assert_array_equal(body.gravity, of.gravity)


def test_what_the_finer_mesh_needs_is_kept_whatever_rubs_or_stretches():
    robot = arm((4, 2, 2))
    cables = tuple(replace(c, friction=0.3, stretch_stiffness=5e3, max_tension=7.0) for c in robot.body.cables)
    mesh = finer_mesh(robot.body.mesh, None, 1)
    one = robot_on_mesh(robot, mesh).body
    other = robot_on_mesh(robot.with_body(robot.body.with_cables(cables)), mesh).body
    assert one.free_map is other.free_map
    for c, own, plain in zip(other.cables, cables, one.cables):
        assert (c.name, c.friction, c.stretch_stiffness, c.max_tension) == (own.name, 0.3, 5e3, 7.0)
        assert c.pull_point is own.pull_point and c.path is plain.path
        np.testing.assert_allclose(c.path.positions(mesh.nodes), own.path.positions(robot.body.mesh.nodes), atol=1e-9)


def test_clamps_in_which_a_soft_body_hangs_by_tens_of_millimetres_are_plausible():
    (spring,) = find_effect("base_compliance").parameters(arm((4, 1, 1)), "tension")
    assert 15.0 < 1.0 / spring.high < 30.0  # N/m at each of nine nodes
