"""A camera that moved, beside contacts that only the shape shows: the background tells one from the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arm import arm
from touched_arm import PLACE, touched

from femsense.calib.calibrate import calibrate
from femsense.calib.scan import Scan, read_scan
from femsense.core.pose import moved_poses
from femsense.pointcloud.local_planes import local_planes
from femsense.sensing.background import off_background
from femsense.sensing.contact_free import learn
from femsense.sensing.pipeline import estimate
from femsense.sensing.prepare import make_sensor
from femsense.sensing.types import FrameReport

SHIFT, TURN = np.array([0.0, 0, 0, 0.0, 0.0012, 0.0016]), np.array([0.0, 0.004, 0.008, 0, 0, 0])
NEAR_CLAMP = np.array([0.02, 0.0, 0.01])


def last_frame(folder: Path, force: float = 0.0, **how: object) -> tuple[FrameReport, int]:
    """Return what the touched frame is said to be, and how many contacts it has; the free ones are ok."""
    how = {"ball": False, "place": NEAR_CLAMP, **how}
    seen = touched(folder, np.array([0.0, 0.0, -force]), **how)  # type: ignore[arg-type]
    run = estimate(arm(), seen, calibrate(arm(), seen))
    assert [frame.status for frame in run.frames[:3]] == ["ok"] * 3
    return run.frames[3], len(run.contacts)


@pytest.mark.parametrize("nudge", [SHIFT, TURN])
def test_a_camera_that_moved_is_named_with_how_far(tmp_path, nudge):
    status = last_frame(tmp_path, nudge=nudge, wall=True)[0].status
    assert "the camera seems to have moved by" in status
    assert "the background did" in status
    if nudge is SHIFT:
        assert "moved by 2.0 mm and 0.0°" in status
    else:
        assert "and 0.5°" in status


def test_where_nothing_stands_around_a_camera_that_moved_is_a_possibility(tmp_path):
    assert "the camera or the robot's base may have moved by" in last_frame(tmp_path, nudge=SHIFT)[0].status


def test_a_touch_near_the_clamp_is_no_camera_that_moved(tmp_path):
    report, contacts = last_frame(tmp_path, 0.4, wall=True)
    assert (report.status, contacts) == ("ok", 1)


@pytest.mark.parametrize("nudge", [0.3 * SHIFT, SHIFT, 0.3 * TURN, TURN])
def test_a_camera_that_moved_while_something_touches_that_is_seen_is_named(tmp_path, nudge):
    report, _ = last_frame(tmp_path, 0.15, ball=True, place=PLACE, nudge=nudge, wall=True)
    assert "the camera seems to have moved by" in report.status


@pytest.mark.parametrize("wall", [False, True])
def test_a_touch_that_is_seen_is_no_camera_that_moved(tmp_path, wall):
    report, contacts = last_frame(tmp_path, 0.15, ball=True, place=PLACE, wall=wall)
    assert (report.status, contacts) == ("ok", 1)


def test_points_off_the_background_move_with_the_pose_as_their_derivative_says(tmp_path):
    seen = touched(tmp_path, np.zeros(3), ball=False, wall=True)
    sensor = learn(make_sensor(arm(), seen, calibrate(arm(), seen))).sensor
    assert sensor.background is not None
    step, scan = (
        1e-4 * np.array([3.0, -2, 4, 1, 2, -1]),
        read_scan(arm(), seen, 2, sensor.calibration.poses, arm().body.mesh.nodes),
    )
    assert scan is not None
    here, by_pose = off_background(sensor, sensor.background, scan, sensor.calibration.poses)
    there, _ = off_background(sensor, sensor.background, scan, moved_poses(sensor.calibration.poses, step, sensor.pivot))
    assert np.median(np.abs(here)) < 1.0
    assert np.quantile(np.abs(there - here - by_pose @ step), 0.9) < 0.05 * np.abs(by_pose @ step).max()


def test_a_plane_that_is_seen_edge_on_says_nothing(tmp_path):
    """Depth does not move points off it: they were known without bound, and the equations of the pose had no solution."""
    seen = touched(tmp_path, np.zeros(3), ball=False, wall=True)
    sensor = make_sensor(arm(), seen, calibrate(arm(), seen))
    T = sensor.calibration.poses[0]
    y, z = np.meshgrid(np.linspace(-0.1, 0.1, 12), np.linspace(0.4, 0.6, 12))
    across = np.stack([y.ravel(), 0.3 * z.ravel(), z.ravel()], axis=1)  # contains the camera's ray, as y = 0.3 z holds its centre
    facing = np.stack([y.ravel(), z.ravel() - 0.5, np.full(144, 0.5)], axis=1)
    for points, said in ((across, False), (facing, True)):
        planes = local_planes(points @ T[:3, :3].T + T[:3, 3])
        nothing = np.zeros(0, dtype=np.int64)
        scan = Scan(
            np.zeros((0, 3)),
            nothing,
            np.zeros((0, 3)),
            nothing,
            far=points + np.array([0.0, 1e-3, 1e-3]),
            far_view=np.zeros(144, dtype=np.int64),
        )
        off, by_pose = off_background(sensor, planes, scan, sensor.calibration.poses)
        assert (np.abs(off) > 0).any() == said and (np.abs(by_pose) > 0).any() == said
