"""Spheres and cylinders fitted to points that one camera sees."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.core.arrays import FloatArray
from femsense.pointcloud.round_fits import BALL, CYLINDER, ROUND_END, SPHERE, fit_round

CENTRE, RADIUS, STD = np.array([0.02, -0.01, 0.5]), 0.012, 2e-4
OFF = np.array([0.0, 0.003, -0.004])


def seen(axis: FloatArray | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points on the side of a sphere or cylinder that faces the origin, one in thirty far off, their noise and their rays."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(600, 3))
    along = np.zeros((600, 1)) if axis is None else 0.03 * rng.uniform(-1.0, 1.0, (600, 1))
    if axis is not None:
        direction -= np.outer(direction @ axis, axis)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = CENTRE + RADIUS * direction + (0.0 if axis is None else along * axis)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    facing = np.einsum("ic,ic->i", direction, ray) < -0.3
    points, ray = points[facing], ray[facing]
    noise = STD * rng.normal(size=len(points)) + 0.02 * (rng.random(len(points)) < 1 / 30)
    return points + noise[:, None] * ray, np.full(len(points), STD), ray


@pytest.mark.parametrize("kind", [SPHERE, BALL])
def test_a_sphere_is_found_among_points_that_are_far_off(kind: int) -> None:
    points, std, ray = seen(None)
    start = np.append(points.mean(axis=0) + 0.01 * ray.mean(axis=0), np.log(0.02))
    x, curve, residual, cost = fit_round(kind, points, std, ray, start[: 4 if kind == SPHERE else 3], steps=25, radius=RADIUS)
    assert np.linalg.norm(x[:3] - CENTRE) < 4.0 * np.sqrt(np.trace(np.linalg.inv(curve)[:3, :3])) < 4e-4
    assert kind == BALL or np.exp(x[3]) == pytest.approx(RADIUS, rel=0.02)
    assert np.median(np.abs(residual)) == pytest.approx(0.6745, abs=0.1)
    z = np.abs(residual)
    assert cost == pytest.approx(np.where(z <= 2.0, z**2, 2.0 * (2.0 * z - 2.0)).sum())  # what is far off counts linearly


def test_a_cylinder_is_found_from_a_frame_that_is_tilted() -> None:
    axis = np.array([1.0, 0.0, 0.0])
    points, std, ray = seen(axis)
    frame = np.linalg.qr(np.column_stack([np.array([1.0, 0.1, -0.1]), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))[0].T
    frame *= np.sign(frame[0, 0])
    start = np.array([0.0, 0.0, np.log(0.01), 0.0, 0.0])
    x, *_ = fit_round(CYLINDER, points, std, ray, start, steps=50, frame=frame, middle=CENTRE + OFF)
    found = frame[0] + x[3] * frame[1] + x[4] * frame[2]
    assert abs(found @ axis) / np.linalg.norm(found) > 0.9999
    assert np.exp(x[2]) == pytest.approx(RADIUS, rel=0.02)
    off = OFF + x[0] * frame[1] + x[1] * frame[2]
    assert np.linalg.norm(off - (off @ axis) * axis) < 3e-4


def test_the_round_end_of_a_rod_is_found_from_its_side() -> None:
    axis, end = np.array([0.96, 0.28, 0.0]), 0.008
    points, std, _ = seen(axis)
    along = (points - CENTRE) @ axis
    rim = (
        np.sqrt(np.maximum(RADIUS**2 - np.maximum(along - end, 0.0) ** 2, 0.0)) / RADIUS
    )  # the half ball is narrower than the rod
    on_axis = CENTRE + along[:, None] * axis
    kept = along < end + 0.9 * RADIUS
    points = (on_axis + rim[:, None] * (points - on_axis))[kept]
    x, *_ = fit_round(
        ROUND_END,
        points,
        std[kept],
        points / np.linalg.norm(points, axis=1, keepdims=True),
        np.array([0.0, 0.0, np.log(0.008), 0.0, 0.0, 0.01]),
        steps=50,
        frame=np.eye(3),
        middle=CENTRE + OFF,
    )
    found = np.array([1.0, x[3], x[4]])
    found /= np.linalg.norm(found)
    assert found @ axis > 0.999
    assert np.exp(x[2]) == pytest.approx(RADIUS, rel=0.03)
    assert np.linalg.norm(CENTRE + OFF + [0.0, x[0], x[1]] + x[5] * found - (CENTRE + end * axis)) < 4e-4
