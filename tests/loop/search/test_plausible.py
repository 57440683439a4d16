"""A load that nobody declared is a weight: a hanging body is not pulled upwards, unless nothing else serves. The truth has another mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import record
from tentacle import tentacle

from femsense.loop.improve import improve
from femsense.loop.result.loop_result import LoopResult
from femsense.model.effects import apply_effects, find_effect
from femsense.model.robot import Robot

SINGLE = np.array([[4.0, 0.0], [7.0, 0.0], [0.0, 4.0], [0.0, 7.0], [0.0, 0.0], [2.0, 0.0]])
BOTH = np.array([[3.1, 3.1], [6.2, 6.2], [6.2, 3.1]])
"""Tensions of runs with one tendon, which are fitted, and with both, which are held out [N]."""
GRADIENT = {"name": "stiffness_gradient", "axis_m": [[0.0, 0.0, 0.0], [0.0, 0.0, -0.36]], "per_m": 0.25}
"""The error of the model: no effect that is tried."""


def improved(truth: Robot) -> LoopResult:
    """Return what is found of a tentacle whose density is declared 1.4 times too high."""
    fitted, held = (
        replace(
            record(inputs, truth=truth, labels=[f"{i}" for i in range(len(inputs))], noise=2e-4, seed=i)[0], marker_noise_m=2e-4
        )
        for i, inputs in enumerate((SINGLE, BOTH))
    )
    return improve(tentacle(cells=(10, 2, 2)), [fitted], validation=[held], effects=["density", "payload"])


def test_too_high_a_density_beside_an_error_of_the_model_is_no_payload_that_pulls_a_hanging_body_upwards() -> None:
    loop = improved(apply_effects(tentacle(density=1050.0, modulus=400e3, cells=(12, 3, 3)), [GRADIENT]))
    assert loop.verdict == "unexplained" and [e.name for e in loop.effects] == ["stiffness"]
    (payload,) = (c for c in loop.candidates if c.name == "payload")
    assert any(r.dbic is not None and r.dbic > 10.0 for r in payload.refits)  # evidence alone would name it
    assert loop.after.validation_rms_m < 0.25 * loop.before.validation_rms_m


@pytest.mark.parametrize("down, force, plausible", [(-9.81, -0.1, True), (-9.81, 0.1, False), (0.0, 0.1, True)])
def test_a_payload_is_plausible_where_it_does_not_lift(down: float, force: float, plausible: bool) -> None:
    robot = tentacle(cells=(2, 1, 1))
    robot = robot.with_body(robot.body.with_gravity(np.array([0.0, 0.0, down])))
    assert find_effect("payload").plausible(robot, np.array([0.05, 0.0, force])) == plausible
    assert find_effect("payload").plausible(robot, np.array([0.3, 0.0, force]))  # a hose that pulls sideways
