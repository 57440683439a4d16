"""Where objects touch, and over how wide a patch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import arm
from touched_arm import touched

from femsense.calib.calibrate import calibrate
from femsense.core.pose import invert_pose, transform_points
from femsense.sensing.contact_free import learn
from femsense.sensing.estimate_frame import sense
from femsense.sensing.places import objects_near
from femsense.sensing.prepare import make_sensor, scan_of
from femsense.sensing.touches import contact_radius, make_touch, pressed, without_object
from femsense.sensing.types import SensedFrame, Sensor

FORCE = np.array([0.0, 0.0, -0.15])
AWAY = np.array([0.04, 0.0, 0.01])


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sensor, SensedFrame]:
    """Return a sensor and its frame in which a ball pushes."""
    folder: Path = tmp_path_factory.mktemp("ball")
    seen = touched(folder, FORCE, ball=True)
    model = learn(make_sensor(arm(), seen, calibrate(arm(), seen)))
    return model.sensor, sense(model, 3, None)


def test_a_patch_is_as_wide_as_hertz_has_it(pushed: tuple[Sensor, SensedFrame]) -> None:
    sensor, nodes = pushed[0], pushed[0].robot.body.mesh.nodes
    touch = make_touch(sensor, AWAY, source="cloud", radius=0.03)
    assert pressed(sensor, touch, np.zeros(3)).patch is touch.patch  # a point, as the mesh has it
    wide = pressed(sensor, touch, np.array([0.0, 0.0, -40.0]))
    a = contact_radius(sensor, 0.03, 40.0)
    assert a**3 == pytest.approx(0.75 * 40.0 * 0.03 * (1 - 0.45**2) / float(sensor.robot.body.material.young_modulus[0]))
    middle = wide.patch.mean(nodes)
    square = wide.patch.weights @ ((nodes[wide.patch.nodes] - middle) ** 2).sum(axis=1)
    assert square == pytest.approx(0.4 * a**2, rel=0.15)
    assert pressed(sensor, wide, np.array([0.0, 0.0, -41.0])) is wide


def test_a_line_contact_whose_object_is_gone_has_neither_zone_nor_line(pushed: tuple[Sensor, SensedFrame]) -> None:
    sensor = pushed[0]
    touch = replace(make_touch(sensor, AWAY, source="cloud", along=np.array([0.02, 0.0, 0.0])), line=np.array([1.0, 0.0, 0.0]))
    gone = without_object(sensor, touch)
    assert gone.source == "shape" and gone.along is None and not gone.line.any() and gone.std_m > 0.02


def test_what_stereo_adds_beside_the_silhouette_is_no_object_and_what_lies_in_front_of_it_is(pushed: tuple[Sensor, SensedFrame]):
    """A ball that hovers 12 mm in front of the arm's edge, and points of the same rays at the depth of that edge."""
    sensor, frame = pushed
    known = sensor.knowledge
    noises = tuple(replace(one, kind="stereo") for one in known.noises)
    stereo = replace(sensor, knowledge=replace(known, noises=noises, together=6.0))
    scan, body, camera = scan_of(sensor, 3, frame.state), frame.free_state, sensor.calibration.poses[0]
    assert scan is not None
    scan = replace(scan, camera_points=scan.camera_points[::16], view=scan.view[::16])  # a coarse camera: its halo is wide
    edge = body.positions[np.argmax(body.positions[:, 1] - np.abs(body.positions[:, 0] - 0.06))]
    towards = (camera[:3, 3] - edge) / np.linalg.norm(camera[:3, 3] - edge)
    out = np.random.default_rng(1).normal(size=(3000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    ball = edge + 0.012 * towards + [0.0, 0.0025, 0.0] + 0.002 * out[out @ towards > 0.2]
    rays = (ball - camera[:3, 3]) / np.linalg.norm(ball - camera[:3, 3], axis=1, keepdims=True)
    strip = camera[:3, 3] + np.linalg.norm(edge - camera[:3, 3]) * rays
    strip = strip[(strip[:, 1] > edge[1] + 1e-4) & (strip[:, 1] < edge[1] + 2e-3)]
    assert len(strip) > 12
    for points, kinds in ((ball, ["sphere"]), (strip, [])):
        others = transform_points(invert_pose(camera), points)
        seen = replace(scan, others=others, others_view=np.zeros(len(others), dtype=np.int64))
        assert [shape.kind for shape in objects_near(stereo, seen, body)] == kinds
