"""Clouds of points: filters, segmentation, objects. Plain arrays and small frozen objects in and out."""

from femsense.pointcloud.cloud import PointCloud, cloud_from_depth
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.normals import estimate_normals
from femsense.pointcloud.objects import Plane, euclidean_clusters, find_plane, objects_on_plane, remove_plane
from femsense.pointcloud.segmentation import color_mask, region_growing, segment_by_model, segment_robot, shading_features

__all__ = [
    "Plane",
    "PointCloud",
    "cloud_from_depth",
    "color_mask",
    "estimate_normals",
    "euclidean_clusters",
    "find_plane",
    "objects_on_plane",
    "pass_through",
    "region_growing",
    "remove_plane",
    "remove_radius_outliers",
    "segment_by_model",
    "segment_robot",
    "shading_features",
    "voxel_grid",
]
