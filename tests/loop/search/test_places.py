"""Places that a fit moves stay on the body."""

from __future__ import annotations

import pytest
from arm import arm

from femsense.loop.search.location_search import lies_on_body
from femsense.loop.thresholds import DEFAULTS
from femsense.model.effects import find_effect


@pytest.mark.parametrize(("height", "on"), [(0.009, True), (0.0105, True), (0.0125, False), (-0.02, False)])
def test_a_load_hangs_on_the_body_or_hardly_beside_it(height: float, on: bool) -> None:
    robot = arm((4, 1, 1))  # 20 mm high, 100 mm long
    payload = find_effect("payload")
    parameters = payload.polish(robot, "tension", {"point_m": [0.08, 0.0, 0.01]})
    assert lies_on_body(robot, parameters, [0.08, 0.0, height], DEFAULTS) == on


def test_what_is_no_place_lies_anywhere() -> None:
    robot = arm((4, 1, 1))
    gain = find_effect("cable_gain").parameters(robot, "tension")
    assert lies_on_body(robot, gain, [9.0] * len(gain), DEFAULTS)
