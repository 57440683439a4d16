"""Loads: what is believed of a declared gravity."""

from __future__ import annotations

import numpy as np
import pytest
from arm import arm

from femsense.model.effects import find_effect
from femsense.model.effects.loads import MOUNTED


def test_a_declared_gravity_is_believed_to_a_few_degrees() -> None:
    gravity, robot = find_effect("gravity"), arm((4, 2, 2))

    def cost(declared: list[float], found: list[float]) -> float:
        return gravity.prior_cost(robot.with_body(robot.body.with_gravity(np.array(declared))), np.array(found))

    down = [0.0, 0.0, -9.81]
    angles = np.radians([0.0, 5.0, 30.0, 180.0])
    costs = [cost(down, [9.81 * np.sin(a), 0.0, -9.81 * np.cos(a)]) for a in angles]
    np.testing.assert_allclose(costs, 5.0 * np.log1p((angles / MOUNTED) ** 2 / 4.0), atol=1e-9)
    assert cost([0.0, 0.0, 0.0], down) == 0.0


@pytest.mark.parametrize(("declared", "is_expected"), [([0.0, 0.0, 0.0], True), ([0.0, 0.0, -9.81], False)])
def test_every_body_has_weight_that_its_robot_does_not_declare(declared: list[float], is_expected: bool) -> None:
    robot = arm((4, 2, 2))
    assert find_effect("gravity").expected(robot.with_body(robot.body.with_gravity(np.array(declared)))) == is_expected
