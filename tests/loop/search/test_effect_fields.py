"""Which parts of an effect are tried alone."""

from __future__ import annotations

from arm import arm

from femsense.loop.search.effect_fields import parts_of
from femsense.model.effects import find_effect


def test_parts_are_cables_markers_and_keys():
    robot = arm()
    assert [len(p) for p in parts_of(find_effect("cable_gain").parameters(robot, "tension"))] == [1] * 4
    assert [len(p) for p in parts_of(find_effect("marker_offset").parameters(robot, "tension"))] == [3] * 12
    assert [len(p) for p in parts_of(find_effect("depth_scale").parameters(robot, "tension"))] == [1, 1]
    assert len(parts_of(find_effect("payload").parameters(robot, "tension"))) == 1
