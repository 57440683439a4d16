"""A named effect gets a value for each cable once nothing else passes."""

from __future__ import annotations

import pytest
from arm import arm, record, sweeps

from femsense.loop.improve import improve
from femsense.loop.verdict.verdict import improved_name

TRUE = {"up": 0.4, "down": 0.1, "left": 0.25, "right": 0.25}


def test_friction_that_differs_between_cables_is_named_with_a_value_for_each() -> None:
    inputs, labels = sweeps()
    hidden = [{"name": "cable_friction", "coefficient": TRUE}]
    recording, _ = record(inputs, effects=hidden, labels=labels, truth=arm((4, 1, 1)))
    loop = improve(arm((4, 1, 1)), [recording], effects=["cable_friction"])
    (effect,) = loop.effects
    found = effect.parameters["coefficient"].value
    assert {name: pytest.approx(value, abs=0.06) for name, value in TRUE.items()} == found
    assert loop.robot.name == "arm-improved"


def test_a_returned_robot_has_a_name_of_its_own() -> None:
    assert [improved_name(name) for name in ("finger", "finger-improved", "finger-improved-2", "my-improved-arm")] == [
        "finger-improved",
        "finger-improved-2",
        "finger-improved-3",
        "my-improved-arm-improved",
    ]
