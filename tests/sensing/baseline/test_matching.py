"""Algorithm 3 against its text, its laws, and the truth of its standard deviations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from femsense.core.errors import InputError
from femsense.core.pose import rotation_from_vector
from femsense.sensing.baseline.matching import MatchingOptions, match_along_normals

AVERAGE = MatchingOptions(average=True)
SEEDS = st.integers(0, 2**32 - 1)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, size=(12, 3)), unit(rng.normal(size=(12, 3))), rng.uniform(-1, 1, size=(400, 3))


def cap(rng: np.random.Generator, count: int, *, radius: float = 0.04, noise: float = 0.0) -> np.ndarray:
    """Return points on the half of a sphere about (0, 0, 0.3) that faces the origin."""
    outward = unit(rng.normal(size=(count, 3)))
    outward[:, 2] = -np.abs(outward[:, 2])
    return outward * (radius + noise * rng.normal(size=(count, 1))) + [0, 0, 0.3]


def front(count: int, *, radius: float = 0.04) -> tuple[np.ndarray, np.ndarray]:
    """Return features and normals on that sphere, within 50° of the direction to the origin."""
    rng = np.random.default_rng(99)
    angle, around = np.arccos(rng.uniform(np.cos(0.87), 1, count)), rng.uniform(0, 2 * np.pi, count)
    normals = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), -np.cos(angle)], axis=1)
    return normals * radius + [0, 0, 0.3], normals


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, d_m=st.floats(0.05, 0.4), d_l=st.floats(0.1, 0.8))
def test_matches_are_those_of_the_paper(seed: int, d_m: float, d_l: float) -> None:
    features, normals, points = scene(seed)
    matches = match_along_normals(features, normals, points, d_m=d_m, d_l=d_l)
    for e in range(len(features)):
        best, best_line, best_offset = -1, np.inf, np.nan
        for i, point in enumerate(points):
            offset = (point - features[e]) @ normals[e]
            line = np.linalg.norm(point - features[e] - offset * normals[e])
            if abs(offset) <= d_l and line <= d_m and line < best_line:
                best, best_line, best_offset = i, line, offset
        assert matches.found[e] == (best >= 0) and matches.point[e] == best
        np.testing.assert_allclose(matches.distance[e], best_offset, atol=1e-12)
        np.testing.assert_allclose(matches.line_distance[e], best_line, atol=1e-9)


@pytest.mark.parametrize("average", [False, True])
def test_matches_move_with_the_scene_and_not_with_the_order(average: bool) -> None:
    rng = np.random.default_rng(1)
    features, normals = front(40)
    points = cap(rng, 3000, noise=2e-4)
    options = {"d_m": 0.005, "d_l": 0.01, "options": MatchingOptions(average=average)}
    matches = match_along_normals(features, normals, points, camera_position=[0, 0, 0], **options)
    R, shift, order = rotation_from_vector([0.4, -2.0, 0.3]), np.array([1.0, -2.0, 0.5]), rng.permutation(len(points))
    turned = match_along_normals(
        features @ R.T + shift, normals @ R.T, points[order] @ R.T + shift, camera_position=shift, **options
    )
    np.testing.assert_array_equal(turned.found, matches.found)
    np.testing.assert_array_equal(order[turned.point], matches.point)
    np.testing.assert_allclose(turned.distance, matches.distance, atol=1e-10)
    np.testing.assert_allclose(turned.std, matches.std, atol=1e-9)


def test_distance_is_positive_outwards() -> None:
    x, y = np.meshgrid(np.linspace(-0.01, 0.01, 21), np.linspace(-0.01, 0.01, 21))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.003)], axis=1)
    for average in (False, True):
        matches = match_along_normals(
            [[0, 0, 0]] * 2, [[0, 0, 1.0], [0, 0, -5.0]], points, d_m=0.005, d_l=0.01, options=MatchingOptions(average=average)
        )
        np.testing.assert_allclose(matches.distance, [0.003, -0.003], atol=1e-12)
        np.testing.assert_allclose(
            matches.positions(np.zeros((2, 3)), np.array([[0, 0, 1.0], [0, 0, -1.0]])), [[0, 0, 0.003]] * 2, atol=1e-12
        )


def test_a_slanted_surface_is_met_on_the_line_and_not_beside_it() -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.01, 0.01, size=(500, 2))
    points = np.column_stack([flat, 0.002 + 0.5 * flat[:, 0] - 0.3 * flat[:, 1]])
    for order in (1, 2):
        matches = match_along_normals(
            [[0, 0, 0]], [[0, 0, 1]], points, d_m=0.004, d_l=0.02, options=MatchingOptions(average=True, order=order)
        )
        np.testing.assert_allclose(matches.distance, 0.002, atol=1e-12)


def test_a_single_point_beside_the_line_of_a_slanted_surface_is_that_uncertain() -> None:
    flat = np.random.default_rng(0).uniform(-0.01, 0.01, size=(60, 2))
    points = np.column_stack([flat, 0.8 * flat[:, 0]])
    matches = match_along_normals([[0, 0, 0]], [[0, 0, 1]], points, d_m=0.006, d_l=0.02)
    np.testing.assert_allclose(matches.std, 0.8 * matches.line_distance, rtol=1e-9)


def test_second_order_follows_curvature_and_first_order_is_off_as_stated() -> None:
    features, normals = front(60)
    points = cap(np.random.default_rng(0), 40000)
    off = {
        order: np.nanmean(
            match_along_normals(
                features, normals, points, d_m=0.005, d_l=0.01, options=MatchingOptions(average=True, order=order)
            ).distance
        )
        for order in (0, 1, 2)
    }
    np.testing.assert_allclose(off[1], -(0.005**2) / (4 * 0.04), rtol=0.05)
    np.testing.assert_allclose(off[0], off[1], rtol=0.1)
    assert abs(off[2]) < 0.02 * abs(off[1])


@pytest.mark.parametrize("average", [False, True])
def test_standard_deviations_hold_the_truth_as_often_as_they_say(average: bool) -> None:
    """Features on the true surface: the distance is the error.

    One match a feature and cloud, so trials are nearly independent.
    """
    features, normals = front(40)
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(25):
        matches = match_along_normals(
            features, normals, cap(rng, 5000, noise=3e-4), d_m=0.004, d_l=0.01, options=MatchingOptions(average=average)
        )
        errors.append((matches.distance / matches.std)[matches.found])
    ratio = np.abs(np.concatenate(errors))
    for width, share in ((1.0, 0.6827), (1.96, 0.95)):
        low, high = binom.ppf([5e-4, 1 - 5e-4], len(ratio), share)
        assert low - 0.01 * len(ratio) <= (ratio < width).sum() <= high + 0.01 * len(ratio)


def test_averaging_beats_the_noise() -> None:
    features, normals = front(60)
    points = cap(np.random.default_rng(0), 6000, noise=3e-4)
    single = match_along_normals(features, normals, points, d_m=0.005, d_l=0.01)
    mean = match_along_normals(features, normals, points, d_m=0.005, d_l=0.01, options=AVERAGE)
    assert np.nanstd(mean.distance) < 0.5 * np.nanstd(single.distance)
    assert np.nanmedian(mean.std) < 0.5 * np.nanmedian(single.std)
    assert mean.count[mean.found].min() > 10 and (single.count[single.found] == 1).all()


def test_outlying_points_are_set_aside() -> None:
    features, normals = front(60)
    rng = np.random.default_rng(0)
    points = cap(rng, 6000, noise=1e-4)
    outlier = rng.random(len(points)) < 0.05
    points[outlier] = cap(rng, int(outlier.sum()), radius=0.045)
    matches = match_along_normals(features, normals, points, d_m=0.005, d_l=0.01, options=AVERAGE)
    assert np.median(np.abs(matches.distance)) < 5e-5


def test_features_that_face_away_are_hidden() -> None:
    """A thin plate seen from above: without the camera, its underside would match the points of its top."""
    flat = np.random.default_rng(0).uniform(-0.01, 0.01, size=(800, 2))
    top = np.column_stack([flat, np.full(800, 0.002)])
    features, normals = np.array([[0, 0, 0.002], [0, 0, 0.0]]), np.array([[0, 0, 1.0], [0, 0, -1.0]])
    blind = match_along_normals(features, normals, top, d_m=0.003, d_l=0.01)
    assert blind.found.tolist() == [True, True]
    for view in ({"camera_position": [0, 0, 0.5]}, {"view_direction": [0, 0, -1]}):
        matches = match_along_normals(features, normals, top, d_m=0.003, d_l=0.01, **view)
        assert matches.found.tolist() == [True, False] and matches.hidden.tolist() == [False, True]
        assert np.isnan(matches.distance[1]) and matches.point[1] == -1 and np.isinf(matches.line_distance[1])
    both = match_along_normals(features, normals, top, d_m=0.003, d_l=0.01, camera_position=[[0, 0, 0.5], [0, 0, -0.5]])
    assert both.found.all()


def test_normals_of_the_points_part_the_two_sides_of_a_thin_body() -> None:
    rng = np.random.default_rng(0)
    flat = rng.uniform(-0.01, 0.01, size=(2000, 2))
    height = np.repeat([0.002, 0.0], 1000)
    points, sides = np.column_stack([flat, height]), np.column_stack([np.zeros((2000, 2)), np.repeat([1.0, -1.0], 1000)])
    features, normals = np.tile([[0.001, 0.002, 0.0025]], (2, 1)), np.array([[0, 0, 1.0], [0, 0, -1.0]])
    matches = match_along_normals(features, normals, points, d_m=0.003, d_l=0.01, robot_normals=sides, options=AVERAGE)
    np.testing.assert_allclose(matches.distance, [-0.0005, 0.0025], atol=1e-12)


def test_few_points_are_uncertain() -> None:
    one = match_along_normals([[0, 0, 0]], [[0, 0, 1]], [[0, 0, 0.001]], d_m=0.01, d_l=0.01, options=AVERAGE)
    assert one.found[0] and np.isinf(one.std[0])
    none = match_along_normals([[0, 0, 0]], [[0, 0, 1]], np.zeros((0, 3)), d_m=0.01, d_l=0.01, options=AVERAGE)
    assert not none.found[0] and np.isnan(none.std[0])


def test_the_floor_adds_in_squares() -> None:
    features, normals = front(10)
    points = cap(np.random.default_rng(0), 4000, noise=2e-4)
    plain = match_along_normals(features, normals, points, d_m=0.005, d_l=0.01, options=AVERAGE)
    floor = match_along_normals(
        features, normals, points, d_m=0.005, d_l=0.01, options=MatchingOptions(average=True, std_floor_m=3e-4)
    )
    np.testing.assert_allclose(floor.std**2, plain.std**2 + 9e-8, rtol=1e-9)


@pytest.mark.parametrize(
    "change, text",
    [
        ({"d_m": 0.0}, "d_m must be positive"),
        ({"options": MatchingOptions(order=3)}, "no such order"),
        ({"camera_position": [0, 0, 0], "view_direction": [0, 0, 1]}, "two statements of the view"),
        ({"robot_normals": [[0, 0, 1]]}, "one normal per row of robot_points"),
    ],
)
def test_bad_arguments_say_so(change: dict[str, object], text: str) -> None:
    options: dict[str, object] = {"d_m": 0.01, "d_l": 0.01, **change}
    with pytest.raises(InputError, match=text):
        match_along_normals([[0, 0, 0]], [[0, 0, 1]], np.zeros((2, 3)), **options)
