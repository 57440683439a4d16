"""Surfaces in text with decimal commas, as programs write them under a German or Polish locale."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.io.clouds.cloud_files import read_cloud
from femsense.io.mesh_files import read_tets, read_triangles

POINTS = np.array([[0.0, 0.0, 0.0], [100.5, 0.0, 0.0], [0.0, 20.25, 0.0], [0.0, 0.0, -0.75]])
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]


def text_of(kind: str) -> str:
    rows = [" ".join(f"{v:.6f}" for v in point) for point in POINTS]
    if kind == "obj":
        return "\n".join([*(f"v {row}" for row in rows), *(f"f {a + 1}/1 {b + 1}/1 {c + 1}/1" for a, b, c in FACES)]) + "\n"
    if kind == "off":
        return "\n".join(["OFF", "4 4 0", *rows, *(f"3 {a} {b} {c}" for a, b, c in FACES)]) + "\n"
    facets = [
        f"facet normal 0.0 0.0 1.0\nouter loop\n{''.join(f'vertex {rows[i]}' + chr(10) for i in face)}endloop\nendfacet"
        for face in FACES
    ]
    return "\n".join(["solid part 1,5", *facets, "endsolid part 1,5"]) + "\n"


@pytest.mark.parametrize("kind", ["stl", "obj", "off"])
def test_decimal_commas_are_read_with_a_warning(kind: str, tmp_path: Path) -> None:
    file = tmp_path / f"a.{kind}"
    file.write_text("\n".join(line if "solid" in line else line.replace(".", ",") for line in text_of(kind).splitlines()) + "\n")
    with pytest.warns(UserWarning, match="decimal commas from line"):
        points, triangles = read_triangles(file)
    assert len(triangles) == 4
    np.testing.assert_allclose(np.sort(points, axis=0), np.sort(POINTS, axis=0), atol=1e-6)


@pytest.mark.parametrize("kind", ["stl", "obj", "off"])
def test_points_are_read_without_one(kind: str, tmp_path: Path) -> None:
    (tmp_path / f"a.{kind}").write_text(text_of(kind))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_triangles(tmp_path / f"a.{kind}")[1]) == 4


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_clouds_in_text_with_decimal_commas(kind: str, tmp_path: Path) -> None:
    rows = "\n".join(" ".join(f"{v:.6f}".replace(".", ",") for v in point) for point in POINTS)
    heads = {
        "ply": "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
        "pcd": "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 4\nHEIGHT 1\nPOINTS 4\nDATA ascii\n",
    }
    (tmp_path / f"a.{kind}").write_text(heads[kind] + rows + "\n")
    np.testing.assert_allclose(read_cloud(tmp_path / f"a.{kind}").points, POINTS, atol=1e-5)


def test_a_mesh_with_decimal_commas_is_named(tmp_path: Path) -> None:
    rows = "\n".join(" ".join(f"{v:.6f}".replace(".", ",") for v in point) for point in POINTS)
    head = "# vtk DataFile Version 3.0\nbar\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 double\n"
    (tmp_path / "a.vtk").write_text(f"{head}{rows}\nCELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n")
    with pytest.raises(InputError, match="decimal commas"):
        read_tets(tmp_path / "a.vtk")
