"""TetGen's pairs of files, .node and .ele (https://wias-berlin.de/software/tetgen/fformats.html): real attributes, four or ten nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.fem.mesh import EDGES
from femsense.io.meshes.content import MeshContent, indices_of

ENDINGS = (".node", ".ele")


def read_tetgen(path: Path, where: str) -> MeshContent:
    """Return the mesh of a .node file and the .ele file next to it; `path` is either of them.

    Raises:
        InputError: one of them is missing, shorter or longer than its first line declares, or not a table of numbers.
    """
    node_file, ele_file = path.with_suffix(".node"), path.with_suffix(".ele")
    for file in (node_file, ele_file):
        if not file.is_file():
            raise InputError("TetGen writes two files, and one is missing", where=where, found=path.name, expected=file.name)
    head, nodes = _table(node_file)
    points = nodes[:, 1:4]
    if len(head) > 1 and head[1] != 3:
        raise InputError("not a mesh in space", where=node_file, found=f"{head[1]:g} coordinates a point", expected="3")
    head, rows = _table(ele_file)
    corners = int(head[1]) if len(head) > 1 else 4
    if corners not in (4, 10) or rows.shape[1] < 1 + corners:
        raise InputError("unknown elements in a TetGen file", where=ele_file, found=f"{corners} nodes each", expected="4 or 10")
    tets = indices_of(rows[:, 1 : 1 + corners].astype(np.int64), nodes[:, 0].astype(np.int64), ele_file)
    kind = "tetra10" if corners == 10 else "tetra"
    cells = {kind: in_vtk_order(points, tets) if corners == 10 else tets}
    values = rows[:, 1 + corners :]
    return MeshContent(points, cells, {"tetgen:ref": {kind: values[:, 0]}} if values.shape[1] else {})


def in_vtk_order(points: FloatArray, tets: IntArray) -> IntArray:
    """Return quadratic tetrahedra (m, 10) with the nodes of their edges in VTK's order: each is the nearest to the middle of its edge.

    An element whose nodes are no middles, each of one edge, stays as it is.
    """
    ends = points[tets[:, EDGES]]
    gap = np.linalg.norm(points[tets[:, 4:]][:, None] - ends.mean(axis=2)[:, :, None], axis=3)
    nearest = gap.argmin(axis=2)
    whole = (np.sort(nearest, axis=1) == np.arange(6)).all(axis=1)
    nearest = np.where(whole[:, None], nearest, np.arange(6))
    return np.concatenate([tets[:, :4], np.take_along_axis(tets[:, 4:], nearest, axis=1)], axis=1)


def _table(file: Path) -> tuple[list[float], FloatArray]:
    """Return the numbers of the first line and the rows after it. Raises InputError."""
    text = file.read_text(encoding="utf-8-sig", errors="replace").replace(",", ".")  # decimal commas: nothing else has commas
    lines = [line.partition("#")[0].split() for line in text.splitlines()]
    lines = [line for line in lines if line]
    try:
        head, rows = [float(word) for word in lines[0]], [[float(word) for word in line] for line in lines[1:]]
        table = np.array(rows, dtype=np.float64).reshape(len(rows), -1)
    except (ValueError, IndexError) as error:
        raise InputError(
            "not a TetGen file", where=file, found=str(error), expected="a line of counts, then rows of numbers"
        ) from None
    if len(table) != head[0]:
        raise InputError(
            "the content disagrees with its header", where=file, found=f"{len(table)} rows", expected=f"{head[0]:.0f} rows"
        )
    return head, table
