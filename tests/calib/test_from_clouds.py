"""The clouds of free frames move the pose to where the markers alone would not bring it, and show the camera's noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record

from femsense.calib.calibrate import calibrate
from femsense.calib.files import read_calibration, write_calibration
from femsense.calib.from_clouds import fit_clouds, measured_noises
from femsense.core.pose import invert_pose, move_pose, transform_points
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud

INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.3, 0]])
NOISE = 5e-4


@pytest.fixture(scope="module")
def free(tmp_path_factory) -> Recording:
    """Three free frames with clouds; markers scatter by 1 mm."""
    recording, states = record(INPUTS, noise=1e-3)
    folder, rng = Path(tmp_path_factory.mktemp("free")), np.random.default_rng(3)
    triangles = surface_triangles(arm((8, 3, 3)).body.mesh)
    files = []
    for k, x in enumerate(states):
        facing = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - x[triangles].mean(axis=1)) > 0
        corners = x[triangles[facing]]
        points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(len(corners), 20)), corners).reshape(-1, 3)
        seen = transform_points(invert_pose(T_ROBOT_CAMERA), points)
        seen *= 1.0 + NOISE * rng.normal(size=(len(seen), 1)) / seen[:, 2:]
        write_cloud(folder / f"{k:06d}.ply", PointCloud(seen, np.tile([0.2, 0.4, 0.8], (len(seen), 1))))
        files.append((folder / f"{k:06d}.ply",))
    return replace(recording, free=np.ones(3, dtype=bool), cloud_files=tuple(files), color_files=((None,),) * 3)


def off(T: np.ndarray) -> float:
    """Return how far a pose brings the middle of the arm from where it is [m]."""
    middle = np.array([[0.05, 0.0, 0.0]])
    return float(np.linalg.norm(transform_points(T @ invert_pose(T_ROBOT_CAMERA), middle) - middle))


def test_clouds_bring_the_pose_nearer_than_markers_alone(free):
    robot = arm()
    by_markers = calibrate(robot, replace(free, cloud_files=((None,),) * 3))
    both = calibrate(robot, free)
    assert off(both.poses[0]) < 0.5 * off(by_markers.poses[0])
    assert off(both.poses[0]) < 3e-4
    assert (np.diag(both.pose_covariance) < np.diag(by_markers.pose_covariance)).all()
    assert np.isfinite(both.normal_rms_m)


def test_a_start_is_enough_without_markers(free):
    robot = arm()
    near = calibrate(robot, free)
    start = move_pose(T_ROBOT_CAMERA, [0.01, -0.01, 0.005, 0.002, -0.002, 0.003], pivot_a=[0.05, 0, 0])
    unknown = replace(near, poses=(start,), T_robot_camera=start, joint_covariance=np.zeros((6, 6)))
    assert off(start) > 3e-3
    assert off(fit_clouds(robot, free, unknown).poses[0]) < 4e-4


def test_a_start_from_which_no_ray_meets_the_body_stays(free):
    robot = arm()
    near = calibrate(robot, free)
    start = move_pose(T_ROBOT_CAMERA, [0, 0, 0, 0.0, 0.045, 0.0], pivot_a=[0.05, 0, 0])
    lost = replace(near, poses=(start,), T_robot_camera=start, joint_covariance=1e-4 * np.eye(6))
    np.testing.assert_array_equal(fit_clouds(robot, free, lost).poses[0], start)


def test_noise_that_is_not_declared_is_measured(free):
    robot = arm()
    calibration = calibrate(robot, free)
    distance = float(np.linalg.norm(T_ROBOT_CAMERA[:3, 3] - [0.05, 0, 0]))
    measured = measured_noises(robot, free, calibration)[0]
    assert float(measured.std(distance)) == pytest.approx(NOISE, rel=0.25)


def test_the_covariance_of_all_cameras_survives_its_file(free, tmp_path):
    calibration = calibrate(arm(), free)
    again = read_calibration(write_calibration(calibration, tmp_path / "calibration.json"))
    np.testing.assert_allclose(again.joint_covariance, calibration.joint_covariance)
    assert len(calibration.law_step) >= 6
    np.testing.assert_allclose(again.law_step, calibration.law_step)
    assert again.normal_rms_m == pytest.approx(calibration.normal_rms_m)


def test_clouds_of_a_body_that_errs_smoothly_do_not_overrule_markers(free, tmp_path):
    """All points lie off by a bow of 1 mm, as under another law: many of them, and yet one error."""
    recording, _ = record(INPUTS, noise=1e-4)
    files = []
    for k in range(3):
        cloud = read_cloud(free.cloud_files[k][0])
        points = transform_points(T_ROBOT_CAMERA, cloud.points)
        points[:, 1:] += 1e-3 * np.sin(np.pi * np.clip(points[:, :1], 0.0, 0.1) / 0.1)
        write_cloud(tmp_path / f"{k}.ply", PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), cloud.colors))
        files.append((tmp_path / f"{k}.ply",))
    bowed = replace(recording, free=np.ones(3, dtype=bool), cloud_files=tuple(files), color_files=((None,),) * 3)
    by_markers, both = calibrate(arm(), replace(bowed, cloud_files=((None,),) * 3)), calibrate(arm(), bowed)
    alone = fit_clouds(arm(), bowed, replace(by_markers, joint_covariance=np.zeros((6, 6))))
    assert off(alone.poses[0]) > 5e-4
    assert off(both.poses[0]) < 1e-4


def test_a_pose_that_is_only_guessed_pulls_no_answer_back(free):
    robot = arm()
    near = calibrate(robot, free)
    start = move_pose(T_ROBOT_CAMERA, [0.0, 0.0, 0.0, 0.002, -0.002, 0.003], pivot_a=[0.05, 0, 0])
    held = replace(near, poses=(start,), T_robot_camera=start, joint_covariance=np.diag([1e-4] * 3 + [1e-8] * 3))
    loose = replace(held, joint_covariance=np.diag([1e-2] * 3 + [1e-5] * 3))
    assert off(fit_clouds(robot, free, held).poses[0]) > 2e-3
    assert off(fit_clouds(robot, free, loose, guessed=(0,)).poses[0]) < 4e-4
