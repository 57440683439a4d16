"""Clouds of points: files, filters, segmentation, objects, contacts, matching. Plain arrays and small frozen objects in and out."""

from femsense.io.clouds.cloud_files import read_cloud, write_cloud
from femsense.io.clouds.pcd import read_pcd_fields
from femsense.io.clouds.ply import read_ply_vertices
from femsense.pointcloud.cloud import PointCloud, cloud_from_depth
from femsense.pointcloud.contact import Contacts, detect_contacts, map_to_features
from femsense.pointcloud.filters import pass_through, remove_radius_outliers, voxel_grid
from femsense.pointcloud.matching import Matches, match_along_normals
from femsense.pointcloud.normals import estimate_normals
from femsense.pointcloud.objects import Plane, euclidean_clusters, find_plane, objects_on_plane, remove_plane
from femsense.pointcloud.segmentation import color_mask, region_growing, segment_by_model, segment_robot, shading_features

__all__ = [
    "Contacts",
    "Matches",
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
    "read_cloud",
    "read_pcd_fields",
    "read_ply_vertices",
    "region_growing",
    "remove_plane",
    "remove_radius_outliers",
    "segment_by_model",
    "segment_robot",
    "shading_features",
    "voxel_grid",
    "write_cloud",
]
