"""Means of points in place of the points: what the rows tell of a state stays the same."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.calib.condensed_scan import condensed
from femsense.calib.scan import Scan, ray_rows
from femsense.model.camera import CameraNoise
from femsense.pointcloud.rays import Surface

NOISES = (CameraNoise("stereo", at_1m=0.002),)
POSES = (np.diag([1.0, -1.0, -1.0, 1.0]) + np.array([[0, 0, 0, 0.03], [0, 0, 0, 0.03], [0, 0, 0, 0.4], [0, 0, 0, 0]]),)
"""A camera that looks down from 0.4 m."""
NODES = np.array([[0.03 * i, 0.03 * j, 0.002 * (i - j) ** 2] for i in range(3) for j in range(3)])
TRIANGLES = np.array([[3 * i + j, 3 * i + j + 3, 3 * i + j + 4] for i in range(2) for j in range(2)])
TRIANGLES = np.vstack([TRIANGLES, [[3 * i + j, 3 * i + j + 4, 3 * i + j + 1] for i in range(2) for j in range(2)]])
SURFACE = Surface(NODES, TRIANGLES)
REACH = 0.01


def seen(flying: int = 0) -> Scan:
    """Return some hundred points of the plate with the noise of the camera, the first ones 5 mm above it."""
    rng = np.random.default_rng(2)
    place = np.column_stack([rng.uniform(0.002, 0.058, (300, 2)), np.ones(300)])
    hits = SURFACE.cast(place, place + np.array([0.0, 0.0, 1.0]), reach=2.0)
    points = np.column_stack([place[hits.index, :2], hits.place(NODES)[:, 2] + rng.normal(scale=2e-4, size=len(hits.index))])
    points[:flying, 2] += 0.005
    camera = (points - POSES[0][:3, 3]) @ POSES[0][:3, :3]
    return Scan(camera, np.zeros(len(points), np.int64), np.zeros((0, 3)), np.zeros(0, np.int64))


def told(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal equations of six smooth motions upwards that the rows of a scan make."""
    x, y = NODES[:, 0] / 0.06, NODES[:, 1] / 0.06
    motions = np.zeros((len(NODES), 3, 6))
    motions[:, 2] = np.column_stack([np.ones(len(x)), x, y, x**2, x * y, y**2])
    rows = ray_rows(scan, SURFACE, POSES, NOISES, reach=REACH)
    A, weight = rows.operator(len(NODES)) @ motions.reshape(-1, 6), scan.measured[rows.hits.index] / rows.std**2
    return A.T @ (weight[:, None] * A), A.T @ (weight * rows.residual)


def test_means_tell_of_the_motion_what_the_points_do() -> None:
    whole = seen()
    few = condensed(whole, SURFACE, POSES, NOISES, reach=REACH)
    assert len(few.view) < 0.15 * len(whole.view) and few.measured.sum() == len(whole.view)
    (matrix, right), (matrix_few, right_few) = told(whole), told(few)
    std, std_few = (np.sqrt(np.diag(np.linalg.inv(m))) for m in (matrix, matrix_few))
    assert (std_few < 1.15 * std).all()  # 24 means on eight faces, 300 points
    off = np.linalg.solve(matrix_few, right_few) - np.linalg.solve(matrix, right)
    assert (np.abs(off) < 0.15 * std).all()


def test_the_square_of_the_residuals_is_kept() -> None:
    whole = seen()
    few = condensed(whole, SURFACE, POSES, NOISES, reach=REACH)
    assert few.scatter is not None
    each, mean = (ray_rows(scan, SURFACE, POSES, NOISES, reach=REACH) for scan in (whole, few))
    square = few.measured[mean.hits.index] @ (mean.residual**2 + few.scatter[mean.hits.index])
    assert square == pytest.approx(float((each.residual**2).sum()), rel=1e-3)


def test_flying_pixels_are_not_averaged() -> None:
    few = condensed(seen(flying=5), SURFACE, POSES, NOISES, reach=REACH)
    rows = ray_rows(few, SURFACE, POSES, NOISES, reach=REACH)
    far = np.abs(rows.residual) > 0.002
    assert far.sum() == 5 and (few.measured[rows.hits.index][far] == 1.0).all()
    assert np.abs(rows.residual[~far]).max() < 4e-4


def test_a_scan_without_points_on_the_surface_stays_as_it_is() -> None:
    scan = seen()
    assert condensed(scan, Surface(NODES + 0.1, TRIANGLES), POSES, NOISES, reach=REACH) is scan
