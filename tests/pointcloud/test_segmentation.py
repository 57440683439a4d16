"""Regions, robot and surroundings, planes, clusters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from femsense.core.errors import DataError, InputError
from femsense.core.pose import rotation_from_vector
from femsense.pointcloud import (
    PointCloud,
    color_mask,
    euclidean_clusters,
    find_plane,
    objects_on_plane,
    region_growing,
    remove_plane,
    segment_by_model,
    segment_robot,
    shading_features,
)

SEEDS = st.integers(0, 2**32 - 1)
BLUE = np.array([0.2, 0.45, 0.8])
RED = np.array([0.8, 0.25, 0.2])


def components(joined: np.ndarray) -> np.ndarray:
    """Return the component of each node of a graph (n, n) by walking it."""
    labels = np.full(len(joined), -1)
    for start in range(len(joined)):
        stack = [start] if labels[start] < 0 else []
        while stack:
            node = stack.pop()
            labels[node] = start
            stack += [int(k) for k in np.flatnonzero(joined[node] & (labels < 0))]
    return labels


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(((a[:, None] == a[None]) == (b[:, None] == b[None])).all())


def sheet(center: tuple[float, float, float], size: float = 0.1, step: float = 0.004) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, size, step), np.arange(0, size, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + center


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, distance=st.floats(0.05, 0.6))
def test_clusters_are_the_components_of_the_neighbour_graph(seed: int, distance: float) -> None:
    points = np.random.default_rng(seed).uniform(-1, 1, size=(90, 3))
    labels = euclidean_clusters(points, distance)
    joined = np.linalg.norm(points[:, None] - points[None], axis=2) <= distance
    assert same_partition(labels, components(joined))
    assert (np.diff(np.bincount(labels)) <= 0).all()


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS)
def test_clusters_do_not_depend_on_order_or_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, size=(90, 3))
    labels, order = euclidean_clusters(points, 0.3), rng.permutation(90)
    assert same_partition(euclidean_clusters(points[order], 0.3), labels[order])
    R = rotation_from_vector(rng.normal(size=3))
    assert same_partition(euclidean_clusters(points @ R.T + rng.normal(size=3), 0.3), labels)


def test_small_clusters_have_no_label() -> None:
    points = np.vstack([sheet((0, 0, 0)), [[5.0, 5.0, 5.0]]])
    labels = euclidean_clusters(points, 0.01, 2)
    assert labels[-1] == -1 and (labels[:-1] == 0).all()
    assert len(euclidean_clusters(np.zeros((0, 3)), 0.1)) == 0


@settings(max_examples=15, deadline=None)
@given(seed=SEEDS, threshold=st.floats(0.01, 0.3))
def test_growing_without_merging_is_components_in_place_and_colour(seed: int, threshold: float) -> None:
    rng = np.random.default_rng(seed)
    cloud = PointCloud(rng.uniform(-1, 1, size=(90, 3)), rng.random((90, 3)))
    features = shading_features(cloud.colors)
    joined = np.linalg.norm(cloud.points[:, None] - cloud.points[None], axis=2) <= 0.5
    joined &= np.linalg.norm(features[:, None] - features[None], axis=2) <= threshold
    labels = region_growing(cloud, radius_m=0.5, color_threshold=threshold, merge_threshold=-1.0, min_size=1)
    assert same_partition(labels, components(joined))


def two_colours(seed: int = 0) -> tuple[PointCloud, np.ndarray]:
    """Return a sheet whose halves are blue and red, under light that falls from 1 to 0.5, with noise, and which is red."""
    rng = np.random.default_rng(seed)
    points = sheet((0, 0, 0.5))
    red = points[:, 0] > 0.05
    colors = np.where(red[:, None], RED, BLUE) * (1.0 - 5.0 * points[:, 1:2]) + 0.005 * rng.normal(size=points.shape)
    return PointCloud(points, np.clip(colors, 0, 1)), red


def test_regions_follow_colour_and_not_shadow() -> None:
    cloud, red = two_colours()
    labels = region_growing(cloud, radius_m=0.009, min_size=20)
    assert labels.max() == 1 and labels.min() == 0
    assert same_partition(labels, red.astype(int))


def test_regions_do_not_depend_on_order() -> None:
    cloud, _ = two_colours()
    order = np.random.default_rng(1).permutation(len(cloud))
    one = region_growing(cloud, radius_m=0.009, min_size=20)
    assert same_partition(region_growing(cloud.select(order), radius_m=0.009, min_size=20), one[order])


def test_a_speck_joins_its_neighbour_and_a_lone_speck_does_not() -> None:
    cloud, red = two_colours()
    colors = np.array(cloud.colors)
    speck = np.linalg.norm(cloud.points - [0.076, 0.02, 0.5], axis=1) < 0.006
    colors[speck] = [0.1, 0.8, 0.1]
    points = np.vstack([cloud.points, [[1.0, 1.0, 1.0]]])
    labels = region_growing(PointCloud(points, np.vstack([colors, [BLUE]])), radius_m=0.009, min_size=20)
    assert speck.sum() >= 4 and labels[-1] == -1
    assert same_partition(labels[:-1], red.astype(int))


def test_regions_that_touch_and_look_alike_are_merged() -> None:
    points = sheet((0, 0, 0.5))
    colors = np.where(points[:, :1] > 0.05, [[0.2, 0.45, 0.8]], [[0.22, 0.45, 0.8]])
    apart = region_growing(PointCloud(points, colors), radius_m=0.009, color_threshold=0.005, merge_threshold=0.002, min_size=20)
    merged = region_growing(PointCloud(points, colors), radius_m=0.009, color_threshold=0.005, merge_threshold=0.05, min_size=20)
    assert apart.max() == 1 and merged.max() == 0


@settings(max_examples=30, deadline=None)
@given(light=st.floats(0.3, 1.2), seed=SEEDS)
def test_shadow_does_not_change_which_points_are_robot(light: float, seed: int) -> None:
    noise = 0.01 * np.random.default_rng(seed).normal(size=(2, 3))
    assert color_mask(np.clip(light * np.stack([BLUE, RED]) + noise, 0, 1), BLUE).tolist() == [True, False]


def test_shade_bounds_tell_white_from_dark_grey() -> None:
    colors = [[0.9, 0.9, 0.9], [0.2, 0.2, 0.2]]
    assert color_mask(colors, [0.8, 0.8, 0.8], shade=(0.5, 1.3)).tolist() == [True, False]
    assert color_mask(colors, [0.8, 0.8, 0.8]).tolist() == [True, True]
    assert color_mask(colors, [0.3, 0.3, 0.3], shade=(0.5, 1.3)).tolist() == [False, True]


def test_light_moves_brightness_and_hardly_chromaticity() -> None:
    light, shadow = shading_features([BLUE, 0.5 * BLUE], brightness_weight=0.3)
    np.testing.assert_allclose(shadow[:2], light[:2], rtol=0.08)
    np.testing.assert_allclose(shadow[2], 0.5 * light[2], rtol=1e-12)
    black, white = shading_features([[0, 0, 0], [1, 1, 1]], brightness_weight=0.3)
    np.testing.assert_allclose(white - black, [0, 0, 0.3], atol=1e-15)


def test_robot_and_surroundings_are_a_partition() -> None:
    cloud, red = two_colours()
    robot, surroundings = segment_robot(cloud, BLUE)
    np.testing.assert_array_equal(robot.points, cloud.points[~red])
    np.testing.assert_array_equal(surroundings.points, cloud.points[red])


def test_a_vote_heals_speckle() -> None:
    cloud, red = two_colours()
    colors = np.array(cloud.colors)
    broken = np.random.default_rng(3).random(len(colors)) < 0.15
    colors[broken] = [0.95, 0.95, 0.95]
    robot, _ = segment_robot(PointCloud(cloud.points, colors), BLUE)
    healed, _ = segment_robot(PointCloud(cloud.points, colors), BLUE, vote_radius_m=0.009)
    inner = np.abs(cloud.points[:, 0] - 0.05) > 0.012
    assert len(robot) < 0.9 * (~red).sum()
    assert {tuple(p) for p in healed.points} >= {tuple(p) for p in cloud.points[~red & inner]}


@pytest.mark.parametrize(
    "color, text", [([0, 0, 0.01], "too dark"), ([0.1, 2.0, 0.3], "not a colour"), ([0.1, 0.2], "not a colour")]
)
def test_colours_that_cannot_be_looked_for(color: list[float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        segment_robot(two_colours()[0], color)


def test_colour_methods_need_colours() -> None:
    with pytest.raises(InputError, match="the cloud has no colours"):
        segment_robot(PointCloud(np.zeros((3, 3))), BLUE)
    with pytest.raises(InputError, match="the cloud has no colours"):
        region_growing(PointCloud(np.zeros((3, 3))), radius_m=0.1)


# --- by the model -----------------------------------------------------------------------------------------------------


def robot_and_finger(*, noise: float = 2e-4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (points, colours, is_robot): a blue plane and a red finger that stands on it, half a millimetre off."""
    rng = np.random.default_rng(0)
    plane = sheet((0, 0, 0), 0.1, 0.002)
    angle, height = rng.uniform(0, 2 * np.pi, 900), rng.uniform(0.0005, 0.05, 900)
    finger = np.stack([0.05 + 0.008 * np.cos(angle), 0.05 + 0.008 * np.sin(angle), height], axis=1)
    points = np.vstack([plane, finger]) + noise * rng.normal(size=(len(plane) + 900, 3))
    is_robot = np.arange(len(points)) < len(plane)
    colors = np.where(is_robot[:, None], BLUE, RED) * rng.uniform(0.6, 1.0, size=(len(points), 1))
    return points, colors, is_robot


def kept(cloud: PointCloud, robot: PointCloud) -> np.ndarray:
    chosen = {tuple(p) for p in robot.points}
    return np.array([tuple(p) in chosen for p in cloud.points])


def test_model_without_colours_takes_what_is_near() -> None:
    points, _, is_robot = robot_and_finger()
    surface = sheet((0, 0, 0), 0.1, 0.01)
    cloud = PointCloud(points)
    robot, surroundings = segment_by_model(cloud, surface, np.tile([0, 0, 2.0], (len(surface), 1)), 0.003)
    assert len(robot) + len(surroundings) == len(cloud)
    chosen = kept(cloud, robot)
    assert chosen[is_robot].all()
    np.testing.assert_array_equal(chosen[~is_robot], np.abs(points[~is_robot, 2]) <= 0.003)


def test_a_floor_that_goes_on_beside_the_robot_is_not_robot() -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(size=(3000, 2)) * [0.1, 0.06]
    wall = np.column_stack([along[:, 0], 3e-4 * rng.normal(size=3000), along[:, 1]])  # stands on the floor
    floor = np.column_stack([rng.uniform(-0.1, 0.2, size=(6000, 2)) - [0.0, 0.05], 3e-4 * rng.normal(size=6000)])
    cloud, is_robot = PointCloud(np.vstack([wall, floor])), np.arange(9000) < 3000
    normals = np.tile([0.0, 1.0, 0.0], (len(wall), 1))
    robot, _ = segment_by_model(cloud, wall, normals, 0.01)
    assert kept(cloud, robot)[~is_robot].sum() > 100
    robot, surroundings = segment_by_model(cloud, wall, normals, 0.01, plane_m=1.5e-3)
    chosen = kept(cloud, robot)
    assert len(robot) + len(surroundings) == len(cloud)
    assert chosen[~is_robot].sum() <= 5 and chosen[is_robot & (cloud.points[:, 2] > 1.6e-3)].all()
    np.testing.assert_array_equal(segment_by_model(cloud, wall, normals, 0.01, plane_m=1.5e-3)[0].points, robot.points)


def test_what_lies_beside_the_robot_but_in_no_plane_or_flush_with_it_decides_nothing() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([0.1 * rng.uniform(size=3000), 3e-4 * rng.normal(size=3000), 0.06 * rng.uniform(size=3000)])
    normals = np.tile([0.0, 1.0, 0.0], (len(wall), 1))
    ball = rng.normal(size=(3000, 3))
    ball = 0.05 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0.05, 0.08, 0.03]
    flush = np.column_stack([rng.uniform(0.13, 0.4, 3000), 3e-4 * rng.normal(size=3000), 0.06 * rng.uniform(size=3000)])
    for beside in (ball, flush, flush[:50]):
        robot, _ = segment_by_model(PointCloud(np.vstack([wall, beside])), wall, normals, 0.01, plane_m=1.5e-3)
        assert len(robot) == 3000


def test_points_deep_inside_or_beside_the_surface_are_not_robot() -> None:
    cloud = PointCloud([[0.05, 0.05, 0.0], [0.05, 0.05, -0.05], [0.05, 0.05, 0.05], [0.2, 0.05, 0.0]])
    surface = sheet((0, 0, 0), 0.1, 0.01)
    robot, _ = segment_by_model(cloud, surface, np.tile([0, 0, 1.0], (len(surface), 1)), 0.003)
    assert robot.points.tolist() == [[0.05, 0.05, 0.0]]


@pytest.mark.parametrize("color", [None, BLUE])
def test_model_with_colours_frees_the_object_that_touches(color: np.ndarray | None) -> None:
    points, colors, is_robot = robot_and_finger()
    surface = sheet((0, 0, 0.001), 0.1, 0.01)
    cloud = PointCloud(points, colors)
    robot, _ = segment_by_model(cloud, surface, np.tile([0, 0, 1.0], (len(surface), 1)), 0.003, color_rgb=color)
    chosen = kept(cloud, robot)
    assert chosen[is_robot].mean() > 0.97 and chosen[~is_robot].mean() < 0.03


def test_colours_that_say_nothing_are_not_used() -> None:
    points, _, is_robot = robot_and_finger()
    surface = sheet((0, 0, 0), 0.1, 0.01)
    grey = np.clip(0.5 + 0.01 * np.random.default_rng(0).normal(size=(len(points), 1)) * np.ones(3), 0, 1)
    cloud = PointCloud(points, grey)
    robot, _ = segment_by_model(cloud, surface, np.tile([0, 0, 1.0], (len(surface), 1)), 0.003)
    assert kept(cloud, robot)[is_robot].all()


@pytest.mark.parametrize(
    "surface, normals, text",
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), "no surface"),
        (np.zeros((2, 3)), np.ones((1, 3)), "one normal per row of surface_points"),
        (np.zeros((1, 3)), np.zeros((1, 3)), "a normal of length zero"),
    ],
)
def test_surfaces_that_do_not_fit(surface: np.ndarray, normals: np.ndarray, text: str) -> None:
    with pytest.raises(InputError, match=text):
        segment_by_model(PointCloud(np.zeros((1, 3))), surface, normals, 0.01)


# --- planes and objects -----------------------------------------------------------------------------------------------


def test_the_plane_is_found_among_clutter_wherever_it_lies() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-0.5, 0.5, (2000, 2)), 5e-4 * rng.normal(size=2000)])
    scene = np.vstack([flat, rng.uniform(-0.5, 0.5, (2500, 3))])
    for seed in range(4):
        R, shift = rotation_from_vector(np.random.default_rng(seed).normal(size=3)), np.array([0.1, 0.2, 1.5])
        plane = find_plane(scene @ R.T + shift, 0.003, trials=40)
        tilt = np.linalg.norm(np.cross(plane.normal, R[:, 2]))
        assert tilt < 2e-4, "all points count: noise / (extent · √points) is 4e-5"
        assert abs(abs(plane.offset) - abs(R[:, 2] @ shift)) < 2e-4
        assert plane.distance(np.zeros((1, 3)))[0] > 0  # the camera is in front


def test_planes_come_out_the_same_twice() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3))
    assert find_plane(points, 0.1).offset == find_plane(points, 0.1).offset
    assert (
        find_plane(points, 0.1, rng=np.random.default_rng(3)).offset
        == find_plane(points, 0.1, rng=np.random.default_rng(3)).offset
    )


def test_remove_plane_keeps_the_side_of_the_camera() -> None:
    cloud = PointCloud(np.vstack([sheet((0, 0, 1.0)), [[0.0, 0.0, 0.9], [0.0, 0.0, 1.1]]]))
    rest, _ = remove_plane(cloud, 0.01)
    assert rest.points.tolist() == [[0.0, 0.0, 0.9]]
    assert len(remove_plane(cloud, 0.01, keep_behind=True)[0]) == 2


@pytest.mark.parametrize(
    "points, text", [(np.zeros((2, 3)), "no plane in 2 points"), (np.arange(30).reshape(10, 3), "on a line")]
)
def test_no_plane(points: np.ndarray, text: str) -> None:
    with pytest.raises(DataError, match=text):
        find_plane(points, 0.01)


def test_an_object_on_an_object_is_two_objects() -> None:
    """A box with a narrower box on it, seen from above and in front: table, two fronts, two lids."""
    step = 0.002
    table = sheet((-0.15, -0.15, 0.0), 0.3, step)
    lid_low, lid_high = sheet((0, 0, 0.06), 0.08, step), sheet((0.02, 0.02, 0.12), 0.04, step)
    front = lambda x0, x1, y, z0, z1: np.array(  # noqa: E731
        [[x, y, z] for x in np.arange(x0, x1, step) for z in np.arange(z0, z1, step)]
    )
    covered = (lid_low[:, 0] > 0.02) & (lid_low[:, 0] < 0.06) & (lid_low[:, 1] > 0.02) & (lid_low[:, 1] < 0.06)
    parts = [table, front(0, 0.08, 0, 0.002, 0.06), lid_low[~covered], front(0.02, 0.06, 0.02, 0.06, 0.12), lid_high]
    truth = np.repeat([-1, 0, 0, 1, 1], [len(p) for p in parts])
    R = rotation_from_vector([np.pi - 0.9, 0, 0])
    points = np.vstack(parts) @ R.T + [0, 0, 0.8] + 2e-4 * np.random.default_rng(0).normal(size=(len(truth), 3))
    labels = objects_on_plane(points, plane_distance_m=0.003, cluster_distance_m=0.005, normal_radius_m=0.006, min_size=300)
    assert labels.max() == 1
    for k in (0, 1):
        assert ((labels == k) & (truth == k)).sum() / ((labels == k) | (truth == k)).sum() > 0.9
