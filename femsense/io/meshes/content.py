"""Content of a mesh file of any format."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError


@dataclass(frozen=True, eq=False, slots=True)
class MeshContent:
    """Points, cells of each kind, and data of the cells, all as the file has them."""

    points: FloatArray
    """In the file's unit, shape (n, 3)."""
    cells: dict[str, IntArray]
    """Kind (meshio's names) → indices of points from 0 in VTK's order, shape (m, k)."""
    data: dict[str, dict[str, npt.NDArray[np.generic]]] = field(default_factory=dict)
    """Name → kind → one value a cell, shape (m,), or several, shape (m, p)."""


def indices_of(wanted: IntArray, numbers: IntArray, where: str | Path) -> IntArray:
    """Return the indices of nodes by their numbers in the file, of the shape of `wanted`.

    Arguments:
        wanted: node numbers of the elements.
        numbers: of the nodes, each once, in any order, shape (n,).
        where: for messages.

    Raises:
        InputError: a number that no node has.
    """
    order = np.argsort(numbers, kind="stable")
    known = numbers[order]
    at = np.searchsorted(known, wanted)
    lost = (at >= len(known)) | (known[np.minimum(at, len(known) - 1)] != wanted) if len(known) else np.ones(wanted.shape, bool)
    if lost.any():
        raise InputError(
            "an element names a node that does not exist",
            where=where,
            found=f"node {int(wanted[lost][0])}",
            expected=f"one of {len(known)} nodes" + (f", {known[0]} … {known[-1]}" if len(known) else ""),
        )
    return np.asarray(order[at])


def joined(pieces: Iterable[MeshContent]) -> MeshContent:
    """Return the content of several files or pieces in one; points that coincide between pieces become one."""
    from scipy.spatial import cKDTree

    parts = list(pieces)
    points, numbers = np.zeros((0, 3)), list[IntArray]()
    size = max((float(np.ptp(part.points, axis=0).max()) for part in parts if len(part.points)), default=0.0)
    for part in parts:
        number = np.arange(len(part.points)) + len(points)
        known = np.zeros(len(part.points), dtype=np.bool_)
        if len(points) and len(part.points):
            distance, nearest = (np.asarray(found) for found in cKDTree(points).query(part.points))
            known = np.asarray(distance <= 1e-7 * size)
            number[~known] = len(points) + np.arange(int((~known).sum()))
            number[known] = nearest[known]
        points, numbers = np.vstack([points, part.points[~known]]), [*numbers, number]
    kinds = dict.fromkeys(kind for part in parts for kind in part.cells)
    cells = {
        kind: np.concatenate([number[part.cells[kind]] for part, number in zip(parts, numbers) if kind in part.cells])
        for kind in kinds
    }
    names = [name for name in parts[0].data if all(name in part.data for part in parts)] if parts else []
    data = {name: _joined_data([part.data[name] for part in parts]) for name in names}
    return MeshContent(points, cells, data)


def _joined_data(tables: list[dict[str, npt.NDArray[np.generic]]]) -> dict[str, npt.NDArray[np.generic]]:
    kinds = dict.fromkeys(kind for table in tables for kind in table)
    return {kind: np.concatenate([table[kind] for table in tables if kind in table]) for kind in kinds}


def distinct_cells(cells: IntArray) -> tuple[IntArray, IntArray]:
    """Return the cells that remain after duplicates (equal sets of corners) are removed, shape (k,), and for every cell its remaining
    one, shape (m,)."""
    keys = np.sort(cells[:, :4], axis=1)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    kept = np.sort(first)
    place = np.empty(len(first), dtype=np.int64)
    place[np.argsort(first)] = np.arange(len(first))
    return kept, place[inverse.reshape(-1)]


def gathered(values: npt.NDArray[np.generic], kept: IntArray, owner: IntArray) -> npt.NDArray[np.generic]:
    """Return the values of the kept cells next to those of their copies, shape (k, p);
    a cell without copies repeats its own."""
    table = values.reshape(len(values), -1)
    if len(kept) == len(owner):
        return table
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=len(kept))
    rank = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    result = np.repeat(table[kept][:, None], int(counts.max()), axis=1)
    result[owner[order], rank] = table[order]
    return result.reshape(len(kept), -1)
