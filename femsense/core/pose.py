"""Rigid transforms: `T_a_b`, shape (4, 4), maps coordinates in frame b to frame a."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, as_points
from femsense.core.errors import InputError


def make_pose(rotation: npt.ArrayLike, translation: npt.ArrayLike) -> FloatArray:
    """Return T, shape (4, 4), from a rotation (3, 3) and a translation [m], shape (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def check_pose(T: npt.ArrayLike, name: str) -> FloatArray:
    """Return T as a float array after checking that it is a rigid transform (4, 4). Raises InputError."""
    try:
        pose = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("not a matrix of numbers", where=name, found=repr(T)[:80], expected="4 rows of 4 numbers") from None
    unknown = pose[~np.isfinite(pose)]
    if pose.shape != (4, 4) or len(unknown):
        found = f"shape {pose.shape}" if pose.shape != (4, 4) else f"{len(unknown)} of 16 numbers are {unknown[0]}"
        raise InputError("not a rigid transform", where=name, found=found, expected="4 rows of 4 finite numbers")
    off = float(np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max())
    if off > 1e-3 or np.linalg.det(pose[:3, :3]) < 0 or not np.allclose(pose[3], [0, 0, 0, 1]):
        raise InputError(
            "not a rigid transform",
            where=name,
            found=f"|R Rᵀ − I| = {off:.2g}, det R = {np.linalg.det(pose[:3, :3]):.3g}, last row {pose[3].tolist()}",
            expected="a rotation (det +1), and a last row 0 0 0 1",
            hint=_pose_hint(pose),
        )
    return pose


def _pose_hint(pose: FloatArray) -> str | None:
    """Return the usual reason why a matrix (4, 4) is no rigid transform; None where it is another."""
    R = pose[:3, :3]
    scale = float(np.cbrt(abs(np.linalg.det(R))))
    if not pose[:3, 3].any() and pose[3, :3].any():
        return "it is transposed: the translation belongs into the last column"
    if scale > 0.0 and np.allclose(R @ R.T, scale**2 * np.eye(3), atol=1e-3 * scale**2):
        if np.linalg.det(R) < 0:
            return "an axis is mirrored: left-handed coordinates, as Unity has them?"
        return f"the rotation is scaled by {scale:.4g}: the unit belongs to the translation alone"
    return None


def invert_pose(T_a_b: FloatArray) -> FloatArray:
    """Return T_b_a, shape (4, 4)."""
    R = T_a_b[:3, :3].T
    return make_pose(R, -R @ T_a_b[:3, 3])


def transform_points(T_a_b: FloatArray, points_b: npt.ArrayLike) -> FloatArray:
    """Return the points in frame a [m], shape (n, 3), from points in frame b [m], shape (n, 3)."""
    return as_points(points_b) @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rotation_from_vector(rotation_vector: npt.ArrayLike) -> FloatArray:
    """Return the rotation matrix (3, 3) of a rotation vector [rad], shape (3,) (Rodrigues)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.array(rotation_vector, dtype=np.float64)).as_matrix())


def move_pose(T_a_b: FloatArray, step: npt.ArrayLike, *, pivot_a: npt.ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
    """Return T_a_b turned by step[:3] [rad] about pivot_a [m] and shifted by step[3:] [m], both in frame a."""
    delta = np.asarray(step, dtype=np.float64)
    pivot = np.asarray(pivot_a, dtype=np.float64)
    R = rotation_from_vector(delta[:3])
    return make_pose(R, pivot - R @ pivot + delta[3:]) @ T_a_b


def moved_poses(poses: Sequence[FloatArray], steps: FloatArray, pivot_a: FloatArray) -> list[FloatArray]:
    """Return each pose moved by its six of the steps, shape (6 v,); see `move_pose`."""
    return [move_pose(T, step, pivot_a=pivot_a) for T, step in zip(poses, steps.reshape(-1, 6), strict=True)]


def std_of_entries(T: FloatArray, covariance: FloatArray, pivot: FloatArray) -> FloatArray:
    """Return one standard deviation of the entries of T from the covariance of (rotation about the pivot, shift)."""
    std = np.zeros((4, 4))
    J = np.zeros((3, 4, 6))
    for j in range(6):
        step = np.zeros(6)
        step[j] = 1e-6
        J[:, :, j] = (move_pose(T, step, pivot_a=pivot) - T)[:3] / 1e-6
    std[:3] = np.sqrt(np.maximum(np.einsum("abi,ij,abj->ab", J, covariance, J), 0.0))
    return std
