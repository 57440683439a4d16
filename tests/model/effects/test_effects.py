"""Effects: each acts, each vanishes at its null, entries come back, and errors say what is known."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from analytic import bar_body
from helpers import block_mesh, write_block_robot

from femsense.core.errors import InputError
from femsense.fem.equilibrium import SolveOptions, solve_equilibrium
from femsense.fem.mesh import embed_points
from femsense.io.robot_toml import load_robot
from femsense.model.camera_frame import undo_depth
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import EFFECT_NAMES, EFFECTS, FORMS, Effect, Entry, Parameter, apply_effects, build_entry, find_effect
from femsense.model.frame_state import solve_frame
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, Timeline
from femsense.model.robot import Observation, Robot, plain_actuation
from femsense.model.softening import with_softening

MARKERS = np.array([[0.1, 0.015, 0.03], [0.06, 0.0, 0.0], [0.1, 0.03, 0.015]])
CENTER = [0.05, 0.015, 0.015]


def robot(**options: Any) -> Robot:
    body = bar_body(block_mesh((4, 1, 1)), gravity=(0.0, 0.0, -9.81), **options)
    return Robot(
        name="bar",
        body=body,
        marker_names=("a", "b", "c"),
        marker_points=MARKERS,
        markers=embed_points(body.mesh, MARKERS),
        features=np.zeros(0, np.int64),
        color_rgb=None,
        actuation=plain_actuation(len(body.cables)),
        observation=Observation(),
    )


def measured(r: Robot, control: str) -> np.ndarray:
    """Return markers of three frames as a camera half a metre above would measure them, friction,
    creep and softening included."""
    inputs = {"tension": [[0.5, 0.2], [1.5, 0.6], [0.7, 0.2]], "displacement": [[0.002, 0.002], [0.006, 0.001], [0.003, 0.002]]}[
        control
    ]
    rec = make_recording(Timeline([0.0, 1.0, 2.0]), drives=Drives(("top", "side"), inputs, actuation=control))
    driven, before, seen = with_softening(DrivenRobot(r, drive_of(r, rec)), 2), None, []
    for k in range(3):
        state = solve_frame(driven, k, options=SolveOptions(before=before))
        assert state.converged
        before = state.segment_tensions
        y = r.markers.positions(state.positions) + np.array([0, 0, 0.5])
        distance = np.linalg.norm(y, axis=1, keepdims=True)
        seen.append(y / distance * (r.observation.depth_scale * distance + r.observation.depth_offset))
    return np.array(seen)


def examples() -> list[tuple[Effect, str, Entry, tuple[Parameter, ...]]]:
    r = robot()
    return [
        (e, control, dict(e.seeds(r)[0]), e.parameters(r, control))
        for e in FORMS
        if not e.discrete
        for control in ("tension", "displacement")
    ]


def title(case: tuple[Effect, str, Entry, tuple[Parameter, ...]]) -> str:
    return f"{case[0].name}-{case[1]}-{len(case[3])}"


ACTING = [case for case in examples() if case[3]]


# Each effect


def test_the_names_are_those_of_the_format() -> None:
    names = {e.name for e in EFFECTS}
    assert len(names) == len(EFFECTS)
    assert names == set(EFFECT_NAMES) == {form.name for form in FORMS}
    assert names == {
        "discretisation",
        "geometry",
        "gravity",
        "stiffness",
        "poisson",
        "soft_region",
        "hyperelastic",
        "creep",
        "payload",
        "base_compliance",
        "cable_friction",
        "cable_offset",
        "cable_gain",
        "cable_stretch",
        "cable_slack",
        "depth_scale",
        "marker_offset",
        "clamped_marker",
        "density",
        "tip_mass",
        "chamber_offset",
        "chamber_gain",
        "cable_path",
        "stiffness_gradient",
        "rest_shape",
        "cable_coupling",
        "softening",
    }
    assert all(e.lacks and e.keys for e in EFFECTS)


@pytest.mark.parametrize("case", ACTING, ids=title)
def test_at_its_null_an_effect_changes_nothing(case: tuple[Effect, str, Entry, tuple[Parameter, ...]]) -> None:
    effect, control, seed, parameters = case
    entry = build_entry(parameters, [p.null for p in parameters], seed)
    np.testing.assert_allclose(measured(effect.apply(robot(), entry), control), measured(robot(), control), atol=1e-9)


@pytest.mark.parametrize("case", ACTING, ids=title)
def test_away_from_its_null_each_parameter_acts(case: tuple[Effect, str, Entry, tuple[Parameter, ...]]) -> None:
    effect, control, seed, parameters = case
    plain = measured(robot(), control)
    for i, p in enumerate(parameters):
        coordinates = [q.null for q in parameters]
        coordinates[i] += 0.1 * (p.high - p.null)
        moved = measured(effect.apply(robot(), build_entry(parameters, coordinates, seed)), control)
        assert np.abs(moved - plain).max() > 1e-6, p.label


@pytest.mark.parametrize("case", ACTING, ids=title)
def test_parameters_are_well_posed(case: tuple[Effect, str, Entry, tuple[Parameter, ...]]) -> None:
    for p in case[3]:
        assert p.low <= p.null <= p.high and p.low < p.high and 0 < p.step < 0.1 * (p.high - p.low)
        assert p.key in case[0].keys and p.label.startswith(p.key) and p.unit
        for c in (p.low + 0.3 * (p.high - p.low), p.high):
            assert p.coordinate(p.value(c)) == pytest.approx(c, rel=1e-12)
            slope = (p.value(c + 1e-2 * p.step) - p.value(c - 1e-2 * p.step)) / (2e-2 * p.step)
            assert p.value_std(c, 2.0) == pytest.approx(2.0 * abs(slope), rel=1e-4)


@pytest.mark.parametrize("case", ACTING, ids=title)
def test_an_entry_survives_toml_and_says_the_same(case: tuple[Effect, str, Entry, tuple[Parameter, ...]]) -> None:
    effect, control, seed, parameters = case
    coordinates = [p.null + 0.05 * (p.high - p.null) for p in parameters]
    entry = build_entry(parameters, coordinates, seed)
    again = tomllib.loads(tomli_w.dumps({"effects": [{"name": effect.name, **entry}]}))["effects"]
    assert set(entry) <= set(effect.keys)
    np.testing.assert_array_equal(
        measured(apply_effects(robot(), again), control), measured(effect.apply(robot(), entry), control)
    )


def test_building_entries_leaves_the_seed_alone() -> None:
    effect, seed = find_effect("payload"), {"point_m": [0.0, 0.0, 0.0]}
    parameters = effect.parameters(robot(), "tension")
    first = build_entry(parameters, [1, 2, 3], seed)
    second = build_entry(parameters, [4, 5, 6], seed)
    assert first["force_n"] == [1, 2, 3] and second["force_n"] == [4, 5, 6] and seed == {"point_m": [0.0, 0.0, 0.0]}


# What each means


def applied(name: str, **keys: Any) -> Robot:
    return apply_effects(robot(), [{"name": name, **keys}])


def test_gravity_replaces_the_declared_one() -> None:
    np.testing.assert_array_equal(applied("gravity", vector_m_s2=[1, 2, 3]).body.gravity, [1, 2, 3])


def test_stiffness_and_poisson_change_the_material() -> None:
    plain = robot().body.material
    np.testing.assert_allclose(applied("stiffness", scale=0.7).body.material.young_modulus, 0.7 * plain.young_modulus)
    soft = applied("poisson", poisson_ratio=0.3).body.material
    assert (soft.poisson_ratio == 0.3).all() and (soft.young_modulus == plain.young_modulus).all()


def test_a_soft_region_scales_elements_whose_centroid_is_inside() -> None:
    r = applied("soft_region", center_m=CENTER, radius_m=0.02, scale=0.5)
    mesh = r.body.mesh
    inside = np.linalg.norm(mesh.nodes[mesh.tets].mean(axis=1) - CENTER, axis=1) <= 0.02
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_allclose(r.body.material.young_modulus / robot().body.material.young_modulus, np.where(inside, 0.5, 1.0))


def test_hyperelastic_changes_the_law() -> None:
    assert applied("hyperelastic", law="neo_hookean").body.material.law == "neo_hookean"
    gent = applied("hyperelastic", law="gent", jm=4.0).body.material
    assert gent.law == "gent" and gent.stretch_limit == 4.0


def test_a_payload_is_a_force_at_its_point_beside_others() -> None:
    two = apply_effects(robot(), [{"name": "payload", "point_m": CENTER, "force_n": [0, 0, -0.1]}] * 2)
    np.testing.assert_allclose(two.body.dead_forces.sum(axis=0), [0, 0, -0.2], atol=1e-12)
    np.testing.assert_allclose(
        np.cross(two.body.mesh.nodes, two.body.dead_forces).sum(axis=0), np.cross(CENTER, [0, 0, -0.2]), atol=1e-12
    )


@pytest.mark.filterwarnings("ignore:.*outside the mesh.*:UserWarning")
def test_a_soft_base_is_a_spring_at_each_clamped_node_of_the_declared_mesh(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, mesh__element="tet10", effects=[{"name": "base_compliance", "stiffness_n_m": 40.0}])
    body = load_robot(folder).body
    assert body.clamp_stiffness == 40.0 and len(body.clamp_nodes) == 9  # 3 × 3 corners, no mid-edge nodes
    state = solve_equilibrium(body)
    stretch = state.positions[body.clamp_nodes] - body.mesh.nodes[body.clamp_nodes]
    np.testing.assert_allclose(-40.0 * stretch.sum(axis=0), -body.weight().sum(axis=0), atol=1e-6)


def test_friction_goes_to_every_cable_or_to_those_named() -> None:
    assert [c.friction for c in applied("cable_friction", coefficient=0.2).body.cables] == [0.2, 0.2]
    assert [c.friction for c in applied("cable_friction", coefficient={"side": 0.3}).body.cables] == [0.0, 0.3]


def test_gains_multiply_and_offsets_add_when_they_come_twice() -> None:
    r = apply_effects(
        robot(),
        [
            {"name": "cable_gain", "scale": 0.5},
            {"name": "cable_gain", "scale": {"top": 3.0}},
            {"name": "cable_offset", "tension_n": 0.1},
            {"name": "cable_offset", "tension_n": {"side": 0.2}},
        ],
    )
    np.testing.assert_allclose(r.actuation.gain, [1.5, 0.5])
    np.testing.assert_allclose(r.actuation.tension_offset, [0.1, 0.3])


def test_stretch_of_a_cable() -> None:
    assert [c.stretch_stiffness for c in applied("cable_stretch", stiffness_n_m=800.0).body.cables] == [800.0, 800.0]


def test_depth_is_undone_as_it_was_made() -> None:
    r = apply_effects(
        robot(), [{"name": "depth_scale", "scale": 1.02, "offset_m": 0.004}, {"name": "depth_scale", "scale": 0.99}]
    )
    true = np.random.default_rng(0).normal(0, 0.2, (9, 3)) + np.array([0, 0, 1.0])
    distance = np.linalg.norm(true, axis=1, keepdims=True)
    seen = true / distance * (0.99 * (1.02 * distance + 0.004))
    np.testing.assert_allclose(undo_depth(seen, r.observation), true, atol=1e-12)


def test_markers_move_by_their_offset() -> None:
    r = applied("marker_offset", offset_m={"b": [0.001, 0, -0.002]})
    np.testing.assert_allclose(r.marker_points - MARKERS, [[0, 0, 0], [0.001, 0, -0.002], [0, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(r.markers.positions(r.body.mesh.nodes), r.marker_points, atol=1e-12)


def test_effects_that_cannot_act_here_have_no_parameters() -> None:
    bare = robot(cables=False)
    weightless = robot(density=0.0)
    for name, r, control in [
        ("cable_friction", bare, "tension"),
        ("cable_gain", bare, "tension"),
        ("cable_offset", bare, "displacement"),
        ("cable_stretch", robot(), "tension"),
        ("cable_slack", robot(), "tension"),
        ("gravity", weightless, "tension"),
        ("creep", robot(), "displacement"),
        ("cable_stretch", bare, "displacement"),
        ("base_compliance", robot(clamped=False), "tension"),
    ]:
        assert find_effect(name).parameters(r, control) == (), name


# Errors


@pytest.mark.parametrize(
    ("entry", "texts"),
    [
        ({"name": "cable_frction"}, ["unknown effect", "cable_frction", "did you mean cable_friction?", "gravity, stiffness"]),
        ({}, ["unknown effect", "None"]),
        ({"name": "stiffness", "scal": 1.0}, ["unknown key", "effects.stiffness", "scal", "expected: scale"]),
        ({"name": "stiffness"}, ["not a number in range", "stiffness.scale"]),
        ({"name": "stiffness", "scale": 0.0}, ["not a number in range", "0.001 … 1000"]),
        ({"name": "stiffness", "scale": True}, ["not a number in range"]),
        ({"name": "stiffness", "scale": float("nan")}, ["not a number in range"]),
        ({"name": "poisson", "poisson_ratio": 0.5}, ["poisson.poisson_ratio", "0.4999"]),
        ({"name": "gravity", "vector_m_s2": [0, 1]}, ["not a vector", "three finite numbers"]),
        ({"name": "gravity", "vector_m_s2": ["a", 0, 1]}, ["not a vector"]),
        ({"name": "payload", "point_m": CENTER}, ["payload.force_n", "not a vector"]),
        ({"name": "soft_region", "center_m": [1, 1, 1], "radius_m": 0.01, "scale": 2.0}, ["no element", "enlarge radius_m"]),
        ({"name": "hyperelastic", "law": "ogden"}, ["unknown law", "ogden", "neo_hookean | gent"]),
        ({"name": "hyperelastic", "law": "gent"}, ["hyperelastic.jm"]),
        ({"name": "creep", "fraction": [0.1, 0.2], "time_s": 3.0}, ["differ in number"]),
        ({"name": "creep"}, ["differ in number"]),
        ({"name": "creep", "fraction": 0.1, "time_s": 0.0}, ["creep.time_s"]),
        ({"name": "cable_gain", "scale": {"north": 1.0}}, ["unknown cable", "cable_gain.scale", "north", "top, side"]),
        ({"name": "cable_friction", "coefficient": -0.1}, ["not negative"]),
        ({"name": "cable_stretch", "stiffness_n_m": 0.0}, ["a stiffness is positive"]),
        ({"name": "cable_stretch", "stiffness_n_m": {"top": 5.0}}, ["cable_stretch.stiffness_n_m"]),
        ({"name": "base_compliance"}, ["neither spring is given", "stiffness_n_m or rotation_stiffness_nm_rad"]),
        ({"name": "base_compliance", "rotation_stiffness_nm_rad": 0.0}, ["base_compliance.rotation_stiffness_nm_rad"]),
        ({"name": "hyperelastic", "law": "neo_hookean", "jm": 2.0}, ["jm belongs to gent"]),
        ({"name": "geometry", "scale": 0.0}, ["geometry.scale", "0.2 … 5"]),
        ({"name": "geometry"}, ["geometry.scale"]),
        ({"name": "discretisation"}, ["neither element nor refinements"]),
        ({"name": "base_compliance", "stiffness_n_m": -5.0}, ["base_compliance.stiffness_n_m"]),
        ({"name": "marker_offset", "offset_m": {"z": [0, 0, 0]}}, ["unknown marker", "z", "a, b, c"]),
        ({"name": "marker_offset", "offset_m": [0, 0, 0]}, ["not a table"]),
        ({"name": "depth_scale", "scale": 3.0}, ["depth_scale.scale"]),
    ],
)
def test_one_clear_error(entry: Entry, texts: list[str]) -> None:
    with pytest.raises(InputError) as error:
        apply_effects(robot(), [entry])
    for text in texts:
        assert text in str(error.value)


def test_friction_without_a_bend_is_refused() -> None:
    r = robot()
    straight = tuple(replace(c, path=c.path[:1], exit_direction=None) for c in r.body.cables)
    r = r.with_body(replace(r.body, cables=straight))
    assert find_effect("cable_friction").parameters(r, "tension") == ()
    with pytest.raises(InputError, match="no cable of this robot bends"):
        apply_effects(r, [{"name": "cable_friction", "coefficient": 0.1}])


@pytest.mark.parametrize(
    "effect", [f for f in FORMS if len(f.seeds(robot())[0])], ids=lambda f: f"{f.name}-{f.seeds(robot())[0]}"
)
def test_every_starting_point_can_be_applied(effect: Effect) -> None:
    r = robot()
    for seed in effect.seeds(r):
        parameters = (*effect.parameters(r, "tension"), *effect.polish(r, "tension", seed))
        assert effect.discrete or len(parameters)
        effect.apply(r, build_entry(parameters, [p.null for p in parameters], seed))


# robot.toml


@pytest.mark.filterwarnings("ignore:.*outside the mesh.*:UserWarning")
def test_effects_of_a_robot_file_are_applied_in_order(tmp_path: Path) -> None:
    effects = [
        {"name": "stiffness", "scale": 2.0},
        {"name": "cable_friction", "coefficient": {"top": 0.12}},
        {"name": "gravity", "vector_m_s2": [0.0, 1.0, 0.0]},
    ]
    plain = load_robot(write_block_robot(tmp_path / "plain"))
    r = load_robot(write_block_robot(tmp_path / "more", effects=effects))
    np.testing.assert_allclose(r.body.material.young_modulus, 2 * plain.body.material.young_modulus)
    assert [c.friction for c in r.body.cables] == [0.12, 0.0]
    np.testing.assert_array_equal(r.body.gravity, [0, 1, 0])


@pytest.mark.filterwarnings("ignore:.*outside the mesh.*:UserWarning")
def test_an_error_in_a_robot_file_names_the_file(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, effects=[{"name": "cable_gain", "scale": {"north": 1.0}}])
    with pytest.raises(InputError) as error:
        load_robot(folder)
    assert "robot.toml" in str(error.value) and "north" in str(error.value)
