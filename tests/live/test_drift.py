"""Drift of pose and rest shape in contact-free frames."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import block_mesh

from femsense.core.pose import make_pose, rotation_from_vector, transform_points
from femsense.fem.mesh import surface_triangles
from femsense.live.drift import Drift, DriftLimits, DriftWatch

MESH = block_mesh((6, 3, 3))
LIMITS = DriftLimits(frames=4, every_s=1.0, patches=8)


def points(rng: np.random.Generator, nodes: np.ndarray) -> np.ndarray:
    corners = nodes[surface_triangles(MESH)]
    found = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(len(corners), 20)), corners).reshape(-1, 3)
    return found + 2e-4 * rng.normal(size=found.shape)


def drift_after(change) -> Drift:
    """Return the drift that is found where `change` moves the measured points of the later frames."""
    rng, watch = np.random.default_rng(2), DriftWatch(MESH, LIMITS)
    found = [watch.measure(float(k), points(rng, MESH.nodes), MESH.nodes) for k in range(4)]
    assert found == [None] * 4
    later = [watch.measure(float(k), change(points(rng, MESH.nodes)), MESH.nodes) for k in range(4, 8)]
    assert later[:3] == [None] * 3 and later[3] is not None
    return later[3]


def test_a_camera_that_stays_has_no_drift() -> None:
    found = drift_after(lambda p: p)
    assert found.text == "" and found.position_m < 1e-4 and found.shape_m < 2e-4


def test_a_shift_of_the_camera_is_measured_and_said() -> None:
    found = drift_after(lambda p: p + np.array([0.0, 0.003, 0.0]))
    assert found.position_m == pytest.approx(3e-3, rel=0.1) and found.is_moved and not found.is_deformed
    assert "the pose by 2.9 mm" in found.text and "the camera or the base moved" in found.text


def test_a_turn_of_the_camera_is_measured() -> None:
    turn = make_pose(rotation_from_vector([0.0, 0.0, 0.03]), [0.0, 0.0, 0.0])
    middle = MESH.nodes.mean(axis=0)
    found = drift_after(lambda p: transform_points(turn, p - middle) + middle)
    assert found.rotation_rad == pytest.approx(0.03, rel=0.1) and found.is_moved


def test_a_body_that_swells_is_no_moved_camera() -> None:
    middle = MESH.nodes.mean(axis=0)
    found = drift_after(lambda p: middle + 1.1 * (p - middle))
    assert found.is_deformed and not found.is_moved and "rest shape" in found.text


def test_it_is_measured_once_in_a_while() -> None:
    watch = DriftWatch(MESH, LIMITS)
    assert watch.is_due(0.0)
    watch.measure(0.0, points(np.random.default_rng(0), MESH.nodes), MESH.nodes)
    assert not watch.is_due(0.5) and watch.is_due(1.0)
