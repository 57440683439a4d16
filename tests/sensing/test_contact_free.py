"""What contact-free frames teach."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record
from touched_arm import touched

from femsense.calib.calibrate import calibrate
from femsense.core.pose import invert_pose, moved_poses, transform_points
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.model.effects import apply_effects
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.contact_free import learn
from femsense.sensing.pipeline import estimate
from femsense.sensing.prepare import POSE_STD, make_sensor, pose_covariance

FRICTION = [{"name": "cable_friction", "coefficient": 0.5}]


def pulled_and_let_go(folder: Path) -> Recording:
    """Return free frames of an arm whose cable rubs, the only cloud on the way back; then a frame with markers alone."""
    inputs = np.array([[0.0, 0, 0, 0], [1.5, 0, 0, 0], [3.0, 0, 0, 0], [1.2, 0, 0, 0], [1.2, 0, 0, 0]])
    recording, states = record(inputs, noise=1e-4, effects=FRICTION)
    true, rng = arm((8, 3, 3), law="neo_hookean"), np.random.default_rng(5)
    triangles = surface_triangles(true.body.mesh)
    x = states[3]
    corners = x[triangles]
    looks = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - corners.mean(axis=1)) > 0
    points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(int(looks.sum()), 12)), corners[looks]).reshape(-1, 3)
    ray = points - T_ROBOT_CAMERA[:3, 3]
    points = points + 3e-4 * rng.normal(size=(len(points), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    write_cloud(
        folder / "3.ply",
        PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), np.tile([0.2, 0.4, 0.8], (len(points), 1))),
    )
    files = tuple((folder / "3.ply" if k == 3 else None,) for k in range(5))
    return replace(recording, free=np.array([True] * 4 + [False]), cloud_files=files, color_files=((None,),) * 5)


def test_free_frames_remember_friction(tmp_path):
    recording, robot = pulled_and_let_go(tmp_path), apply_effects(arm(), FRICTION)
    calibration = calibrate(robot, recording)
    assert calibration.normal_rms_m == pytest.approx(2e-4, abs=1e-4)
    model = learn(make_sensor(robot, recording, calibration))
    assert abs(model.modulus_shift) < 0.05 and model.sensor.knowledge.bias_m < 3e-4


def test_a_declared_pose_is_not_taken_for_exact_where_clouds_tell_it(tmp_path):
    recording, robot = pulled_and_let_go(tmp_path), apply_effects(arm(), FRICTION)
    fitted = calibrate(robot, recording)
    off = moved_poses(fitted.poses, np.array([0.0, 4e-3, 0.0, 0.0, 0.0, 5e-4]), np.zeros(3))
    nobody = np.zeros_like(fitted.pose_covariance)
    declared = replace(fitted, poses=off, T_robot_camera=off[0], pose_covariance=nobody, joint_covariance=nobody)
    np.testing.assert_allclose(np.sqrt(np.diag(pose_covariance(recording, declared))), POSE_STD)
    sensor = learn(make_sensor(robot, recording, declared)).sensor
    moved = np.linalg.norm((sensor.calibration.poses[0] - off[0])[:3, :3])
    assert moved > 0.2 * np.linalg.norm((fitted.poses[0] - off[0])[:3, :3])
    assert sensor.knowledge.bias_m < 3e-4


def test_what_clouds_leave_does_not_judge_frames_with_markers_alone(tmp_path):
    """The markers of the last frame shake twice as much as in the others."""
    recording, robot = pulled_and_let_go(tmp_path), apply_effects(arm(), FRICTION)
    shaken = recording.marker_xyz + 1.7e-4 * np.random.default_rng(3).normal(size=recording.marker_xyz.shape) * (
        recording.marker_frame == 4
    ).reshape(-1, 1)
    run = estimate(robot, replace(recording, marker_xyz=shaken), calibrate(robot, recording))
    assert [frame.status for frame in run.frames] == ["ok"] * 5


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_mixed_pixels_are_counted_on_their_side(tmp_path: Path, share: float):
    """Some points lie 3 mm, or ten standard deviations, behind the face that they should show, as at edges of depth."""
    recording, rng = touched(tmp_path, np.zeros(3), ball=False), np.random.default_rng(4)
    for (file,) in recording.cloud_files:
        assert file is not None
        cloud = read_cloud(file)
        away = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
        write_cloud(file, replace(cloud, points=cloud.points + 3e-3 * away * (rng.random((len(away), 1)) < share)))
    model = learn(make_sensor(arm(), recording, calibrate(arm(), recording)))
    assert model.stray[0] < 3.0 and (model.stray[1] > 30.0) == (share > 0.0)


@pytest.mark.parametrize(
    ("points", "why", "status"),
    [
        (np.full((50, 3), np.nan), "sees less than", "the cloud is empty"),
        (np.full((50, 3), [0.0, 0.0, 9.0]), "sees less than", "none near the robot"),
        (None, "have no cloud", ""),
    ],
)
def test_clouds_that_show_no_robot_are_named(tmp_path: Path, points: np.ndarray | None, why: str, status: str):
    recording = touched(tmp_path, np.array([0.0, 0.0, -0.15]), ball=True)
    calibration = calibrate(arm(), recording)
    if points is None:
        recording = replace(recording, cloud_files=((None,),) * 3 + recording.cloud_files[3:])
    else:
        header = "ply\nformat ascii 1.0\nelement vertex 50\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        for k in range(3):
            (tmp_path / f"{k:06d}.ply").write_text(header + "\n".join(" ".join(map(str, point)) for point in points) + "\n")
    with pytest.warns(UserWarning, match=why):
        run = estimate(arm(), recording, calibration)
    assert status in run.frames[0].status and run.frames[3].contacts == 1
