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
from femsense.sensing.states import free_state
from femsense.sensing.touches import ways_of
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
        ways = sensor.robot.body.mesh.nodes[touch.patch.nodes] - touch.place
        long, wide, _ = np.sqrt(touch.patch.weights @ ways**2)
        assert long > 0.008 and wide < 0.004  # the force is spread along the rod


def test_a_plate_on_a_bent_arm_is_placed_as_well_as_its_tilt_is_known(sensor):
    nodes = sensor.robot.body.mesh.nodes
    bent = nodes - np.outer(
        2.0 * (nodes[:, 0] - 0.05) ** 2, [0.0, 0.0, 1.0]
    )  # curvature 4 / m: 1 mrad moves the place by 0.25 mm
    state = replace(free_state(sensor, 0, None, None), positions=bent)
    known = replace(sensor, knowledge=replace(sensor.knowledge, bias_m=0.0))
    spread = []
    for std in (1e-5, 1e-4):
        plate = Shape(
            "plate", np.array([0.05, 0.0, 0.01]), np.eye(3), np.array([0.02, 0.008, 0.0]), np.inf, std, np.zeros((0, 3))
        )
        (touch,) = object_touches(known, [plate], state)
        spread.append(touch.std_m)
    assert spread[1] > 1.1 * spread[0]
    assert plate.tilt_std(np.array([[0.02, 0.0, 0.0], [0.0, 0.004, 0.0]])) == pytest.approx(
        np.sqrt(3.0) * 1e-4 * np.array([1.0, 0.5])
    )
