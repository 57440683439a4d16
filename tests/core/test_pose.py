"""Rigid transforms: group laws and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from analytic import random_rotation
from scipy.linalg import expm

from femsense.core.errors import InputError
from femsense.core.pose import check_pose, invert_pose, make_pose, move_pose, rotation_from_vector, transform_points


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_pose(random_rotation(rng), rng.normal(0, 1, 3))


@pytest.mark.parametrize("seed", range(4))
def test_inverse_undoes_and_products_compose(seed: int) -> None:
    A, B = random_pose(seed), random_pose(seed + 50)
    points = np.random.default_rng(seed).normal(0, 1, (7, 3))
    np.testing.assert_allclose(invert_pose(A) @ A, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(invert_pose(A @ B), invert_pose(B) @ invert_pose(A), atol=1e-14)
    np.testing.assert_allclose(transform_points(A @ B, points), transform_points(A, transform_points(B, points)), atol=1e-13)
    np.testing.assert_allclose(transform_points(invert_pose(A), transform_points(A, points)), points, atol=1e-13)


def test_a_transform_keeps_distances_and_hands() -> None:
    T, points = random_pose(9), np.random.default_rng(0).normal(0, 1, (4, 3))
    moved = transform_points(T, points)
    assert np.linalg.det(moved[1:] - moved[0]) == pytest.approx(np.linalg.det(points[1:] - points[0]))


def test_a_transform_maps_the_origin_of_b_to_its_translation() -> None:
    T = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3])
    np.testing.assert_allclose(transform_points(T, [0, 0, 0]), [[1, 2, 3]])
    np.testing.assert_allclose(transform_points(T, [1, 0, 0]), [[1, 3, 3]])


def test_rotation_vectors_are_matrix_exponentials() -> None:
    for w in ([0.3, -0.2, 1.1], [0.0, 0.0, 0.0], [np.pi, 0.0, 0.0], [1e-9, 0, 0]):
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        np.testing.assert_allclose(rotation_from_vector(w), expm(cross), atol=1e-12)


def test_moving_a_pose_turns_about_the_pivot_and_then_shifts() -> None:
    T, pivot, step = random_pose(1), np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.3, 1.0, 2.0, 3.0])
    at_pivot = transform_points(invert_pose(T), pivot)  # the point that sits at the pivot
    np.testing.assert_allclose(transform_points(move_pose(T, step, pivot_a=pivot), at_pivot)[0], pivot + step[3:], atol=1e-14)
    np.testing.assert_allclose(move_pose(T, step, pivot_a=pivot)[:3, :3], rotation_from_vector(step[:3]) @ T[:3, :3], atol=1e-14)
    np.testing.assert_array_equal(move_pose(T, np.zeros(6), pivot_a=pivot), T)


def test_a_good_pose_passes_unchanged() -> None:
    T = random_pose(3)
    np.testing.assert_array_equal(check_pose(T.tolist(), "T"), T)


@pytest.mark.parametrize(
    ("T", "text"),
    [
        (np.eye(3), "shape (3, 3)"),
        (np.diag([1.0, 1, -1, 1]), "det R = -1"),
        (np.diag([2.0, 2, 2, 1]), "|R Rᵀ − I| = 3"),
        (np.vstack([np.eye(4)[:3], [0, 0, 1, 1]]), "last row"),
        (np.diag([np.nan, 1, 1, 1]), "1 of 16 numbers are nan"),
        ([["a"]], "not a matrix of numbers"),
        ([[1, 2], [3]], "not a matrix of numbers"),
        (np.eye(4).T * [[1], [1], [1], [1000]], "last row"),
    ],
)
def test_what_is_no_pose(T: object, text: str) -> None:
    with pytest.raises(InputError) as error:
        check_pose(T, "T_robot_camera")  # type: ignore[arg-type]
    assert text in str(error.value) and "T_robot_camera" in str(error.value)


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (random_pose(3).T, "transposed"),
        (random_pose(3) @ np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
        (random_pose(3) @ np.diag([1e3, 1e3, 1e3, 1.0]), "scaled by 1000"),
    ],
)
def test_why_a_matrix_is_no_rigid_transform_is_said(matrix: np.ndarray, said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_pose(matrix, "T")
