"""Filters against a slow, clear second implementation, and the laws they obey."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from femsense.core.errors import InputError
from femsense.core.pose import rotation_from_vector
from femsense.pointcloud import PointCloud, estimate_normals, pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.grid import build_grid, count_within

SEEDS = st.integers(0, 2**32 - 1)


def random_cloud(seed: int, count: int = 120, extent: float = 1.0) -> PointCloud:
    rng = np.random.default_rng(seed)
    return PointCloud(rng.uniform(-extent, extent, size=(count, 3)), rng.random((count, 3)))


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a[:, None] - b[None], axis=2)


def test_pass_through_includes_its_faces() -> None:
    cloud = PointCloud([[0, 0, 0], [1, 1, 1], [1.0001, 0, 0], [0, -0.0001, 0]])
    assert pass_through(cloud, [[0, 0, 0], [1, 1, 1]]).points.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert len(pass_through(cloud, [[-np.inf] * 3, [np.inf] * 3])) == 4
    with pytest.raises(InputError, match=r"(?s)not a box.*lower corner first"):
        pass_through(cloud, [[0, 0, 0], [1, -1, 1]])


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, size=st.floats(0.05, 3.0))
def test_voxels_hold_the_means_of_their_points(seed: int, size: float) -> None:
    cloud = random_cloud(seed)
    voxels: dict[tuple[int, ...], list[int]] = {}
    for i, point in enumerate(cloud.points):
        voxels.setdefault(tuple(int(c) for c in np.floor(point / size)), []).append(i)
    result = voxel_grid(cloud, size)
    members = [voxels[key] for key in sorted(voxels)]
    np.testing.assert_allclose(result.points, [cloud.points[m].mean(axis=0) for m in members], atol=1e-12)
    np.testing.assert_allclose(result.colors, [cloud.colors[m].mean(axis=0) for m in members], atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_voxels_do_not_depend_on_the_order_and_move_with_whole_voxels(seed: int) -> None:
    cloud, rng = random_cloud(seed), np.random.default_rng(seed)
    result = voxel_grid(cloud, 0.25)
    np.testing.assert_allclose(voxel_grid(cloud.select(rng.permutation(len(cloud))), 0.25).points, result.points, atol=1e-12)
    shift = np.array([0.5, -1.0, 0.25])
    moved = PointCloud(cloud.points + shift, cloud.colors)
    np.testing.assert_allclose(voxel_grid(moved, 0.25).points, result.points + shift, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, radius=st.floats(0.05, 1.0), wanted=st.integers(0, 8))
def test_lone_points_are_those_with_few_others_near(seed: int, radius: float, wanted: int) -> None:
    cloud = random_cloud(seed)
    others = (distances(cloud.points, cloud.points) <= radius).sum(axis=1) - 1
    np.testing.assert_array_equal(remove_radius_outliers(cloud, radius, wanted).points, cloud.points[others >= wanted])


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, radius=st.floats(0.02, 2.0))
def test_neighbours_of_queries_inside_and_outside(seed: int, radius: float) -> None:
    points = random_cloud(seed).points
    queries = random_cloud(seed + 1, 80, 2.0).points
    np.testing.assert_array_equal(
        count_within(build_grid(points, radius), queries, radius), (distances(queries, points) <= radius).sum(axis=1)
    )


def test_outliers_do_not_depend_on_where_the_cloud_lies() -> None:
    cloud = random_cloud(5, 400)
    T = np.array([10.0, -20.0, 3.0])
    R = rotation_from_vector([0.3, -1.0, 0.7])
    kept = remove_radius_outliers(cloud, 0.2, 4).points
    np.testing.assert_allclose(
        remove_radius_outliers(PointCloud(cloud.points @ R.T + T), 0.2, 4).points, kept @ R.T + T, atol=1e-9
    )


def test_normals_of_a_noisy_sphere_face_the_camera() -> None:
    rng = np.random.default_rng(0)
    outward = rng.normal(size=(4000, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    points = 0.05 * outward + 1e-4 * rng.normal(size=outward.shape) + [0, 0, 0.4]
    normals, spread = estimate_normals(points, 0.008)
    cosine = np.einsum("ij,ij->i", normals, outward)
    assert np.quantile(np.abs(cosine), 0.01) > np.cos(np.deg2rad(5))
    np.testing.assert_array_less(0.0, np.einsum("ij,ij->i", normals, -points))
    assert 0.8e-4 < np.median(spread) < 2.5e-4  # the noise and the sphere's own curvature


def test_too_few_neighbours_give_no_normal() -> None:
    normals, spread = estimate_normals([[0.0, 0.0, 2.0]], 0.1)
    assert normals.tolist() == [[0.0, 0.0, -1.0]] and np.isnan(spread[0])


def test_empty_clouds_pass() -> None:
    empty = PointCloud(np.zeros((0, 3)))
    assert len(voxel_grid(empty, 0.1)) == len(remove_radius_outliers(empty, 0.1, 3)) == 0
    assert len(pass_through(empty, [[0, 0, 0], [1, 1, 1]])) == 0


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan])
def test_sizes_must_be_positive(size: float) -> None:
    with pytest.raises(InputError, match="size_m must be positive"):
        voxel_grid(random_cloud(0), size)


def test_voxels_that_cannot_be_counted_are_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)cells too small.*larger cells"):
        voxel_grid(PointCloud([[0, 0, 0], [1e6, 1e6, 1e6]]), 1e-3)
