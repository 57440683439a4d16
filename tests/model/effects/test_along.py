"""Effects along the body and of its cables' paths: axes, gradients, bodies curved at rest, coupled cables;
the rig has them too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arm import arm
from helpers import write_block_robot

from femsense.core.errors import InputError
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import element_volumes
from femsense.io.robot_toml import load_robot, robot_document
from femsense.model.effects import Entry, apply_effects
from femsense.model.effects.along import curved
from femsense.model.effects.axes import across_axis, axis_of
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.rig.plan import plan_script
from femsense.rig.script import check_script
from femsense.rig.truth import true_inputs

AXIS = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]


def test_the_axis_of_an_arm_goes_from_its_clamp_to_its_end() -> None:
    np.testing.assert_allclose(axis_of(arm((3, 1, 1)).body), AXIS, atol=1e-9)
    turned = across_axis(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))
    np.testing.assert_allclose(turned, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_a_gradient_goes_with_the_exponential_of_the_way_along_the_axis() -> None:
    robot = arm((4, 1, 1))
    entry: Entry = {"name": "stiffness_gradient", "axis_m": [[0.02, 0.0, 0.0], [0.08, 0.0, 0.0]], "per_m": -10.0}
    ratio = apply_effects(robot, [entry]).body.material.young_modulus / robot.body.material.young_modulus
    x = robot.body.mesh.nodes[robot.body.mesh.tets[:, :4]].mean(axis=1)[:, 0]
    np.testing.assert_allclose(np.log(ratio), -10.0 * (np.clip(x, 0.02, 0.08) - 0.02))


@pytest.mark.parametrize("curvature", [[6.0, 0.0], [3.0, -5.0]])
def test_a_curved_body_is_an_arc_with_plane_sections(curvature: list[float]) -> None:
    s = np.linspace(0.0, 0.1, 2001)
    line = np.column_stack([s, 0.0 * s, 0.0 * s])
    arc = curved(line, np.array(AXIS), np.array(curvature))
    steps = np.diff(arc, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 5e-5, rtol=1e-6)
    tangents = steps / np.linalg.norm(steps, axis=1)[:, None]
    size = np.linalg.norm(curvature)
    np.testing.assert_allclose(np.arccos(tangents[0] @ tangents[-1]), size * (0.1 - 5e-5), rtol=1e-6)
    np.testing.assert_allclose((tangents[1] - tangents[0])[1:] / 5e-5, curvature, rtol=1e-2)  # towards y and z
    aside = curved(line + np.array([0.0, 0.004, 0.003]), np.array(AXIS), np.array(curvature)) - arc
    np.testing.assert_allclose(np.linalg.norm(aside, axis=1), 0.005, rtol=1e-9)
    middles = 0.5 * (aside[1:] + aside[:-1])
    np.testing.assert_allclose(np.einsum("ij,ij->i", middles, tangents), 0.0, atol=1e-8)
    before, after = curved(np.array([[-0.02, 0.001, 0.0], [0.13, 0.0, 0.0]]), np.array(AXIS), np.array(curvature))
    np.testing.assert_allclose(before, [-0.02, 0.001, 0.0])
    np.testing.assert_allclose(after, arc[-1] + 0.03 * tangents[-1], atol=2e-5)


def test_a_body_that_is_curved_at_rest_is_free_of_stress_there() -> None:
    plain = arm((4, 1, 1), gravity=(0.0, 0.0, 0.0))
    robot = apply_effects(plain, [{"name": "rest_shape", "axis_m": AXIS, "curvature_1_m": [4.0, 2.0]}])
    state = solve_equilibrium(robot.body)
    np.testing.assert_allclose(state.positions, robot.body.mesh.nodes, atol=1e-10)
    assert np.linalg.norm(robot.marker_points - plain.marker_points, axis=1).max() > 0.01
    np.testing.assert_allclose(robot.markers.positions(state.positions), robot.marker_points, atol=1e-10)
    np.testing.assert_allclose(element_volumes(robot.body.mesh).sum(), element_volumes(plain.body.mesh).sum(), rtol=1e-2)
    assert robot.body.mass == pytest.approx(plain.body.mass, rel=1e-2)
    np.testing.assert_allclose(robot.body.mesh.nodes[robot.body.clamped], plain.body.mesh.nodes[plain.body.clamped])


def test_a_curved_body_answers_as_one_that_was_meshed_so() -> None:
    from femsense.fem.body import make_body

    robot = apply_effects(arm((4, 1, 1)), [{"name": "rest_shape", "axis_m": AXIS, "curvature_1_m": [4.0, 2.0]}])
    body = robot.body
    anew = make_body(
        body.mesh,
        young_modulus=300e3,
        poisson_ratio=0.45,
        density=1070.0,
        clamped=body.clamped,
        cables=body.cables,
        gravity=body.gravity,
    )
    states = [solve_equilibrium(one, tension={"up": 1.0}).positions for one in (body, anew)]
    np.testing.assert_allclose(*states, atol=1e-8)


def test_what_folds_over_and_what_is_no_axis_is_refused() -> None:
    robot = arm((4, 1, 1))
    for entry, message in (
        ({"name": "rest_shape", "axis_m": AXIS, "curvature_1_m": [300.0, 0.0]}, "fold over"),
        ({"name": "rest_shape", "axis_m": AXIS, "curvature_1_m": [1.0]}, "not two numbers"),
        ({"name": "stiffness_gradient", "axis_m": [[0, 0, 0], [0, 0, 0]], "per_m": 1.0}, "not an axis"),
        ({"name": "cable_path", "offset_m": {"north": [0, 0, 0]}}, "unknown cable"),
        ({"name": "cable_path"}, "are not declared"),
        ({"name": "cable_coupling", "from": "up", "to": "up", "share": 0.1}, "coupled with itself"),
        ({"name": "cable_coupling", "from": "up", "to": "west", "share": 0.1}, "unknown cable"),
    ):
        with pytest.raises(InputError, match=message):
            apply_effects(robot, [entry])


def path_of(robot, name: str) -> np.ndarray:  # type: ignore[no-untyped-def]
    cable = next(c for c in robot.body.cables if c.name == name)
    return np.asarray(cable.path.positions(robot.body.mesh.nodes))


def test_a_path_is_moved_across_the_body_or_about_its_axis() -> None:
    robot = arm((4, 2, 2))
    entry: Entry = {"name": "cable_path", "offset_m": {"up": [0.0, 0.001, 0.0]}}
    moved = apply_effects(robot, [entry])
    np.testing.assert_allclose(path_of(moved, "up"), path_of(robot, "up") + np.array([0.0, 0.001, 0.0]), atol=1e-12)
    np.testing.assert_array_equal(path_of(moved, "down"), path_of(robot, "down"))
    turned = apply_effects(robot, [{"name": "cable_path", "radius_scale": 1.25, "angle_rad": {"left": 0.3}}])
    np.testing.assert_allclose(path_of(turned, "up")[:, 1:], [[0.0, 0.01]] * 2, atol=1e-12)
    np.testing.assert_allclose(path_of(turned, "left")[:, 1:], [[0.01 * np.cos(0.3), 0.01 * np.sin(0.3)]] * 2, atol=1e-12)
    fine = robot_on_mesh(moved, finer_mesh(moved.body.mesh, None, 1))
    np.testing.assert_allclose(path_of(fine, "up"), path_of(moved, "up"), atol=1e-12)


def test_a_moved_cable_bends_the_arm_as_one_that_was_tied_there() -> None:
    moved = apply_effects(arm((6, 2, 2)), [{"name": "cable_path", "offset_m": {"up": [0.0, 0.0, -0.002]}}])
    robot = arm((6, 2, 2))
    from dataclasses import replace

    from femsense.fem.body import make_body, tie_cable

    up = tie_cable(robot.body.mesh, "up", path_of(moved, "up"), robot.body.cables[0].pull_point)
    body = robot.body
    tied = make_body(
        body.mesh,
        young_modulus=300e3,
        poisson_ratio=0.45,
        density=1070.0,
        clamped=body.clamped,
        cables=(up,),
        gravity=body.gravity,
    )
    pulled = [
        replace(robot, body=b).markers.positions(solve_equilibrium(b, tension={"up": 1.5}).positions) for b in (moved.body, tied)
    ]
    plain = robot.markers.positions(solve_equilibrium(body, tension={"up": 1.5}).positions)
    assert np.abs(pulled[0] - plain).max() > 2e-3
    np.testing.assert_allclose(*pulled, atol=1e-4)


def test_a_share_of_one_input_goes_to_another_after_its_gain() -> None:
    from femsense.model.drive import drive_of
    from femsense.model.recording import make_recording
    from femsense.model.recording_parts import Drives, Timeline

    robot = apply_effects(
        arm((3, 1, 1)),
        [
            {"name": "cable_coupling", "from": "up", "to": "left", "share": 0.1},
            {"name": "cable_gain", "scale": {"up": 2.0}},
            {"name": "cable_offset", "tension_n": {"left": 0.5}},
        ],
    )
    recording = make_recording(Timeline([0.0]), drives=Drives(("up", "down", "left", "right"), [[1.0, 2.0, 3.0, 4.0]]))
    np.testing.assert_allclose(drive_of(robot, recording).inputs, [[2.0, 2.0, 3.7, 4.0]])
    script = check_script(
        {
            "format": "femsense-script-1",
            "sweeps": [{"label": "s", "cables": {"up": 1.0, "down": 2.0, "left": 3.0, "right": 4.0}, "up": 1, "down": 0}],
            "camera": {"eye_m": [0.05, 0.2, 0.1], "target_m": [0.05, 0.0, 0.0]},
        }
    )
    np.testing.assert_allclose(true_inputs(robot, plan_script(script, robot)), [[2.0, 2.0, 3.7, 4.0]])


def test_robot_toml_round_trip(tmp_path: Path) -> None:
    entries: list[Entry] = [
        {"name": "cable_path", "offset_m": {"top": [0.0, 0.001, 0.0]}},
        {"name": "cable_path", "radius_scale": 1.1, "angle_rad": {"top": 0.02}},
        {"name": "stiffness_gradient", "axis_m": AXIS, "per_m": 3.0},
        {"name": "rest_shape", "axis_m": AXIS, "curvature_1_m": [0.5, -0.2]},
    ]
    robot = load_robot(write_block_robot(tmp_path, effects=entries))
    assert robot_document(robot)["effects"] == entries
    assert np.ptp(robot.body.material.young_modulus) > 0
    assert np.abs(robot.body.mesh.nodes - load_robot(tmp_path, effects=False).body.mesh.nodes).max() > 1e-3
