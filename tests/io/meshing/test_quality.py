"""The quality of tetrahedra: known shapes, invariance, elements through a wall."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import block_mesh

from femsense.core.pose import rotation_from_vector
from femsense.fem.mesh import TetMesh
from femsense.io.mesh_files import radius_ratio
from femsense.io.meshing.quality import dihedral_angles, elements_through, mean_ratio, quality_report, quality_text

REGULAR = TetMesh(np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]), np.array([[0, 1, 2, 3]]))
CORNER = TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]]))


def test_a_regular_tetrahedron_is_perfect() -> None:
    assert mean_ratio(REGULAR)[0] == pytest.approx(1.0) and radius_ratio(REGULAR)[0] == pytest.approx(1.0)
    np.testing.assert_allclose(dihedral_angles(REGULAR)[0], np.degrees(np.arccos(1 / 3)))


def test_the_corner_of_a_cube() -> None:
    np.testing.assert_allclose(np.sort(dihedral_angles(CORNER)[0]), [np.degrees(np.arccos(1 / np.sqrt(3)))] * 3 + [90.0] * 3)
    assert mean_ratio(CORNER)[0] == pytest.approx(12 * 0.5 ** (2 / 3) / 9)


def test_shapes_do_not_depend_on_size_and_place() -> None:
    mesh = block_mesh((2, 1, 1), (0.1, 0.02, 0.03))
    moved = TetMesh(7.0 * mesh.nodes @ rotation_from_vector([0.3, -0.4, 1.0]).T + 5.0, mesh.tets)
    for measure in (mean_ratio, radius_ratio, dihedral_angles):
        np.testing.assert_allclose(measure(mesh), measure(moved), rtol=1e-6)


def test_elements_through_a_plate() -> None:
    for layers in (1, 3):
        plate = block_mesh((10, 10, layers), (10.0, 10.0, float(layers)))
        assert np.percentile(elements_through(plate), 5) == pytest.approx(layers / ((2 + np.sqrt(2)) / 3), rel=0.01)


def test_the_report_names_the_worst() -> None:
    mesh = block_mesh()
    nodes = np.array(mesh.nodes)
    inner = np.flatnonzero(((nodes > 1e-9) & (nodes < nodes.max(axis=0) - 1e-9)).all(axis=1))[0]
    nodes[inner, 2] += 0.9 * 0.015
    report = quality_report(TetMesh(nodes, mesh.tets))
    assert report["tetrahedra"] == 96 and report["volume_cm3"] == pytest.approx(90.0)
    assert report["radius_ratio"]["min"] == report["worst"][0]["radius_ratio"] == min(w["radius_ratio"] for w in report["worst"])
    assert inner in mesh.tets[report["worst"][0]["element"]]
    assert report["unknowns_tet10"] > report["unknowns_tet4"] == 3 * report["nodes"]
    assert "worst elements" in quality_text(report) and f"radius ratio {report['worst'][0]['radius_ratio']:.2f}" in quality_text(
        report
    )
