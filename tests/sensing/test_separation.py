"""Robot and surroundings apart where no colour tells them."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import arm
from touched_arm import touched

from femsense.calib.calibrate import calibrate
from femsense.pointcloud.primitives import fit_shape
from femsense.pointcloud.rays import Surface
from femsense.sensing.pipeline import sense_frame
from femsense.sensing.places import seen_objects
from femsense.sensing.prepare import make_sensor, scan_of
from femsense.sensing.search import explain
from femsense.sensing.separation import segmented
from femsense.sensing.states import free_state
from femsense.sensing.types import SensedFrame, Sensor

FORCE = np.array([0.0, 0.0, -0.05])


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Sensor, SensedFrame, int]:
    """Return a sensor without colours, its frame in which a ball pushes, and how many points of the arm coloured clouds show there."""
    folder: Path = tmp_path_factory.mktemp("ball")
    seen = touched(folder, FORCE, ball=True)
    calibration = calibrate(arm(), seen)
    colored = sense_frame(make_sensor(arm(), seen, calibration), 3, None)
    sensor = make_sensor(replace(arm(), color_rgb=None), seen, calibration)
    return sensor, sense_frame(sensor, 3, None), colored.report.matched


def test_a_touch_is_found_and_the_robot_seen_whole(pushed):
    _, frame, count = pushed
    assert frame.report.status == "ok"
    assert frame.contacts[0].force_n == pytest.approx(0.05, rel=0.08)
    assert frame.report.matched == pytest.approx(count, rel=0.03)


def test_the_contacts_of_the_frame_before_tell_what_is_the_robots(pushed):
    """The state that they foretell is where the next frame begins: no search, a fraction of the work."""
    sensor, frame, _ = pushed
    scan = scan_of(sensor, 3, frame.state)
    assert scan is not None and not scan.segmented
    work = []
    for previous in (None, frame):
        began = time.process_time()
        few, _ = segmented(sensor, 3, scan, frame.free_state, previous, None)
        work.append(time.process_time() - began)
        assert few is not None
        assert few.measured.sum() == pytest.approx(frame.report.matched, rel=0.1)
    assert work[1] < 0.5 * work[0]


def test_contacts_that_are_gone_tell_nothing(pushed):
    """Frame 2 is free again: the body is seen where the inputs have it, all of it."""
    sensor, frame, _ = pushed
    frames = replace(sensor, recording=replace(sensor.recording, free=None))
    after = sense_frame(frames, 2, frame)
    assert not after.contacts
    assert after.report.matched > 0.95 * frame.report.matched


def test_points_are_not_separated_by_a_touch_that_is_gone(pushed):
    """Frame 2 is free again: its points are told apart as if nothing had touched before."""
    sensor, frame, _ = pushed
    frames = replace(sensor, recording=replace(sensor.recording, free=None))
    alone = free_state(frames, 2, frame.free_state, None)
    scan = scan_of(frames, 2, alone)
    after, fresh = (segmented(frames, 2, scan, alone, previous, None)[0] for previous in (frame, None))
    np.testing.assert_array_equal(after.others, fresh.others)
    np.testing.assert_allclose(after.camera_points, fresh.camera_points)


def test_a_touch_that_is_gone_leaves_no_contact_under_another_law(tmp_path: Path):
    """With the arm's own law a touch that is gone left 1.2 ± 1.2 mN, with status ok."""
    own = arm(law="neo_hookean")
    seen = touched(tmp_path, FORCE, ball=True)
    sensor = make_sensor(replace(own, color_rgb=None), seen, calibrate(own, seen))
    frame = sense_frame(sensor, 3, None)
    after = sense_frame(replace(sensor, recording=replace(seen, free=None)), 2, frame)
    assert frame.contacts and not after.contacts
    assert after.report.status == "ok" and after.report.matched > 0.99 * frame.report.matched


def test_a_few_points_beside_the_body_have_to_explain_more_than_free_frames_leave(pushed):
    """The ball that is seen whole makes a contact; eight of its points, which may be the robot's own, do where they explain enough."""
    sensor, frame, _ = pushed
    scan = scan_of(sensor, 3, frame.state)
    few, free = segmented(sensor, 3, scan, frame.free_state, frame, None)
    (ball,) = seen_objects(sensor, 3, few, frame.state)
    gap = Surface(frame.state.positions, sensor.surface.triangles).gap(ball.points)
    stray = fit_shape(ball.points[np.argsort(gap)[:8]], np.full(8, 1e-3), np.zeros((8, 3)))
    assert stray.kind == "points"
    for shapes, limit, found in (([ball], 1e9, True), ([stray], 1e9, False), ([stray], sensor.knowledge.gain_limit, True)):
        asked = replace(sensor, knowledge=replace(sensor.knowledge, gain_limit=limit))
        assert bool(explain(asked, 3, scan, few, shapes, free, None, None)[1].touches) == found
