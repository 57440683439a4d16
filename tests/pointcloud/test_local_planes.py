"""Planes of neighbouring points: their normals, and how far points lie off them."""

import numpy as np
import pytest

from femsense.pointcloud.local_planes import local_planes


def test_points_of_a_plane_have_its_normal_and_their_own_scatter():
    rng = np.random.default_rng(3)
    normal = np.array([0.2, -0.4, 0.9]) / np.linalg.norm([0.2, -0.4, 0.9])
    flat = rng.uniform(-0.1, 0.1, size=(3000, 3))
    flat -= np.outer(flat @ normal, normal)
    planes = local_planes(flat + 3e-4 * rng.normal(size=(3000, 1)) * normal)
    assert np.median(np.abs(planes.normals @ normal)) > 0.99
    assert np.median(planes.rough) == pytest.approx(3e-4, rel=0.15)
    nearest = planes.nearest(flat + 0.002 * normal)
    off = np.einsum("pc,pc->p", flat + 0.002 * normal - planes.middles[nearest], planes.normals[nearest])
    assert np.median(np.abs(off)) == pytest.approx(0.002, rel=0.15)
