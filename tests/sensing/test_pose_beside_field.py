"""A shared error that looks like a pose is one."""

import numpy as np

from femsense.sensing.pose_beside_field import without_poses


def test_the_field_is_orthogonal_to_the_pose_and_all_else_stays():
    rng = np.random.default_rng(5)
    pose, other, field, residual = (
        rng.normal(size=(80, 6)),
        rng.normal(size=(80, 2)),
        rng.normal(size=(80, 10)),
        rng.normal(size=80),
    )
    field += 3.0 * pose @ rng.normal(size=(6, 10))
    rows = np.column_stack([pose, other, field, residual])
    apart = without_poses(rows.T @ rows, 6, 8)
    beside = field - pose @ np.linalg.lstsq(pose, field, rcond=None)[0]
    wanted = np.column_stack([pose, other, beside, residual])
    assert np.allclose(apart, wanted.T @ wanted)
    assert np.abs(apart[:6, 8:18]).max() < 1e-9


def test_markers_that_see_no_field_stay_as_they_are():
    pose, residual = np.random.default_rng(6).normal(size=(9, 6)), np.ones(9)
    rows = np.column_stack([pose, np.zeros((9, 4)), residual])
    assert np.allclose(without_poses(rows.T @ rows, 6, 6), rows.T @ rows)
