"""Points of unorganised clouds go back to their pixels where their rays tell them, and mixed ones go as in a depth image."""

from __future__ import annotations

import numpy as np

from femsense.core.pose import rotation_from_vector
from femsense.pointcloud.cloud import PointCloud, cloud_from_depth, without_mixed_pixels
from femsense.pointcloud.pixel_grid import without_mixed_points

LENS = (500.0, 480.0, 14.3, 9.8)


def step() -> np.ndarray:
    """Return depths [mm] of a step whose edge runs obliquely, mixed pixels on it, and some pixels without depth."""
    row, column = np.mgrid[:20, :30]
    depth = np.where(column < 10 + 0.3 * row, 400.0, 500.0)
    depth[np.abs(column - 10 - 0.3 * row) < 0.5] = 450.0
    depth[5:8, 3] = 0.0
    return depth


def as_file(cloud: PointCloud) -> PointCloud:
    """Return a cloud in single precision and in another order."""
    order = np.random.default_rng(0).permutation(len(cloud))
    return PointCloud(cloud.points[order].astype(np.float32))


def test_what_a_depth_image_leaves_out_a_file_of_its_points_leaves_out_too() -> None:
    whole, left = (cloud_from_depth(image, *LENS) for image in (step(), without_mixed_pixels(step(), *LENS[:2])))
    found = without_mixed_points(as_file(whole))
    assert len(left) < len(whole) - 15
    expected = left.points.astype(np.float32)
    np.testing.assert_array_equal(found.points[np.lexsort(found.points.T)], expected[np.lexsort(expected.T)])


def test_a_cloud_without_pixels_stays_as_it_is() -> None:
    whole = as_file(cloud_from_depth(step(), *LENS))
    rng = np.random.default_rng(1)
    jittered = whole.points * np.append(1.0 + 0.01 * rng.standard_normal(2), 1.0) + 3e-4 * rng.standard_normal((len(whole), 3))
    turned = whole.points @ rotation_from_vector([0.0, 0.0, 0.3]).T
    column = np.round(LENS[0] * whole.points[:, 0] / whole.points[:, 2] + LENS[2]).astype(int)
    wobbling = whole.points + whole.points[:, 2:] / LENS[0] * np.outer(rng.choice([-0.2, 0.2], 30)[column], [1.0, 0.0, 0.0])
    twice = np.vstack([whole.points, whole.points * 1.1])
    for points in (jittered, turned, wobbling, twice, -whole.points, whole.points[:1], whole.points[:0]):
        assert len(without_mixed_points(PointCloud(points))) == len(points)


def test_digits_of_a_text_file_do_no_harm() -> None:
    """Ten micrometres at half a metre are a hundredth of a pixel."""
    whole, left = (cloud_from_depth(image, *LENS) for image in (step(), without_mixed_pixels(step(), *LENS[:2])))
    assert len(without_mixed_points(PointCloud(np.round(whole.points, 5)))) == len(left)
