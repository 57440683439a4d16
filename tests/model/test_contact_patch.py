"""Tests of contact patches: their shares do the work of a pressure on the shape functions of their elements."""

from __future__ import annotations

import numpy as np
import pytest
from hollow import hollow_bar

from femsense.fem.cavities import find_chamber
from femsense.fem.mesh import TetMesh, to_quadratic
from femsense.model.contact_patch import body_surface, patch_at

NONE = np.zeros(0, dtype=np.int64)


def slab(parts: int = 4) -> TetMesh:
    """Return a slab of 40 × 40 × 10 mm of linear tetrahedra."""
    i, j, k = np.meshgrid(np.arange(parts + 1), np.arange(parts + 1), np.arange(2), indexing="ij")
    nodes = np.column_stack([i.ravel() * 0.04 / parts, j.ravel() * 0.04 / parts, k.ravel() * 0.01])
    number = np.arange(len(nodes)).reshape(parts + 1, parts + 1, 2)
    tets = []
    for a in range(parts):
        for b in range(parts):
            c = number[a : a + 2, b : b + 2].reshape(2, 2, 2)
            for path in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
                corner, tet = [0, 0, 0], [c[0, 0, 0]]
                for axis in path:
                    corner[axis] = 1
                    tet.append(c[tuple(corner)])
                even = path in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
                tets.append(tet if even else [tet[0], tet[2], tet[1], tet[3]])
    return TetMesh(nodes, np.array(tets))


@pytest.mark.parametrize("quadratic", [False, True])
def test_a_small_patch_has_its_centre_where_it_was_asked_for(quadratic):
    mesh = to_quadratic(slab()) if quadratic else slab()
    place = np.array([0.0183, 0.0221, 0.01])
    patch = patch_at(body_surface(mesh), mesh.nodes, place, 0.004, NONE)
    assert patch.weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(patch.mean(mesh.nodes), place, atol=2e-4)


def test_an_even_pressure_loads_no_corner_of_a_quadratic_face():
    mesh = to_quadratic(slab())
    surface = body_surface(mesh)
    patch = patch_at(surface, mesh.nodes, np.array([0.02, 0.02, 0.01]), 1.0, NONE)  # so wide that it is even
    top = mesh.nodes[patch.nodes, 2] > 0.0099
    corner = patch.nodes < len(slab().nodes)
    assert np.abs(patch.weights[top & corner]).sum() < 0.02 * patch.weights[top].sum()


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_the_patch_of_a_line_contact_has_two_half_axes(angle):
    mesh, line = slab(16), np.array([np.cos(angle), np.sin(angle), 0.0])
    patch = patch_at(body_surface(mesh), mesh.nodes, np.array([0.02, 0.02, 0.01]), 0.006, NONE, along=0.016 * line)
    ways = mesh.nodes[patch.nodes] - patch.mean(mesh.nodes)
    across = np.cross([0.0, 0.0, 1.0], line)
    half = [np.sqrt(5.0 * patch.weights @ (ways @ way) ** 2) for way in (line, across)]
    np.testing.assert_allclose(half, [0.016, 0.006], rtol=0.15)


def test_a_half_axis_shorter_than_the_radius_has_no_effect():
    mesh, place = slab(8), np.array([0.02, 0.02, 0.01])
    surface = body_surface(mesh)
    short, round_one = (
        patch_at(surface, mesh.nodes, place, 0.006, NONE, along=along) for along in (np.array([0.005, 0.0, 0.0]), None)
    )
    np.testing.assert_array_equal(short.weights, round_one.weights)


@pytest.mark.parametrize("quadratic", [False, True])
def test_walls_of_a_chamber_do_not_belong_to_the_surface_that_is_touched(quadratic):
    mesh = hollow_bar(quadratic=quadratic)
    chamber = find_chamber(mesh, "main", np.array([0.05, 0.015, 0.015]))
    whole, outer = body_surface(mesh), body_surface(mesh, (chamber,))
    assert outer.area.sum() == pytest.approx(4 * 0.1 * 0.03 + 2 * 0.03**2)
    assert whole.area.sum() > 1.2 * outer.area.sum()
    inside = ((mesh.nodes[outer.nodes] > 1e-6) & (mesh.nodes[outer.nodes] < np.array([0.1, 0.03, 0.03]) - 1e-6)).all(axis=1)
    assert not inside.any() and outer.faces.shape[1] == (6 if quadratic else 3)
