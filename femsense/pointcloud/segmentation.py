# mypy: allow-untyped-decorators
"""Segmentation of a cloud into robot and surroundings, by colour or by the model.

Source: "Calibration and force sensing with an RGB-D camera", section V.A.2. The idea of growing regions by colour and then
merging them is that of the Point Cloud Library (Zhan, Liang and Xiao 2009); here it is a union of neighbours in a grid.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, IntArray, as_points, read_only
from femsense.core.errors import InputError
from femsense.core.kernels import njit
from femsense.pointcloud.cloud import PointCloud
from femsense.pointcloud.grid import (
    adjacent_labels,
    build_grid,
    by_size,
    connected_labels,
    count_neighbors,
    count_within,
    find_root,
    positive,
)

_DARK = 0.08  # minimum brightness of a colour: below it, a few steps of 8-bit noise change the hue
_FEW, _FLAT = 100, 0.3  # minimum number of points away from the robot, and minimum share of them in one plane, of a floor or wall
_DRAWS = 1000  # number of trial planes: one with 30 % of the points is missed with probability 10⁻¹²
_LEFT = 0.1  # minimum share of the near points outside of the plane


# --- colour -----------------------------------------------------------------------------------------------------------


def shading_features(colors: npt.ArrayLike, *, brightness_weight: float = 0.3) -> FloatArray:
    """Return colours as chromaticity and weakly weighted brightness, shape (n, 3).

        (r − g, (r + g)/2 − b) / (r + g + b + 0.1)   and   brightness_weight · (r + g + b)/3

    A shadow scales r, g and b together, so it moves the last number only; 0.1 keeps dark noise small.

    Arguments:
        colors: red, green, blue in [0, 1], shape (n, 3).
        brightness_weight: 0 ignores brightness, 1 lets black and white lie 1 apart.
    """
    rgb = as_points(colors, "colors")
    total = rgb.sum(axis=1)
    red_green = (rgb[:, 0] - rgb[:, 1]) / (total + 0.1)
    yellow_blue = (0.5 * (rgb[:, 0] + rgb[:, 1]) - rgb[:, 2]) / (total + 0.1)
    return np.column_stack([red_green, yellow_blue, brightness_weight * total / 3.0])


def region_growing(
    cloud: PointCloud,
    *,
    radius_m: float,
    color_threshold: float = 0.03,
    merge_threshold: float = 0.05,
    min_size: int = 100,
    brightness_weight: float = 0.3,
) -> IntArray:
    """Return the region of each point, shape (n,): 0 is the largest, −1 a small region that touches no other.

    1. Neighbours within radius_m whose colours differ by at most color_threshold belong to the same region.
    2. Regions that touch are merged while their mean colours differ by at most merge_threshold, the most similar first.
    3. A region below min_size joins the neighbour whose mean colour is closest.

    Arguments:
        cloud: with colours.
        radius_m: neighbourhood [m], about three times the spacing of the points.
        color_threshold, merge_threshold: distances of `shading_features`, no unit.
        min_size: minimum number of points of a separate region.
        brightness_weight: see `shading_features`.
    Raises:
        InputError: a cloud without colours, a radius that is not positive.
    """
    features = shading_features(_need_colors(cloud), brightness_weight=brightness_weight)
    radius = positive(radius_m, "radius_m")
    grid = build_grid(cloud.points, radius)
    labels = by_size(connected_labels(grid, radius, features, float(color_threshold)), 1)
    if len(labels) == 0:
        return labels
    pairs = adjacent_labels(grid, radius, labels)
    sizes = np.bincount(labels)
    sums = np.stack([np.bincount(labels, weights=column) for column in features.T], axis=1)
    return by_size(_merge_regions(pairs, sizes, sums, float(merge_threshold), int(min_size))[labels], int(min_size))


def color_mask(
    colors: npt.ArrayLike,
    color_rgb: npt.ArrayLike,
    *,
    tolerance_deg: float = 10.0,
    shade: tuple[float, float] = (0.15, 2.0),
) -> BoolArray:
    """Return which colours match color_rgb under some illumination, shape (n,).

    The angle between two colours as vectors (r, g, b) does not change when light or shadow scales one of them.

    Arguments:
        colors: red, green, blue in [0, 1], shape (n, 3).
        color_rgb: the colour to match, shape (3,).
        tolerance_deg: largest angle [deg]; 10 separates saturated colours, a grey robot needs less.
        shade: smallest and largest brightness as a multiple of that of color_rgb.
    Raises:
        InputError: color_rgb is not a colour in [0, 1], or too dark to have a hue.
    """
    rgb = as_points(colors, "colors")
    wanted = np.asarray(color_rgb, dtype=np.float64).ravel()
    if wanted.shape != (3,) or not np.isfinite(wanted).all() or wanted.min() < 0.0 or wanted.max() > 1.0:
        raise InputError("not a colour", where="color_rgb", found=color_rgb, expected="three numbers in 0 … 1")
    length = float(np.linalg.norm(wanted))
    if length < _DARK:
        raise InputError(
            "too dark to be told from shadow", where="color_rgb", found=color_rgb, expected=f"a length above {_DARK}"
        )
    mask = np.empty(len(rgb), dtype=np.bool_)
    light = max(shade[0] * length, _DARK), shade[1] * length
    _in_colour(read_only(rgb), wanted / length, *light, float(np.cos(np.deg2rad(tolerance_deg))), mask)
    return mask


@njit(cache=True)
def _in_colour(rgb, wanted, dark, bright, cosine, mask):  # type: ignore[no-untyped-def]
    """Write a mask of the colours within an angle of a unit vector that are neither too dark nor too bright."""
    for i in range(len(rgb)):
        length = np.sqrt(rgb[i, 0] ** 2 + rgb[i, 1] ** 2 + rgb[i, 2] ** 2)
        along = rgb[i, 0] * wanted[0] + rgb[i, 1] * wanted[1] + rgb[i, 2] * wanted[2]
        mask[i] = dark <= length <= bright and along >= cosine * length


def segment_robot(
    cloud: PointCloud,
    color_rgb: npt.ArrayLike,
    *,
    tolerance_deg: float = 10.0,
    shade: tuple[float, float] = (0.15, 2.0),
    vote_radius_m: float | None = None,
) -> tuple[PointCloud, PointCloud]:
    """Return (robot, surroundings) by the robot's colour.

    Arguments:
        cloud: with colours.
        color_rgb: the robot's colour in [0, 1], shape (3,).
        tolerance_deg, shade: see `color_mask`.
        vote_radius_m: if given, each point takes the label of the majority within this radius [m], itself included, which removes speckle,
            dark points and glints. Keep it below the size of the smallest touching object.
    Raises:
        InputError: a cloud without colours, or a colour that cannot be used.
    """
    mask = color_mask(_need_colors(cloud), color_rgb, tolerance_deg=tolerance_deg, shade=shade)
    if vote_radius_m is not None:
        mask = _majority(cloud.points, mask, positive(vote_radius_m, "vote_radius_m"))
    return cloud.select(mask), cloud.select(~mask)


# --- model ------------------------------------------------------------------------------------------------------------


def segment_by_model(
    cloud: PointCloud,
    surface_points: npt.ArrayLike,
    surface_normals: npt.ArrayLike,
    distance_m: float,
    *,
    color_rgb: npt.ArrayLike | None = None,
    tolerance_deg: float = 10.0,
    learn_colors: bool = True,
    plane_m: float | None = None,
) -> tuple[PointCloud, PointCloud]:
    """Return (robot, surroundings) by the predicted surface: points near it are robot.

    The distance is that to the tangent plane of the nearest surface point; the tangential distance may exceed it by the spacing of the
    surface points, so that a coarse surface has no holes. Near points with a colour other than color_rgb belong to the surroundings;
    without color_rgb, near points whose colour is more similar to the far points than to the near ones. Without colours, objects closer
    than distance_m count as robot: search contacts with a radius above distance_m. With plane_m, near points in the plane of a floor or
    wall belong to the surroundings too.

    Arguments:
        surface_points: predicted surface [m], shape (s, 3).
        surface_normals: outward normals, shape (s, 3).
        distance_m: largest distance from the surface [m]; above the expected error of the prediction.
        color_rgb, tolerance_deg: see `color_mask`; optional.
        learn_colors: without color_rgb, learn both sides' colours from this cloud.
        plane_m: without colours, maximum distance of surroundings from the plane that contains most of the far points [m]; None: no plane.
    Raises:
        InputError: wrong shapes, no surface, a distance that is not positive.
    """
    from scipy.spatial import cKDTree

    surface, normals = surface_pair(surface_points, surface_normals, "surface_points", "surface_normals")
    distance = positive(distance_m, "distance_m")
    if len(surface) == 0:
        raise InputError("no surface", where="surface_points", found="0 points", expected="at least one")
    tree = cKDTree(surface)
    _, nearest = tree.query(cloud.points)
    offset, sideways = along_and_across(cloud.points - surface[nearest], normals[nearest])
    near: BoolArray = (np.abs(offset) <= distance) & (sideways <= distance + _spacing(tree))
    if cloud.colors is not None and color_rgb is not None:
        near &= color_mask(cloud.colors, color_rgb, tolerance_deg=tolerance_deg)
    elif cloud.colors is not None and learn_colors:
        near = _like_the_near(shading_features(cloud.colors, brightness_weight=0.3), near, np.abs(offset) <= 0.5 * distance)
    elif cloud.colors is None and plane_m is not None:
        near = _off_the_plane(cloud.points, near, positive(plane_m, "plane_m"))
    return cloud.select(near), cloud.select(~near)


# --- helpers ----------------------------------------------------------------------------------------------------------


def surface_pair(
    points: npt.ArrayLike, normals: npt.ArrayLike, points_name: str, normals_name: str
) -> tuple[FloatArray, FloatArray]:
    """Return points (n, 3) and unit normals (n, 3) after a check of their shapes. Raises InputError."""
    positions, directions = as_points(points, points_name), as_points(normals, normals_name)
    if len(positions) != len(directions):
        raise InputError(
            f"one normal per row of {points_name}", where=normals_name, found=len(directions), expected=len(positions)
        )
    lengths = np.linalg.norm(directions, axis=1)
    if (lengths <= 0.0).any():
        row = int(np.flatnonzero(lengths <= 0.0)[0])
        raise InputError(
            "a normal of length zero", where=f"{normals_name}[{row}]", found=directions[row].tolist(), expected="a direction"
        )
    return positions, directions / lengths[:, None]


def along_and_across(differences: FloatArray, normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the parts of differences (n, 3) along unit normals (signed) and across them (≥ 0), shape (n,) each."""
    along = np.einsum("ij,ij->i", differences, normals)
    return along, np.linalg.norm(differences - along[:, None] * normals, axis=1)


def _need_colors(cloud: PointCloud) -> FloatArray:
    if cloud.colors is None:
        raise InputError("the cloud has no colours", where="cloud", expected="colours", hint="segment_by_model works without")
    return cloud.colors


def _majority(points: FloatArray, mask: BoolArray, radius: float) -> BoolArray:
    voters = count_neighbors(build_grid(points, radius), radius) + 1
    for_robot = count_within(build_grid(points[mask], radius), points, radius)
    return np.asarray(np.where(2 * for_robot == voters, mask, 2 * for_robot > voters))


def _spacing(tree: object) -> float:
    """Return the largest distance from a surface point to its third neighbour [m]: the holes between the points."""
    data = np.asarray(tree.data)  # type: ignore[attr-defined]
    if len(data) < 4:
        return 0.0
    distances, _ = tree.query(data, k=4)  # type: ignore[attr-defined]
    return float(np.quantile(distances[:, -1], 0.95))


def _off_the_plane(points: FloatArray, near: BoolArray, width: float) -> BoolArray:
    """Return the near points outside of the plane of the far ones (Open3D's RANSAC), if enough of the far ones lie in one."""
    import open3d as o3d

    far = points[~near]
    if len(far) < _FEW:
        return near
    o3d.utility.random.seed(0)
    plane, inside = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(far)).segment_plane(width, 3, _DRAWS)
    if len(inside) < _FLAT * len(far):
        return near
    away = np.abs(points @ plane[:3] + plane[3]) / np.linalg.norm(plane[:3])
    left = near & (away > width)
    return left if left.sum() > _LEFT * near.sum() else near  # a robot that lies flush in a plane cannot be separated in this way


def _like_the_near(features: FloatArray, near: BoolArray, sure: BoolArray) -> BoolArray:
    """Return the near points whose colour is more likely under the distribution of the nearest points than under that of the far ones.

    Both are normal distributions. If they overlap too much, or one has fewer than 30 points, colour is not used.
    """
    inner, outer = features[near & sure], features[~near]
    if min(len(inner), len(outer)) < 30:
        return near
    inner_center, outer_center = np.median(inner, axis=0), np.median(outer, axis=0)
    inner_spread, outer_spread = _spread(inner, inner_center), _spread(outer, outer_center)
    apart = np.abs(inner_center - outer_center) / (inner_spread + outer_spread)
    if apart.max() < 2.0:
        return near
    inner_cost = (((features - inner_center) / inner_spread) ** 2).sum(axis=1) + 2.0 * np.log(inner_spread).sum()
    outer_cost = (((features - outer_center) / outer_spread) ** 2).sum(axis=1) + 2.0 * np.log(outer_spread).sum()
    return np.asarray(near & (inner_cost <= outer_cost))


def _spread(values: FloatArray, center: FloatArray) -> FloatArray:
    """Return the standard deviation of each column from its median deviation, at least one step of an 8-bit colour."""
    return np.asarray(np.maximum(1.4826 * np.median(np.abs(values - center), axis=0), 1.0 / 255.0))


@njit(cache=True)
def _merge_regions(pairs: IntArray, sizes: IntArray, sums: FloatArray, threshold: float, min_size: int) -> IntArray:
    """Return the root of each region (k,); sizes (k,) and sums (k, 3) are those of the regions, pairs (m, 2) touch."""
    parent = np.arange(len(sizes))
    merged = True
    while merged:
        merged = False
        for e in np.argsort(_differences(pairs, parent, sizes, sums), kind="mergesort"):
            a, b = find_root(parent, pairs[e, 0]), find_root(parent, pairs[e, 1])
            if a != b and _mean_distance(a, b, sizes, sums) <= threshold:
                _join(parent, sizes, sums, a, b)
                merged = True
    merged = True
    while merged:
        merged = False
        for e in np.argsort(_differences(pairs, parent, sizes, sums), kind="mergesort"):
            a, b = find_root(parent, pairs[e, 0]), find_root(parent, pairs[e, 1])
            if a != b and min(sizes[a], sizes[b]) < min_size:
                _join(parent, sizes, sums, a, b)
                merged = True
    for i in range(len(parent)):
        parent[i] = find_root(parent, i)
    return parent


@njit(cache=True)
def _mean_distance(a: int, b: int, sizes: IntArray, sums: FloatArray) -> float:
    total = 0.0
    for k in range(sums.shape[1]):
        total += (sums[a, k] / sizes[a] - sums[b, k] / sizes[b]) ** 2
    return float(np.sqrt(total))


@njit(cache=True)
def _differences(pairs: IntArray, parent: IntArray, sizes: IntArray, sums: FloatArray) -> FloatArray:
    result = np.zeros(len(pairs))
    for e in range(len(pairs)):
        result[e] = _mean_distance(find_root(parent, pairs[e, 0]), find_root(parent, pairs[e, 1]), sizes, sums)
    return result


@njit(cache=True)
def _join(parent: IntArray, sizes: IntArray, sums: FloatArray, a: int, b: int) -> None:
    low, high = min(a, b), max(a, b)
    parent[high] = low
    sizes[low] += sizes[high]
    for k in range(sums.shape[1]):
        sums[low, k] += sums[high, k]
