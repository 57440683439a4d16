"""Rays onto a surface: distances along its normal, grazing rays left out."""

from __future__ import annotations

import numpy as np

from femsense.pointcloud.rays import GRAZING, Surface

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def test_the_residual_is_the_distance_along_the_normal_of_the_face_that_the_ray_meets():
    points = np.array([[0.1, 0.2, 0.003], [-0.3, 0.1, -0.002]])
    camera = np.array([0.3, 0.0, 1.0])
    hits = Surface(SQUARE, TRIANGLES).cast(points, np.tile(camera, (2, 1)), reach=0.01)
    np.testing.assert_allclose(hits.distance, [0.003, -0.002], atol=1e-9)
    met = hits.place(SQUARE)
    np.testing.assert_allclose(np.cross(met - camera, points - camera), 0.0, atol=1e-5)
    np.testing.assert_allclose(met[:, 2], 0.0, atol=1e-9)


def test_grazing_rays_and_points_beyond_reach_are_left_out():
    camera = np.array([0.0, 0.0, 0.1])
    steep, flat = np.array([0.01, 0.0, 0.001]), np.array([0.9, 0.0, 0.001])
    assert 0.1 / np.hypot(0.9, 0.1) < GRAZING
    hits = Surface(SQUARE, TRIANGLES).cast(np.array([flat, steep, [0.0, 0.0, 0.05]]), np.tile(camera, (3, 1)), reach=0.01)
    assert hits.index.tolist() == [1]


def test_a_ray_that_misses_counts_by_the_closest_face_that_looks_at_the_camera():
    beside = np.array([[1.02, 0.0, 0.001]])
    surface, camera = Surface(SQUARE, TRIANGLES), np.array([[1.05, 0.0, 1.0]])
    assert len(surface.cast(beside, camera, reach=0.01).index) == 0
    assert surface.near(beside, camera, reach=0.05).index.tolist() == [0]
    assert len(surface.near(beside, -camera, reach=0.05).index) == 0


def test_rays_that_meet_the_surface_pass_it_at_no_distance_and_others_beside_or_behind_their_point():
    camera = np.array([0.0, 0.0, 1.0])
    met, beside, in_front = (
        np.array([0.1, 0.2, 0.5]),
        np.array([1.05, 0.0, 0.0]),
        0.05 * camera + 0.95 * np.array([1.05, 0.0, 0.0]),
    )
    far, behind = Surface(SQUARE, TRIANGLES).beside_rays(np.array([met, beside, in_front]), np.tile(camera, (3, 1)))
    along = np.array([1.05, 0.0, -1.0]) / np.hypot(1.05, 1.0)
    foot = (np.array([1.0, 0.0, 0.0]) - beside) @ along  # of the edge of the square on the ray, from the point beside it
    np.testing.assert_allclose(far, [0.0, *np.full(2, 0.05 / np.hypot(1.05, 1.0))], rtol=1e-3)
    np.testing.assert_allclose(behind[1:], [foot, foot + 0.05 * np.hypot(1.05, 1.0)], atol=2e-3)


def test_points_inside_have_a_negative_distance_and_those_far_off_are_outside():
    corner = Surface(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    points = np.array([[0.1, 0.2, 0.2], [-0.2, 0.2, 0.2]])
    np.testing.assert_allclose(corner.signed_gap(points, within=0.3), [-0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(corner.signed_gap(points, within=0.05), [0.1, 0.2], atol=1e-6)
