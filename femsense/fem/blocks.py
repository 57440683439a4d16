"""Tetrahedra of bodies made of blocks: a grid of cells, some of them omitted, mapped into space by a function."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import InputError
from femsense.fem.mesh import TetMesh, oriented

KUHN = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
"""Six tetrahedra of a cube whose corner (i, j, k) has the number 4 i + 2 j + k."""


def block_mesh(
    levels: Sequence[npt.ArrayLike],
    *,
    keep: Callable[[FloatArray], BoolArray] | None = None,
    place: Callable[[FloatArray], FloatArray] | None = None,
) -> TetMesh:
    """Make a tetrahedral mesh from a grid of cuboid cells, with six tetrahedra per cell.

    Cells are split by Kuhn's rule, mirrored from each cell to the next, so that neighbours fit together and a grid with an even
    number of cells along an axis is its own mirror image across it (a symmetric body bends symmetrically).

    Arguments:
        levels: coordinates of the cells' sides along each of the three axes, increasing, in any unit.
        keep: function of the centres of the c cells, shape (c, 3), that returns whether each belongs to the body, shape (c,). Default: all do.
        place: function of the n grid points, shape (n, 3), that returns the node positions [m], shape (n, 3). Default: the grid points.

    Returns:
        the mesh of linear elements. Grid points without a cell are left out.

    Raises:
        InputError: coordinates that do not increase, or no cell left.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> mesh = fs.block_mesh([np.linspace(0.0, 0.10, 11), np.linspace(0.0, 0.02, 3), np.linspace(0.0, 0.02, 3)])  # m
        >>> mesh.nodes.shape, mesh.tets.shape  # ten by two by two cells of six tetrahedra
        ((99, 3), (240, 4))
    """
    axes = [np.asarray(level, dtype=np.float64) for level in levels]
    for name, axis in zip("xyz", axes):
        if len(axis) < 2 or not (np.diff(axis) > 0).all():
            raise InputError("must rise, two values at least", where=f"levels along {name}", found=axis.tolist())
    counts = [len(axis) - 1 for axis in axes]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = np.stack(np.meshgrid(*[np.arange(count) for count in counts], indexing="ij"), axis=-1).reshape(-1, 3)
    if keep is not None:
        centres = np.stack([(axis[:-1] + axis[1:])[cells[:, i]] / 2.0 for i, axis in enumerate(axes)], axis=1)
        cells = cells[np.asarray(keep(centres), dtype=bool)]
    if not len(cells):
        raise InputError("no cell remains", where="keep", found=f"0 of {np.prod(counts)}", expected="some cells of the grid")
    corner = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    at = cells[:, None] + np.where(cells[:, None] % 2 == 0, corner, 1 - corner)  # odd cells are mirrored
    numbers = np.ravel_multi_index(tuple(np.moveaxis(at, -1, 0)), [count + 1 for count in counts])
    used, tets = np.unique(numbers[:, KUHN].reshape(-1, 4), return_inverse=True)
    nodes = points[used]
    return oriented(TetMesh(nodes if place is None else place(nodes), tets.reshape(-1, 4)))
