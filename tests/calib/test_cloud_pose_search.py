"""A camera's pose from nowhere: what hides the body, and clutter without colour."""

from __future__ import annotations

import numpy as np
import pytest
from arm import arm, record
from clouded_arm import block

from femsense.calib.cloud_pose_search import View, difference, find_cloud_pose, settle_cloud_pose
from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles
from femsense.model.contact_patch import body_surface
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.frame_state import solve_frame
from femsense.pointcloud.rays import Surface
from femsense.pointcloud.segmentation import color_mask
from femsense.rig.camera import Shape, camera_of, cloud_of, look_at, render
from femsense.rig.scene import floor_shape
from femsense.rig.script import NoiseTable, ViewTable

INPUTS = np.array([[2.0, 0, 0, 0], [0, 0, 2.0, 0]])
BLUE, RED = np.array([0.2, 0.4, 0.8]), [0.8, 0.2, 0.2]


TABLE = floor_shape(-0.06, np.array([0.7, 0.6, 0.5]))
HOLDER = block([0.04, 0.06, 0.06], [-0.021, 0.0, 0.0], RED)
BOX = block([0.08, 0.06, 0.05], [0.12, 0.1, -0.035], RED)


def views_of(eye: list[float], roll: float, things: list[Shape], *, colored: bool) -> tuple[list[View], FloatArray]:
    """Return what a camera sees of the arm under two inputs, from another mesh and law, and its true pose."""
    recording, states = record(INPUTS)
    robot, truth = arm(), arm((8, 3, 3), law="neo_hookean")
    driven, triangles = DrivenRobot(robot, drive_of(robot, recording)), body_surface(robot.body.mesh).triangles
    T, rng, views = look_at(eye, [0.05, 0.0, 0.0], roll=roll), np.random.default_rng(5), []
    camera = camera_of(ViewTable(eye_m=[0, 0, 1], target_m=[0, 0, 0]))
    for k, state in enumerate(states):
        body = Shape(state, surface_triangles(truth.body.mesh), BLUE)
        cloud = cloud_of(render(camera, T, [body, *things], noise=NoiseTable(), rng=rng), camera)
        mine = color_mask(cloud.colors, BLUE) if colored else np.ones(len(cloud.points), dtype=bool)
        views.append(View(cloud.points, mine, Surface(solve_frame(driven, k).positions, triangles), colored))
    return views, T


def off(T: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Return by how much a pose is turned [deg] and shifted at the body's middle [m]."""
    mesh = arm().body.mesh
    turn, shift = difference(T, true, Surface(mesh.nodes, surface_triangles(mesh)))
    return float(np.degrees(turn)), shift


def test_what_hides_a_part_of_the_body_speaks_neither_for_a_pose_nor_against_it() -> None:
    eye = [0.05, -0.3, 0.12]
    half = block([0.05, 0.01, 0.08], [0.075, -0.1, 0.035], RED)
    views, T = views_of(eye, 0.4, [TABLE, HOLDER, half], colored=True)
    bare, _ = views_of(eye, 0.4, [TABLE, HOLDER], colored=True)
    seen, whole = settle_cloud_pose(views, T).gain, settle_cloud_pose(bare, T).gain
    assert whole > 0.8
    assert seen == pytest.approx(0.5 * whole, abs=0.15)  # half of the body says nothing


def test_the_body_is_found_though_a_third_and_more_of_it_is_hidden() -> None:
    post = block([0.027, 0.01, 0.08], [0.045, -0.1, 0.035], RED)
    views, T = views_of([0.05, -0.3, 0.12], 0.4, [TABLE, HOLDER, post], colored=True)
    turn, shift = off(find_cloud_pose(views).T_robot_camera, T)
    assert turn < 6.0 and shift < 6e-3


def test_a_slender_body_is_found_among_clutter_without_colour() -> None:
    views, T = views_of([-0.076, 0.133, 0.262], 5.04, [TABLE, HOLDER, BOX], colored=False)
    turn, shift = off(find_cloud_pose(views).T_robot_camera, T)
    assert turn < 6.0 and shift < 6e-3
