"""Clouds of points: filters, segmentation, objects, contacts, matching. Plain arrays and small frozen objects in and out."""

from femsense.pointcloud.cloud import PointCloud, cloud_from_depth
from femsense.pointcloud.contact import Contacts, detect_contacts, map_to_features
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.matching import Matches, MatchingOptions, match_along_normals
from femsense.pointcloud.normals import estimate_normals
from femsense.pointcloud.objects import Plane, euclidean_clusters, find_plane, objects_on_plane, remove_plane
from femsense.pointcloud.segmentation import color_mask, region_growing, segment_by_model, segment_robot, shading_features

__all__ = [
    "Contacts",
    "Matches",
    "MatchingOptions",
    "Plane",
    "PointCloud",
    "cloud_from_depth",
    "color_mask",
    "detect_contacts",
    "estimate_normals",
    "euclidean_clusters",
    "find_plane",
    "map_to_features",
    "match_along_normals",
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
