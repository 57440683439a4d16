"""A rod that lies on a body: where it touches is known across it, and hardly along it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm
from touched_arm import touched

from femsense.calib.calibrate import calibrate
from femsense.pointcloud.primitives import Shape
from femsense.sensing.places import object_touches
from femsense.sensing.prepare import make_sensor
from femsense.sensing.search import held_on
from femsense.sensing.states import free_state
from femsense.sensing.touches import make_touch, place_cost, ways_of
from femsense.sensing.types import Sensor

RADIUS = 0.004


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> Sensor:
    seen = touched(tmp_path_factory.mktemp("arm"), np.zeros(3), ball=False)
    sensor = make_sensor(arm(), seen, calibrate(arm(), seen))
    return replace(sensor, knowledge=replace(sensor.knowledge, bias_m=3e-4))


def rod(tilt: float) -> Shape:
    """Return a rod along the upper face of the straight arm, 1 mm off its middle, that leans by so much [rad]."""
    axis = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    axes = np.vstack([axis, [0.0, 1.0, 0.0], np.cross(axis, [0.0, 1.0, 0.0])])
    half = np.array([0.08, RADIUS, RADIUS])
    return Shape("cylinder", np.array([0.06, 0.001, 0.01 + RADIUS]), axes, half, RADIUS, 3e-5, np.zeros((0, 3)))


def test_a_rod_is_placed_well_across_it_and_anywhere_along_it(sensor):
    state = replace(free_state(sensor, 0, None, None), positions=sensor.robot.body.mesh.nodes)
    for tilt in (0.0, 0.002, -0.002):  # as much as the model may be off between both ends
        (touch,) = object_touches(sensor, [rod(tilt)], state)
        ways, stds = ways_of(touch)
        assert abs(ways[0, 0]) > 0.98
        assert stds[0] > 0.012
        assert stds[1] < 0.003
        assert abs(touch.place[1] - 0.001) < 0.001
        assert abs(touch.place[0] - 0.05) < 2.0 * stds[0]


def test_a_place_costs_by_how_well_it_is_known_along_and_across(sensor):
    touch = make_touch(sensor, np.array([0.05, 0.0, 0.01]), source="cloud", std_m=0.01)
    lying = replace(touch, line=np.array([1.0, 0.0, 0.0]), across_m=0.001)
    off = replace(lying, place=touch.place + np.array([0.01, 0.002, 0.0]))
    assert place_cost(off) == pytest.approx(1.0 + 4.0)
    assert place_cost(replace(off, line=np.zeros(3))) == pytest.approx(1.04)
    assert place_cost(replace(off, std_m=0.0)) == 0.0
    assert not ways_of(replace(off, std_m=0.0))[1].any()


def test_a_rod_that_tips_over_is_one_contact(sensor):
    """One that is found far from where it was, but no farther than it may be, is no second one."""
    here, there = (make_touch(sensor, np.array([x, 0.0, 0.01]), source="cloud", std_m=0.02) for x in (0.03, 0.055))
    touches, kept = held_on(sensor, [here], [there], [True])
    assert len(touches) == 1
    assert list(kept) == [0]
    ball = replace(there, std_m=0.001)
    assert len(held_on(sensor, [here], [ball], [True])[0]) == 2
