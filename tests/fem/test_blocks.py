"""Bodies built of blocks: volume, fit, symmetry, cells that are left out, failures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from femsense.core.errors import InputError
from femsense.fem.blocks import block_mesh
from femsense.fem.mesh import element_volumes, surface_triangles
from femsense.fem.mesh_checks import check_mesh

LEVELS = ([0.0, 1.0, 3.0], [0.0, 0.5, 1.0, 2.0], [-1.0, 1.0])


def test_blocks_fill_their_box_and_fit_together() -> None:
    mesh = block_mesh(LEVELS)
    check_mesh(mesh, "blocks")
    assert len(mesh.tets) == 6 * 6 and element_volumes(mesh).sum() == pytest.approx(3 * 2 * 2)
    assert len(surface_triangles(mesh)) == 2 * 2 * (2 * 3 + 2 * 1 + 3 * 1)  # no inner face is left open


def test_an_even_grid_is_its_own_mirror_image() -> None:
    axis = np.linspace(-1.0, 1.0, 3)
    mesh = block_mesh([axis, axis, np.linspace(-1.0, 1.0, 5)])
    tree = cKDTree(mesh.nodes)
    edges = {
        tuple(sorted(pair))
        for tet in mesh.tets.tolist()
        for pair in np.array(tet)[[[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]].tolist()
    }
    for flip in ([-1, 1, 1], [1, -1, 1], [1, 1, -1]):
        image = tree.query(mesh.nodes * flip)[1]
        assert {tuple(sorted((int(image[a]), int(image[b])))) for a, b in edges} == edges


def test_cells_can_be_left_out() -> None:
    mesh = block_mesh([np.arange(4.0)] * 3, keep=lambda centre: ~(np.abs(centre - 1.5) < 0.1).all(axis=1))
    check_mesh(mesh, "hollow")
    assert element_volumes(mesh).sum() == pytest.approx(26.0)
    assert len(surface_triangles(mesh)) == 2 * (54 + 6)  # the cavity has walls


def test_points_are_placed() -> None:
    mesh = block_mesh(LEVELS, place=lambda points: points * [-1.0, 2.0, 1.0])
    check_mesh(mesh, "mirrored")
    assert element_volumes(mesh).sum() == pytest.approx(24.0)
    assert mesh.nodes[:, 0].min() == -3.0 and mesh.nodes[:, 1].max() == 4.0


def test_what_cannot_be_built() -> None:
    with pytest.raises(InputError, match="levels along y: must rise"):
        block_mesh([[0, 1], [1, 0], [0, 1]])
    with pytest.raises(InputError, match="no cell remains"):
        block_mesh(LEVELS, keep=lambda centre: np.zeros(len(centre), dtype=bool))
