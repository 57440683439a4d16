"""TetGen's pairs of files: attributes that are no whole numbers, ten nodes in its own order, counts that are not those of the rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import block_mesh

from femsense.core.errors import InputError
from femsense.fem.mesh import EDGES, TetMesh, element_volumes, to_quadratic
from femsense.io.mesh_files import read_tets, tet_values

TETGEN_EDGES = (2, 3, 1, 5, 4, 0)
"""Places of the nodes of TetGen's edges among those of VTK, for a file whose elements are as TetGen writes them."""


def write(
    path: Path, mesh: TetMesh, *, first: int = 1, attribute: float | None = None, order: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
) -> Path:
    nodes = "\n".join(f"  {k + first} " + " ".join(map(repr, point)) for k, point in enumerate(mesh.nodes.tolist()))
    path.with_suffix(".node").write_text(f"# nodes\n{len(mesh.nodes)}  3  0  0\n{nodes}\n# end\n")
    tets = mesh.tets + first
    if mesh.is_quadratic:
        tets = np.concatenate([tets[:, :4], tets[:, 4:][:, list(order)]], axis=1)
    more = "" if attribute is None else f"   {attribute}"
    rows = "\n".join(f"  {k + first} " + " ".join(map(str, tet)) + more for k, tet in enumerate(tets.tolist()))
    path.with_suffix(".ele").write_text(f"{len(tets)}  {tets.shape[1]}  {int(attribute is not None)}\n{rows}\n")
    return path


@pytest.mark.parametrize("ending", [".ele", ".node"])
@pytest.mark.parametrize("first", [0, 1])
def test_an_attribute_that_is_no_whole_number(first: int, ending: str, tmp_path: Path) -> None:
    mesh = block_mesh()
    file = write(tmp_path / f"b{ending}", mesh, first=first, attribute=1.5)
    read = read_tets(file)
    np.testing.assert_allclose(element_volumes(read).sum(), element_volumes(mesh).sum())
    np.testing.assert_array_equal(tet_values(file, "tetgen:ref", "b"), np.full((len(mesh.tets), 1), 1.5))


@pytest.mark.parametrize("order", [TETGEN_EDGES, (0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0)])
def test_ten_nodes_in_any_order(order: tuple[int, ...], tmp_path: Path) -> None:
    mesh = to_quadratic(block_mesh())
    read = read_tets(write(tmp_path / "b.ele", mesh, order=order))
    ends = read.nodes[read.tets[:, EDGES]].mean(axis=2)
    np.testing.assert_allclose(read.nodes[read.tets[:, 4:]], ends, atol=1e-12)


def test_counts_that_are_not_those_of_the_rows_are_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "b.ele", block_mesh())
    file.write_text(file.read_text().rstrip().rpartition("\n")[0] + "\n")
    with pytest.raises(InputError, match="disagrees with its header"):
        read_tets(file)


def test_the_other_file_is_asked_for(tmp_path: Path) -> None:
    file = write(tmp_path / "b.ele", block_mesh())
    file.with_suffix(".node").unlink()
    with pytest.raises(InputError, match="one is missing"):
        read_tets(file)
