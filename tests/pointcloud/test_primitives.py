"""Objects seen from one side are completed, and touch where the completed one does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from femsense.core.pose import move_pose, transform_points
from femsense.pointcloud.primitives import find_shapes, fit_shape
from femsense.sensing.places import fit_again

CAMERA = np.array([0.0, 0.0, 0.5])
NOISE = 5e-4


def seen(points: np.ndarray, normals: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points that look at the camera with noise along their rays, its standard deviation and their origins."""
    facing = np.einsum("pc,pc->p", normals, CAMERA - points) > 0
    ray = points[facing] - CAMERA
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    noisy = points[facing] + NOISE * rng.normal(size=(len(ray), 1)) * ray
    return noisy, np.full(len(noisy), NOISE), np.tile(CAMERA, (len(noisy), 1))


def ball(radius: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    normals = rng.normal(size=(600, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return radius * normals, normals


def rod(radius: float, half: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    angle, along = rng.uniform(0, 2 * np.pi, 900), rng.uniform(-half, half, 900)
    normals = np.column_stack([np.zeros(900), np.cos(angle), np.sin(angle)])
    return radius * normals + along[:, None] * [1.0, 0, 0], normals


def test_a_ball_is_completed_from_the_half_that_is_seen():
    points, std, origins = seen(*ball(0.01, np.random.default_rng(1)), np.random.default_rng(2))
    shape = fit_shape(points, std, origins)
    assert shape.kind == "sphere"
    assert np.linalg.norm(shape.center) < 5e-4
    assert abs(shape.radius - 0.01) < 5e-4
    wall = np.column_stack([np.full(41, 0.01), np.zeros(41), np.linspace(-0.01, 0.01, 41)])  # touched at the side, at z = 0
    assert abs(wall[np.argmin(shape.distance(wall)), 2]) < 1e-3
    visible = np.linalg.norm(wall[:, None] - points[None], axis=2).min(axis=1)
    assert wall[np.argmin(visible), 2] > 1e-3  # the closest visible points lie towards the camera


@pytest.mark.parametrize("make", [ball, rod])
def test_a_shape_that_moves_keeps_its_distances_and_what_is_known_of_it(make: Callable[..., tuple[np.ndarray, np.ndarray]]):
    rng = np.random.default_rng(1)
    size = (0.01,) if make is ball else (0.01, 0.02)
    shape = fit_shape(*seen(*make(*size, rng), rng))
    T = move_pose(np.eye(4), np.array([0.3, -0.2, 0.5, 0.01, -0.02, 0.03]))
    places = rng.normal(scale=0.03, size=(50, 3))
    there, moved = transform_points(T, places), shape.moved(T)
    np.testing.assert_allclose(moved.distance(there), shape.distance(places), atol=1e-9)
    np.testing.assert_allclose(moved.towards(there).std_m, shape.towards(places).std_m, rtol=1e-6)


def test_objects_say_which_camera_shows_them():
    rng = np.random.default_rng(3)
    points, std, origins = seen(*ball(0.01, rng), rng)
    view = (rng.random(len(points)) < 0.25).astype(np.int64)
    (shape,) = find_shapes(points, std, origins, np.abs(points[:, 0] - 0.01), local_m=0.1, view=view)
    assert shape.seen_by == pytest.approx([1.0 - view.mean(), view.mean()])


def test_a_rod_is_a_cylinder_whose_ends_are_where_it_was_seen():
    points, std, origins = seen(*rod(0.004, 0.03, np.random.default_rng(3)), np.random.default_rng(4))
    shape = fit_shape(points, std, origins)
    assert shape.kind == "cylinder"
    assert abs(shape.radius - 0.004) < 6e-4
    assert abs(abs(shape.axes[0] @ [1.0, 0, 0]) - 1.0) < 1e-2
    assert shape.distance(np.array([[0.05, 0.0, 0.0]]))[0] > 0.015


def test_a_plate_is_flat_and_ends():
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-0.02, 0.02, (400, 2)), np.zeros(400)])
    shape = fit_shape(*seen(points, np.tile([0.0, 0, 1], (400, 1)), rng))
    assert shape.kind == "plate"
    below, beside = shape.distance(np.array([[0.0, 0, -0.01], [0.06, 0, 0]]))
    assert abs(below + 0.01) < 1e-3
    assert 0.025 < beside < 0.045


def test_a_rod_that_passes_behind_something_is_one_object():
    points, std, origins = seen(*rod(0.004, 0.03, np.random.default_rng(6)), np.random.default_rng(7))
    apart = np.abs(points[:, 0]) > 0.012
    shapes = find_shapes(points[apart], std[apart], origins[apart], np.abs(points[apart, 0]), local_m=0.05)
    assert len(shapes) == 1
    assert shapes[0].kind == "cylinder"


def test_a_table_in_pieces_is_one_plate_and_what_stands_over_it_is_not():
    rng = np.random.default_rng(9)
    points = np.column_stack([rng.uniform(-0.06, 0.06, (2500, 2)), np.zeros(2500)])
    points = points[(np.abs(points[:, 0]) > 0.012) & ((np.abs(points[:, 1]) > 0.012) | (points[:, 0] < 0.0))]
    small = np.column_stack([rng.uniform(-0.004, 0.004, (60, 2)), np.full(60, 0.02)])
    points, std, origins = seen(np.vstack([points, small]), np.tile([0.0, 0, 1], (len(points) + 60, 1)), rng)
    shapes = find_shapes(points, std, origins, points[:, 2] + 0.05, local_m=0.2)
    assert [shape.kind for shape in shapes] == ["plate", "plate"]
    assert (shapes[0].half[:2] > 0.055).all()  # it reaches from end to end
    assert abs(shapes[1].center[2] - 0.02) < 1e-3


def test_a_plate_that_is_pressed_from_the_side_of_the_camera_touches_with_its_back():
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-0.02, 0.02, (400, 2)), np.zeros(400)])
    shape = fit_shape(*seen(points, np.tile([0.0, 0, 1], (400, 1)), rng))
    below = np.column_stack([rng.uniform(-0.03, 0.03, (200, 2)), rng.uniform(-0.03, -0.004, 200)])
    back, front = shape.towards(below), shape.towards(-below)
    places = np.array([[0.0, 0, -0.01], [0.0, 0, -0.02], [0.1, 0, -0.01]])
    np.testing.assert_allclose(back.distance(places[:2]), [0.01, 0.02], atol=1e-3)
    assert back.distance(places)[2] > 0.07
    assert back.behind_m == 2 * shape.half[:2].min()
    assert front is shape and front.behind_m == 0.0
    assert front.distance(places)[2] > 0.07  # beside it nothing is pressed


def test_what_lies_within_the_edge_of_a_body_is_no_object():
    """A strip of 1 mm beside a face, as a camera widens what it sees, and a ball that stands on it."""
    rng = np.random.default_rng(2)
    strip = rng.uniform([0.0, 0.0, 0.0], [0.04, 0.002, 0.001], size=(60, 3))
    ways = rng.normal((0.0, 0.0, 1.0), size=(200, 3))
    ball = np.array([0.08, 0.0, 0.006]) + 0.006 * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    points = np.vstack([strip, ball])
    std, origins = np.full(len(points), 1e-4), np.tile([0.05, 0.0, 0.3], (len(points), 1))
    asked = {"points": points, "std": std, "origins": origins, "near": points[:, 2], "local_m": 0.1}
    assert sorted(shape.kind for shape in find_shapes(**asked)) == ["points", "sphere"]
    kept = find_shapes(**asked, is_edge=lambda group: bool((points[group, 2] < 0.0015).all()))
    assert [shape.kind for shape in kept] == ["sphere"]


def cap(seed: int, radius: float = 0.01, count: int = 300) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return noisy points of the upper side of a ball about the origin, their noise, and the camera half a metre above."""
    rng = np.random.default_rng(seed)
    height, turn = rng.uniform(0.5, 1.0, count), rng.uniform(0.0, 2.0 * np.pi, count)
    across = np.sqrt(1.0 - height**2)
    points = radius * np.column_stack([across * np.cos(turn), across * np.sin(turn), height])
    origins, std = np.tile([0.0, 0.0, 0.5], (count, 1)), np.full(count, 3e-4)
    ray = (points - origins) / np.linalg.norm(points - origins, axis=1, keepdims=True)
    return points + std[:, None] * rng.normal(size=(count, 1)) * ray, std, origins


def test_each_side_of_a_ball_is_known_as_well_as_draws_of_noise_scatter_it() -> None:
    shapes = [fit_shape(*cap(seed)) for seed in range(40)]
    assert {shape.kind for shape in shapes} == {"sphere"}
    for side in (1.0, -1.0):  # that which is seen, and the hidden one
        place = np.array([[0.0, 0.0, 0.02 * side]])
        surface = [shape.center[2] + side * shape.radius for shape in shapes]
        stated = np.mean([shape.towards(place).std_m for shape in shapes])
        assert stated == pytest.approx(np.std(surface), rel=0.5)
    assert shapes[0].towards(np.array([[0.0, 0.0, -0.02]])).std_m > 5.0 * shapes[0].towards(np.array([[0.0, 0.0, 0.02]])).std_m


def test_a_ball_keeps_the_radius_of_the_frame_that_showed_it_better() -> None:
    well, badly = fit_shape(*cap(1, count=400)), cap(2, count=14)
    again = fit_again([well], *badly)
    assert again.kind == "sphere" and again.radius == well.radius and again.radius_std == pytest.approx(well.radius_std, rel=1e-6)
    assert fit_again([replace(well, center=well.center + 0.1)], *badly).radius != well.radius  # another ball
