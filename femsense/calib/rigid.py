"""The rigid transform between two sets of corresponding points."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, as_points
from femsense.core.errors import DataError, InputError
from femsense.core.pose import invert_pose, make_pose, transform_points


def rotation_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the rotations (…, 3, 3) that take centred points b (…, n, 3) best onto a (…, n, 3).

    Kabsch 1976; Umeyama 1991 for the determinant.
    """
    U, _, Vt = np.linalg.svd(np.swapaxes(a, -1, -2) @ b)
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]
    return np.asarray(U @ Vt)


def fit_rigid(points_a: FloatArray, points_b: FloatArray, *, weights: FloatArray | None = None) -> FloatArray:
    """Return T_a_b, shape (4, 4), that minimises Σ w ‖T_a_b b − a‖².

    Arguments:
        points_a, points_b: corresponding points [m], shape (n, 3).
        weights: ≥ 0, shape (n,); by default all 1.

    Raises:
        InputError: shapes differ.
        DataError: fewer than three points, or collinear ones.
    """
    a, b = as_points(points_a, "points_a"), as_points(points_b, "points_b")
    if a.shape != b.shape:
        raise InputError("points do not correspond", where="points_b", found=b.shape, expected=a.shape)
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=np.float64)
    if (w > 0).sum() < 3:
        raise DataError(f"a pose needs three points that are seen; found {int((w > 0).sum())}")
    w = w / w.sum()
    mean_a, mean_b = w @ a, w @ b
    spread = np.linalg.svd(np.sqrt(w)[:, None] * (b - mean_b), compute_uv=False)
    if spread[1] < 1e-6 * max(spread[0], 1e-300):
        raise DataError("a pose needs three points that are not on a line")
    R = rotation_between(w[:, None] * (a - mean_a), b - mean_b)
    return make_pose(R, mean_a - R @ mean_b)


def fit_rigid_robust(points_a: FloatArray, points_b: FloatArray, *, rounds: int = 20) -> tuple[FloatArray, FloatArray]:
    """Return T_a_b, shape (4, 4), by robust registration, and the weight of each point in (0, 1], shape (n,): Cauchy weights on the MAD scale."""
    weights = np.ones(len(points_a))
    T = fit_rigid(points_a, points_b)
    if len(points_a) < 5:  # too few to identify the outlier
        return T, weights
    for _ in range(rounds):
        distance = np.linalg.norm(points_b @ T[:3, :3].T + T[:3, 3] - points_a, axis=1)
        scale = 2.0 * float(np.median(distance)) + 1e-12
        weights = 1.0 / (1.0 + (distance / scale) ** 2)
        T = fit_rigid(points_a, points_b, weights=weights)
    return T, weights


def poses_apart(T: FloatArray, other: FloatArray, points: FloatArray) -> float:
    """Return the root mean square distance between the positions of points (k, 3) under two poses of a camera [m]; they are given under the second."""
    moved = transform_points(T @ invert_pose(other), points)
    return float(np.sqrt(((moved - points) ** 2).sum(axis=1).mean()))


def rigid_residual(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the residual of the best rigid registration of points b to points a [m], shape (n, 3)."""
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    return np.asarray(p - q @ rotation_between(p, q).T)
