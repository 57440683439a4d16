"""What a scan takes for the robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record

from femsense.calib.scan import MARGIN, Scan, read_scan
from femsense.core.arrays import FloatArray
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.model.camera import Camera
from femsense.pointcloud.cloud import PointCloud, cloud_from_depth

BLUE, GRAY, TINTED = [0.2, 0.4, 0.8], [0.12, 0.12, 0.13], [0.05, 0.09, 0.19]


def square(low: float, high: float, z: float) -> FloatArray:
    """Return points on a square millimetre grid from low to high along the arm, at a height [m]."""
    x, y = np.meshgrid(np.arange(low, high, 1e-3), np.arange(-0.01, 0.01, 1e-3))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def scanned(folder: Path, points: FloatArray, colors: FloatArray) -> Scan:
    """Return the scan of one cloud, given in the robot frame."""
    robot = arm()
    cloud = PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), colors)
    write_cloud(folder / "0.ply", cloud)
    recording, _ = record(np.zeros((1, 4)), noise=0.0)
    recording = replace(recording, cloud_files=((folder / "0.ply",),), color_files=((None,),))
    scan = read_scan(robot, recording, 0, (T_ROBOT_CAMERA,), robot.body.mesh.nodes)
    assert scan is not None
    return scan


@pytest.mark.parametrize("shadow", [False, True])
def test_a_dark_point_is_of_the_robot_where_those_around_it_are(tmp_path, shadow):
    """Dark gray has any hue by noise: every tenth point of a dark plate has the robot's. A shadow on the robot stays the robot."""
    arm_points, plate = square(0.0, 0.06, 0.01), square(0.07, 0.1, 0.013)
    colors = np.vstack([np.tile(BLUE, (len(arm_points), 1)), np.tile(GRAY, (len(plate), 1))])
    inner = np.flatnonzero(np.abs(plate[:, 1]) < 0.007)[4::11]
    colors[len(arm_points) + inner] = TINTED
    if shadow:
        colors[: len(arm_points)][arm_points[:, 0] < 0.02] = TINTED
    scan = scanned(tmp_path, np.vstack([arm_points, plate]), colors)
    assert scan.segmented
    assert len(scan.view) == len(arm_points)
    assert scan.points((T_ROBOT_CAMERA,))[:, 2].max() < 0.011


@pytest.mark.parametrize("name", ["0.png", "0.ply"])
def test_pixels_that_saw_two_surfaces_are_no_points_of_a_scan(tmp_path, name):
    """A step of 20 mm seen from above, with a column of pixels half way between; as an image, and as a file of its points."""
    depth = np.full((16, 40), 2900, dtype=np.uint16)
    depth[:, 20], depth[:, 21:] = 3000, 3100
    if name == "0.png":
        cv2.imwrite(str(tmp_path / name), depth)
    else:
        write_cloud(tmp_path / name, cloud_from_depth(depth, 300.0, 300.0, 19.5, 7.5, depth_unit_m=1e-4))
    above = make_pose(rotation_from_vector([np.pi, 0.0, 0.0]), [0.05, 0.0, 0.3])
    recording, _ = record(np.zeros((1, 4)), noise=0.0)
    camera = Camera("", 40, 16, 300.0, 300.0, 19.5, 7.5, np.zeros(5), 1e-4)
    recording = replace(recording, cameras=(camera,), cloud_files=((tmp_path / name,),), color_files=((None,),))
    scan = read_scan(arm(), recording, 0, (above,), arm().body.mesh.nodes)
    assert scan is not None
    heights = np.unique(scan.points((above,))[:, 2].round(6))
    assert heights.tolist() == [-0.01, 0.01] and len(scan.view) == 16 * 39


@pytest.mark.parametrize("lens", [np.zeros(5), np.array([0.1, -0.05, 0.001, 0.0, 0.0])])
def test_of_a_depth_image_what_is_near_the_body_is_read_and_some_of_the_rest(tmp_path: Path, lens: FloatArray) -> None:
    """A wall 0.3 m behind the arm fills the image; its points are background, and all points in the box about the body are those of the whole cloud."""
    robot, T = arm(), T_ROBOT_CAMERA
    camera = Camera("", 320, 240, 220.0, 220.0, 160.0, 120.0, lens, 1e-4)
    depth = np.full((240, 320), int(1e4 * (np.linalg.norm(T[:3, 3]) + 0.3)), dtype=np.uint16)
    depth[90:150, 120:200] = int(1e4 * np.linalg.norm(T[:3, 3]))
    cv2.imwrite(str(tmp_path / "0.png"), depth)
    recording, _ = record(np.zeros((1, 4)), noise=0.0)
    recording = replace(recording, cloud_files=((tmp_path / "0.png",),), color_files=((None,),), cameras=(camera,))
    scan = read_scan(robot, recording, 0, (T,), robot.body.mesh.nodes)
    cloud = read_frame_cloud(recording, 0, mixed=False)
    assert scan is not None and cloud is not None
    size = np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0))
    placed, nodes = transform_points(T, cloud.points), robot.body.mesh.nodes
    inside = ((placed >= nodes.min(axis=0) - MARGIN * size) & (placed <= nodes.max(axis=0) + MARGIN * size)).all(axis=1)
    assert 500 < inside.sum() < 0.3 * len(placed)
    np.testing.assert_allclose(scan.points((T,)), placed[inside], atol=1e-12)
    far = scan.background((T,))
    beyond = ((far < nodes.min(axis=0) - MARGIN * size) | (far > nodes.max(axis=0) + MARGIN * size)).any(axis=1)
    assert 300 < len(far) < 1500 and beyond.all()
