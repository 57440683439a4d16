"""Weight: densities and masses that turn with gravity, on finer meshes too, against weights that are computed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arm import arm
from helpers import write_block_robot

from femsense.fem.equilibrium import solve_equilibrium
from femsense.io.robot_toml import load_robot, robot_document
from femsense.model.effects import Entry, apply_effects, find_effect
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.model.robot import Robot

TIP = [0.1, 0.0, 0.0]
MASS = {"name": "tip_mass", "point_m": TIP, "mass_kg": 0.02}


def weight_of(robot: Robot) -> np.ndarray:
    return np.asarray(robot.body.weight().sum(axis=0))


def moment_of(robot: Robot) -> np.ndarray:
    return np.asarray(np.cross(robot.body.mesh.nodes, robot.body.weight()).sum(axis=0))


def test_a_density_scales_the_weight_of_the_body_and_not_what_it_carries() -> None:
    robot = arm((3, 1, 1))
    heavier = apply_effects(robot, [MASS, {"name": "density", "scale": 1.2}])
    own = 1070.0 * 0.1 * 0.02**2
    assert robot.body.mass == pytest.approx(own)
    np.testing.assert_allclose(weight_of(heavier), [0.0, 0.0, -9.81 * (1.2 * own + 0.02)])


@pytest.mark.parametrize("gravity", [[0.0, 0.0, -9.81], [0.0, 9.81, 0.0]])
def test_a_mass_is_a_weight_at_its_place_that_turns_with_gravity(gravity: list[float]) -> None:
    robot = arm((3, 1, 1))
    loaded = robot.with_body(apply_effects(robot, [MASS]).body.with_gravity(gravity))
    plain = robot.with_body(robot.body.with_gravity(gravity))
    np.testing.assert_allclose(weight_of(loaded) - weight_of(plain), 0.02 * np.array(gravity))
    np.testing.assert_allclose(moment_of(loaded) - moment_of(plain), 0.02 * np.cross(TIP, gravity), atol=1e-12)


def test_two_masses_add_and_stay_where_they_are_on_a_finer_mesh() -> None:
    robot = apply_effects(arm((3, 1, 1)), [MASS, {**MASS, "point_m": [0.05, 0.0, 0.01], "mass_kg": 0.01}])
    fine = robot_on_mesh(robot, finer_mesh(robot.body.mesh, None, 1))
    np.testing.assert_allclose(weight_of(fine), weight_of(robot))
    np.testing.assert_allclose(moment_of(fine), moment_of(robot), atol=1e-9)


def test_a_mass_bends_the_body_as_the_same_payload_does() -> None:
    robot = arm((3, 1, 1))
    payload = {"name": "payload", "point_m": TIP, "force_n": [0.0, 0.0, -9.81 * 0.02]}
    states = [solve_equilibrium(apply_effects(robot, [e]).body).positions for e in (MASS, payload)]
    np.testing.assert_allclose(*states, atol=1e-9)
    assert np.abs(states[0] - solve_equilibrium(robot.body).positions).max() > 1e-3


def test_a_weightless_body_has_neither() -> None:
    robot = arm((3, 1, 1))
    bare = robot.with_body(apply_effects(robot, [{"name": "density", "scale": 0.5}]).body)
    light = bare.with_body(bare.body.with_material(robot_without_mass(robot)))
    assert find_effect("density").parameters(robot, "tension") and not find_effect("density").parameters(light, "tension")
    assert find_effect("tip_mass").parameters(robot, "tension") and not find_effect("tip_mass").parameters(light, "tension")


def robot_without_mass(robot: Robot):  # type: ignore[no-untyped-def]
    from dataclasses import replace

    return replace(robot.body.material, density=0.0)


@pytest.mark.parametrize(("factor", "low", "high"), [(1.0, 0.0, 0.0), (1.2, 1.0, 4.0), (2.0, 8.0, 16.0), (0.5, 8.0, 16.0)])
def test_a_density_is_believed_to_a_tenth(factor: float, low: float, high: float) -> None:
    assert low <= find_effect("density").prior_cost(arm((3, 1, 1)), np.array([np.log(factor)])) <= high


def test_robot_toml_round_trip(tmp_path: Path) -> None:
    entries: list[Entry] = [{"name": "density", "scale": 1.1}, {**MASS, "point_m": [0.1, 0.015, 0.015]}]
    robot = load_robot(write_block_robot(tmp_path, effects=entries))
    assert robot_document(robot)["effects"] == entries
    plain = load_robot(tmp_path, effects=False)
    np.testing.assert_allclose(weight_of(robot), 1.1 * weight_of(plain) + 0.02 * plain.body.gravity)
