"""Real Kinect clouds: rigid scenes with known objects."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import DATA

from femsense.io.clouds.cloud_files import read_cloud
from femsense.io.clouds.pcd import read_pcd_fields
from femsense.pointcloud import (
    PointCloud,
    find_plane,
    objects_on_plane,
    pass_through,
    region_growing,
    voxel_grid,
)

KINECT = DATA / "kinect"
LABELLED = KINECT / "mOSD_test31.pcd"
BOTTLES = KINECT / "pcl_milk_cartoon_all_small_clorox.pcd"

pytestmark = pytest.mark.skipif(not LABELLED.is_file() or not BOTTLES.is_file(), reason="the Kinect clouds are not here")


def labelled() -> tuple[PointCloud, np.ndarray]:
    fields = read_pcd_fields(LABELLED)
    return read_cloud(LABELLED), fields["label"][np.isfinite(fields["x"])]


def test_fields_and_points_of_the_labelled_cloud() -> None:
    cloud, label = labelled()
    names, counts = np.unique(label, return_counts=True)
    assert dict(zip(names.tolist(), counts.tolist())) == {1: 138329, 20: 12425, 30: 9906, 40: 10249}
    assert len(cloud) == len(label) == 170909
    assert cloud.colors is not None and 0.3 < cloud.colors.mean() < 0.7


def test_plane_and_clusters_give_the_three_labelled_objects() -> None:
    """Two stand on the table; the third, a can, stands on one of them (a tin)."""
    cloud, label = labelled()
    objects = objects_on_plane(
        cloud.points, plane_distance_m=0.006, cluster_distance_m=0.006, normal_radius_m=0.01, min_size=1000
    )
    assert objects.max() == 2
    iou = {
        name: max(((label == name) & (objects == k)).sum() / ((label == name) | (objects == k)).sum() for k in range(3))
        for name in (20, 30, 40)
    }
    assert iou[20] > 0.95 and iou[30] > 0.98 and iou[40] > 0.98, iou
    assert (label[objects >= 0] != 1).mean() > 0.999


def bottles() -> tuple[PointCloud, np.ndarray]:
    """Return the scene up to 1.6 m in 5 mm voxels, and the height of its points above the floor [m]."""
    cloud = voxel_grid(pass_through(read_cloud(BOTTLES), [[-9, -9, 0], [9, 9, 1.6]]), 0.005)
    return cloud, find_plane(cloud.points, 0.01).distance(cloud.points)


def test_colour_regions_part_the_bottles_from_the_floor() -> None:
    """A white and a blue bottle, the yellow cap of the blue one, a many-coloured carton; the carpet is brown."""
    cloud, height = bottles()
    assert cloud.colors is not None
    regions = region_growing(
        cloud, radius_m=0.012, color_threshold=0.04, merge_threshold=0.06, min_size=150, brightness_weight=0.6
    )
    floor = regions == 0
    assert floor[height < 0.01].mean() > 0.99
    colors = np.array([cloud.colors[regions == k].mean(axis=0) for k in range(regions.max() + 1)])
    sizes = np.bincount(regions[regions >= 0])
    raised = np.array([np.median(height[regions == k]) for k in range(len(sizes))])
    high = (sizes > 200) & (raised > 0.05)
    white = high & (colors.min(axis=1) > 0.3) & (sizes > 1000)
    blue = high & (colors[:, 2] > 2.0 * colors[:, :2].max(axis=1)) & (sizes > 800)
    yellow = high & (colors[:, :2].min(axis=1) > 2.0 * colors[:, 2])
    assert white.sum() == blue.sum() == yellow.sum() == 1
    for chosen, top in ((white, 0.25), (blue, 0.16), (yellow, 0.21)):
        own = height[regions == np.flatnonzero(chosen)[0]]
        assert (own > 0.01).mean() > 0.97
        assert abs(np.quantile(own, 0.98) - top) < 0.02


def test_the_carton_stands_between_the_bottles_once_the_floor_is_gone() -> None:
    cloud, height = bottles()
    near = cloud.select((height > 0.012) & (cloud.points[:, 2] < 1.0))
    regions = region_growing(
        near, radius_m=0.012, color_threshold=0.04, merge_threshold=0.06, min_size=100, brightness_weight=0.6
    )
    assert near.colors is not None
    side = [
        {int(k) for k in np.unique(regions[mask & (regions >= 0)]) if (regions[mask] == k).sum() > 50}
        for mask in (near.points[:, 0] < -0.14, np.abs(near.points[:, 0] + 0.04) < 0.09, near.points[:, 0] > 0.08)
    ]
    assert all(side), "every object has regions"
    assert not side[0] & side[1] and not side[1] & side[2] and not side[0] & side[2]
