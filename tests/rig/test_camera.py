"""The rig's camera: known planes and balls come back, noise has the size that it should, a pose goes round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.io.clouds.cloud_files import read_cloud
from femsense.io.clouds.images import read_png
from femsense.io.clouds.ply import write_ply
from femsense.model.camera import Camera
from femsense.model.robot import Observation
from femsense.pointcloud.cloud import cloud_from_depth
from femsense.rig.camera import (
    Shape,
    camera_of,
    cloud_of,
    look_at,
    measured_points,
    pose_of,
    render,
    thinned,
    visible_points,
    write_images,
)
from femsense.rig.camera_tables import NoiseTable, ViewTable
from femsense.rig.depth_noise import depth_std
from femsense.rig.lens import pixel_rays

CAMERA = Camera("", 160, 120, 150.0, 140.0, 79.5, 59.5, np.zeros(5), 1e-4)
POSE = make_pose(rotation_from_vector([0.3, -0.2, 0.5]), [0.1, -0.2, 0.3])
GREY = np.full(3, 0.5)


def _wall(distance: float, half: float = 2.0) -> Shape:
    """A square across the optical axis of a camera at POSE."""
    corners = np.array([[-half, -half, distance], [half, -half, distance], [half, half, distance], [-half, half, distance]])
    return Shape(transform_points(POSE, corners), np.array([[0, 2, 1], [0, 3, 2]]), GREY)


def _ball(center: list[float], radius: float) -> Shape:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    ball.apply_translation(center)
    return Shape(np.array(ball.vertices), np.array(ball.faces), np.array([1.0, 0.0, 0.0]))


def test_a_wall_is_seen_where_it_stands() -> None:
    image = render(CAMERA, POSE, [_wall(0.42)])
    np.testing.assert_allclose(image.depth, 0.42, atol=1e-9)
    assert (image.shape == 0).all()


def test_a_ball_is_seen_where_it_is() -> None:
    center = transform_points(POSE, [[0.02, -0.01, 0.4]])[0]
    image = render(CAMERA, POSE, [_wall(0.6), _ball(center.tolist(), 0.05)])
    points = transform_points(POSE, cloud_of(image, CAMERA, image.shape == 1).points)
    radii = np.linalg.norm(points - center, axis=1)
    assert len(points) > 500
    assert radii.max() < 0.05 + 1e-7 and radii.min() > 0.0498
    assert np.all(image.color[image.shape == 1][:, 0] > 60) and np.all(image.color[image.shape == 1][:, 1] == 0)
    u, v = CAMERA.fx * 0.02 / 0.4 + CAMERA.cx, CAMERA.fy * -0.01 / 0.4 + CAMERA.cy
    seen = np.argwhere(image.shape == 1).mean(axis=0)
    np.testing.assert_allclose(seen, [v, u], atol=0.6)


def test_nothing_gives_no_depth() -> None:
    image = render(CAMERA, POSE, [_wall(0.4, half=0.02)])
    assert (image.shape == -1).any() and (image.depth[image.shape == -1] == 0).all()


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_noise_has_its_size_and_its_reach(share: float) -> None:
    noise = NoiseTable.model_validate({"correlated_share": share, "correlation_px": 2.0, "quantum_m": 1e-7})
    rng = np.random.default_rng(5)
    errors = np.array([render(CAMERA, POSE, [_wall(0.5)], noise=noise, rng=rng).depth - 0.5 for _ in range(6)])
    expected = 0.5**2 * 0.08 / (150.0 * 0.055)
    assert depth_std(np.array(0.5), noise, CAMERA) == pytest.approx(expected)
    assert errors.std() == pytest.approx(expected, rel=0.03)
    assert abs(errors.mean()) < 0.05 * expected
    neighbours = np.mean(errors[:, :, 1:] * errors[:, :, :-1]) / errors.var()
    assert neighbours == pytest.approx(share * np.exp(-1 / 16), abs=0.03)


def test_noise_grows_with_the_square_of_the_distance() -> None:
    noise = NoiseTable.model_validate({"quantum_m": 1e-7})
    rng = np.random.default_rng(6)
    spread = [np.std(render(CAMERA, POSE, [_wall(z)], noise=noise, rng=rng).depth) for z in (0.3, 0.6)]
    assert spread[1] / spread[0] == pytest.approx(4.0, rel=0.06)


def test_depths_come_in_steps() -> None:
    noise = NoiseTable.model_validate({"quantum_m": 0.002})
    depth = render(CAMERA, POSE, [_wall(0.5)], noise=noise, rng=np.random.default_rng(0)).depth
    np.testing.assert_allclose(depth / 0.002, np.rint(depth / 0.002), atol=1e-9)


def test_edges_and_oblique_surfaces_lose_depth() -> None:
    near = transform_points(POSE, [[0.0, 0.0, 0.3]])[0]
    shapes = [_wall(0.6), _ball(near.tolist(), 0.06)]
    noise = NoiseTable.model_validate({"edge_dropout": 1.0, "flying_share": 0.0, "grazing_deg": 60.0})
    image = render(CAMERA, POSE, shapes, noise=noise, rng=np.random.default_rng(1))
    ball = image.shape == 1
    assert 0.05 < (image.depth[ball] == 0).mean() < 0.5
    center = tuple(np.argwhere(ball).mean(axis=0).round().astype(int))
    assert image.depth[center] > 0
    oblique = NoiseTable.model_validate({"edge_dropout": 0.0, "flying_share": 0.0, "grazing_deg": 45.0})
    lost = (render(CAMERA, POSE, shapes, noise=oblique, rng=np.random.default_rng(1)).depth == 0) & ball
    assert 0.3 < lost.sum() / ball.sum() < 0.6  # a ball turns by 45° at 0.7 of its radius
    flying = NoiseTable.model_validate({"edge_dropout": 0.0, "flying_share": 1.0, "subpixel_px": 0.0})
    between = render(CAMERA, POSE, shapes, noise=flying, rng=np.random.default_rng(1)).depth
    assert ((between > 0.32) & (between < 0.58)).sum() > 50


def test_depth_scale_acts_along_the_ray() -> None:
    seen = Observation(depth_scale=1.02, depth_offset=-0.003)
    points = transform_points(POSE, pixel_rays(CAMERA).reshape(-1, 3) * 0.4)
    image = render(CAMERA, POSE, [_wall(0.4)], observation=seen)
    distance = np.linalg.norm(cloud_of(image, CAMERA).points, axis=1)
    np.testing.assert_allclose(
        distance, 1.02 * 0.4 * np.linalg.norm(pixel_rays(CAMERA).reshape(-1, 3), axis=1) - 0.003, atol=1e-7
    )
    np.testing.assert_allclose(measured_points(POSE, points, seen), cloud_of(image, CAMERA).points, atol=1e-7)


def test_measured_points_go_round() -> None:
    points = np.random.default_rng(2).uniform(-0.1, 0.1, (20, 3))
    local = measured_points(POSE, points, Observation())
    np.testing.assert_allclose(transform_points(POSE, local), points, atol=1e-15)
    np.testing.assert_allclose(local, transform_points(invert_pose(POSE), points), atol=1e-15)


def test_a_camera_looks_at_its_target_and_stands_upright() -> None:
    T = look_at([0.3, -0.4, 0.5], [0.0, 0.1, 0.05])
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    target = transform_points(invert_pose(T), [[0.0, 0.1, 0.05]])[0]
    np.testing.assert_allclose(target[:2], 0.0, atol=1e-14)
    assert target[2] > 0
    above = transform_points(invert_pose(T), [[0.0, 0.1, 0.15]])[0]
    assert above[1] < 0 and abs(above[0]) < 1e-14  # y points down
    rolled = look_at([0.3, -0.4, 0.5], [0.0, 0.1, 0.05], roll=np.pi / 2)
    np.testing.assert_allclose(rolled[:3, 0], T[:3, 1], atol=1e-14)
    assert np.isfinite(look_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])).all()
    with pytest.raises(InputError, match="target of a camera coincides"):
        look_at([0.0, 0.0, 1.0], [0.0, 0.0, 1.0])


def test_a_view_gives_lens_and_pose() -> None:
    view = ViewTable.model_validate({"width": 100, "height": 50, "fx": 80.0, "T_robot_camera": POSE.tolist()})
    camera = camera_of(view)
    assert (camera.fy, camera.cx, camera.cy) == (80.0, 49.5, 24.5)
    np.testing.assert_allclose(pose_of(view), POSE)


def test_what_hides_a_point() -> None:
    local = np.array([[0.0, 0.0, 0.4], [0.1, 0.0, 0.4], [0.0, 0.0, 0.7], [0.9, 0.0, 0.4], [0.0, 0.0, -0.4]])
    points = transform_points(POSE, local)
    alone = visible_points(CAMERA, POSE, [_wall(0.7)], points)
    assert alone.tolist() == [True, True, True, False, False]
    ball = _ball(transform_points(POSE, [[0.0, 0.0, 0.3]])[0].tolist(), 0.02)
    assert visible_points(CAMERA, POSE, [_wall(0.7), ball], points).tolist() == [False, True, False, False, False]


def test_clouds_and_images_read_back(tmp_path: Path) -> None:
    image = render(CAMERA, POSE, [_wall(0.5)], rng=np.random.default_rng(0))
    cloud = cloud_of(image, CAMERA)
    write_ply(tmp_path / "a.ply", cloud)
    back = read_cloud(tmp_path / "a.ply")
    np.testing.assert_allclose(back.points, cloud.points, atol=1e-7)
    assert back.colors is not None and cloud.colors is not None
    np.testing.assert_allclose(back.colors, cloud.colors, atol=1e-12)
    write_images(tmp_path / "d.png", tmp_path / "c.png", image, CAMERA)
    depth, color = read_png(tmp_path / "d.png"), read_png(tmp_path / "c.png")[..., ::-1]
    np.testing.assert_array_equal(color, image.color)
    again = cloud_from_depth(depth, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, CAMERA.distortion, CAMERA.depth_unit, color=color)
    np.testing.assert_allclose(again.points, cloud.points, atol=0.5e-4)
    np.testing.assert_array_equal(again.colors, cloud.colors)


def test_thinning_leaves_one_point_a_cube() -> None:
    image = render(CAMERA, POSE, [_wall(0.5)])
    cloud = thinned(cloud_of(image, CAMERA), 0.02)
    cubes = np.floor(cloud.points / 0.02).astype(int)
    assert len(np.unique(cubes, axis=0)) == len(cubes) > 50
