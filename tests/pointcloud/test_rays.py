"""Rays onto a surface: distances along its normal, grazing rays left out."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.pointcloud.casting import rays_through
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


def test_a_ray_that_misses_is_no_hit():
    beside = np.array([[1.02, 0.0, 0.001]])
    surface, camera = Surface(SQUARE, TRIANGLES), np.array([[1.05, 0.0, 1.0]])
    assert len(surface.cast(beside, camera, reach=0.01).index) == 0


def test_rays_that_meet_the_surface_pass_it_at_no_distance_and_others_beside_or_behind_their_point():
    camera = np.array([0.0, 0.0, 4.0])
    met, beside, off = np.array([0.1, 0.2, 0.5]), np.array([1.05, 0.0, 0.0]), np.array([1.3, 0.0, 0.0])
    in_front = 0.05 * camera + 0.95 * beside
    far, behind = Surface(SQUARE, TRIANGLES).beside_rays(np.array([met, beside, in_front, off]), camera, within=0.04)
    # An edge that is seen beside a ray at an angle γ passes it at the distance of the edge times that angle.
    np.testing.assert_allclose(far, [0.0, 0.05, 0.05, np.inf], rtol=0.05)
    np.testing.assert_allclose(behind[:2], [np.linalg.norm(met - camera) / 7.0, 0.0], atol=0.02)
    assert behind[2] == pytest.approx(0.05 * np.hypot(1.05, 4.0), rel=0.1)


def test_a_surface_that_is_partly_behind_the_camera_is_met():
    camera = np.array([0.0, 0.0, 0.05])
    points = np.array([[0.9, 0.9, 0.0], [0.8, 0.9, 0.0], [1.2, 0.9, 0.0]])
    met, weights, along = rays_through(points, camera).cast(SQUARE, TRIANGLES)
    assert met.tolist()[2] == -1 and (met[:2] >= 0).all()
    np.testing.assert_allclose(np.einsum("ri,ric->rc", weights[:2], SQUARE[TRIANGLES[met[:2]]]), points[:2], atol=1e-12)
    np.testing.assert_allclose(along[:2], np.linalg.norm(points[:2] - camera, axis=1))


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_projected_triangles_are_met_where_embree_meets_them(turn: float):
    """Also by rays through edges and at grazing incidence, and not through what lies in front."""
    rng, step = np.random.default_rng(3), np.linspace(-0.05, 0.05, 12)
    u, v = (a.ravel() for a in np.meshgrid(step, step))
    x = np.column_stack([u, v, 0.02 * np.sin(80.0 * u + turn) + 0.01 * rng.normal(size=len(u))])
    lower = np.arange(132).reshape(11, 12)[:, :11].ravel()
    triangles = np.vstack([np.column_stack([lower, lower + 1, lower + 12]), np.column_stack([lower + 1, lower + 13, lower + 12])])
    camera = np.array([0.3, -0.2, 0.4])
    points = rng.uniform(-0.07, 0.07, size=(3000, 3))
    met, weights, along = rays_through(points, camera).cast(x, triangles)
    hits = Surface(x, triangles).cast(points, np.tile(camera, (3000, 1)), reach=np.inf)
    steep = np.isin(np.arange(3000), hits.index)
    assert 500 < steep.sum() < 2500
    assert np.mean(met[hits.index] >= 0) == 1.0
    ways = (points - camera) / np.linalg.norm(points - camera, axis=1, keepdims=True)
    place = np.einsum("ri,ric->rc", weights[met >= 0], x[triangles[met[met >= 0]]])
    np.testing.assert_allclose(place, (camera + along[:, None] * ways)[met >= 0], atol=1e-12)
    np.testing.assert_allclose(
        np.einsum("ri,ric->rc", weights[hits.index], x[triangles[met[hits.index]]]), hits.place(x), atol=1e-5
    )


def test_points_inside_have_a_negative_distance_and_those_far_off_are_outside():
    corner = Surface(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    points = np.array([[0.1, 0.2, 0.2], [-0.2, 0.2, 0.2]])
    np.testing.assert_allclose(corner.signed_gap(points, within=0.3), [-0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(corner.signed_gap(points, within=0.05), [0.1, 0.2], atol=1e-6)
