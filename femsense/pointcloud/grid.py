# mypy: allow-untyped-decorators
"""Neighbours within a fixed radius: points sorted by the cell of a grid, cell size = radius.

A ball of one cell's radius lies within 3 × 3 × 3 cells. Keys run fastest along z, so these are nine runs of the sorted keys,
and all points of a cell share them. One empty layer of cells around the points keeps a run from reaching the next row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.core.kernels import njit


@dataclass(frozen=True, eq=False, slots=True)
class VoxelGrid:
    """Points sorted by their cell."""

    points: FloatArray
    """Sorted points [m], shape [n, 3]."""
    order: IntArray
    """points = original[order], shape [n]."""
    keys: IntArray
    """Ascending cell keys of the sorted points, shape [n]."""
    origin: FloatArray
    """Corner of cell (0, 0, 0) [m], shape [3]."""
    dims: IntArray
    """Cells along each axis, shape [3]."""
    cell: float
    """Edge of a cell [m]: the maximum radius of a query."""


def positive(value: float, name: str) -> float:
    """Return value as a float after checking that it is finite and > 0. Raises InputError."""
    number = float(value)
    if not (np.isfinite(number) and number > 0.0):
        raise InputError(f"{name} must be positive", where=name, found=value, expected="a finite number > 0")
    return number


def cell_keys(points: FloatArray, cell: float, origin: FloatArray) -> tuple[IntArray, IntArray]:
    """Return a key per point, shape (n,), and the cells along each axis, shape (3,), with one empty layer around.

    Arguments:
        points: [m], shape (n, 3), n > 0.
        cell: edge of a cell [m].
        origin: a corner of a cell of the grid [m], shape (3,).
    Raises:
        InputError: more cells than a key can count.
    """
    coords = np.floor((points - origin) / cell)
    low = coords.min(axis=0)
    dims = coords.max(axis=0) - low + 3
    if np.prod(dims) > 2.0**62 or np.abs(coords).max() > 2.0**52:
        raise InputError(
            "cells too small for the extent of the points",
            where="cell size",
            found=f"{cell:.3g} m for an extent of {np.ptp(points, axis=0).max():.3g} m",
            expected="fewer than 2^62 cells",
            hint="larger cells, or a pass-through box first",
        )
    steps = (coords - low + 1).astype(np.int64)
    sizes = dims.astype(np.int64)
    return (steps[:, 0] * sizes[1] + steps[:, 1]) * sizes[2] + steps[:, 2], sizes


def build_grid(points: FloatArray, cell: float) -> VoxelGrid:
    """Return the points sorted into cells of the given edge [m]; points [m], shape (n, 3). Raises InputError."""
    if len(points) == 0:
        return VoxelGrid(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(3), np.zeros(3, np.int64), cell)
    low = points.min(axis=0)
    keys, dims = cell_keys(points, cell, low)
    order = np.argsort(keys, kind="stable")
    return VoxelGrid(points[order], order, keys[order], low - cell, dims, cell)


def count_within(grid: VoxelGrid, queries: FloatArray, radius: float, *, enough: int = 2**62) -> IntArray:
    """Return the number of points of the grid within radius [m] of each query (n, 3); counting can end at `enough`."""
    if len(grid.keys) == 0 or len(queries) == 0:
        return np.zeros(len(queries), dtype=np.int64)
    own = np.array(queries)  # one array type for the kernels: each type is compiled separately
    counts: IntArray = _count_within(own, grid.points, grid.keys, grid.origin, grid.dims, grid.cell, radius**2, enough)
    return counts


def count_neighbors(grid: VoxelGrid, radius: float, *, enough: int = 2**62) -> IntArray:
    """Return the number of other points within radius [m] of each point, in the original order, shape (n,)."""
    counts = np.zeros(len(grid.keys), dtype=np.int64)
    if len(counts):
        counts[grid.order] = _count_self(grid.points, grid.keys, grid.dims, radius**2, enough + 1) - 1
    return counts


def connected_labels(grid: VoxelGrid, radius: float, features: FloatArray, feature_distance: float) -> IntArray:
    """Return the root of each point's component, in the original order, shape (n,).

    Two points are connected if they lie within radius [m] and their features (n, k) within feature_distance.
    """
    labels = np.zeros(len(grid.keys), dtype=np.int64)
    if len(labels):
        labels[grid.order] = _connect(grid.points, grid.keys, grid.dims, radius**2, features[grid.order], feature_distance**2)
    return labels


def adjacent_labels(grid: VoxelGrid, radius: float, labels: IntArray) -> IntArray:
    """Return the pairs (a < b) of labels that meet within radius [m], unique and ascending, shape (m, 2)."""
    if len(grid.keys) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    count = int(labels.max()) + 1
    codes = _adjacent(grid.points, grid.keys, grid.dims, radius**2, labels[grid.order], count)
    pairs = np.unique(codes)
    return np.stack([pairs // count, pairs % count], axis=1)


def by_size(roots: IntArray, min_size: int) -> IntArray:
    """Return labels 0, 1, … from the largest group to the smallest, −1 below min_size, shape (n,).

    Groups of one size are ordered by their first member.
    """
    if len(roots) == 0:
        return np.zeros(0, dtype=np.int64)
    _, first, inverse, counts = np.unique(roots, return_index=True, return_inverse=True, return_counts=True)
    ranking = np.lexsort((first, -counts))
    names = np.full(len(counts), -1, dtype=np.int64)
    names[ranking] = np.arange(len(counts))
    names[counts < min_size] = -1
    return names[inverse]


# --- kernels ----------------------------------------------------------------------------------------------------------


@njit(cache=True)
def runs_around(keys: IntArray, key: int, stride_x: int, stride_y: int, starts: IntArray, ends: IntArray) -> None:
    """Write the nine runs of sorted points that fill the 27 cells around the cell `key`."""
    for j in range(9):
        middle = key + (j // 3 - 1) * stride_x + (j % 3 - 1) * stride_y
        starts[j] = np.searchsorted(keys, middle - 1)
        ends[j] = np.searchsorted(keys, middle + 2)


@njit(cache=True)
def key_of(point: FloatArray, origin: FloatArray, dims: IntArray, cell: float) -> int:
    """Return the cell key of a point, −1 if no cell of the grid is near."""
    key = 0
    for axis in range(3):
        step = np.floor((point[axis] - origin[axis]) / cell)
        if step < 0 or step >= dims[axis]:
            return -1
        key = key * dims[axis] + int(step)
    return key


@njit(cache=True)
def squared_distance(a: FloatArray, b: FloatArray) -> float:
    """Return |a − b|² of two points, shape (3,)."""
    return float((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@njit(cache=True)
def _count_in_runs(point: FloatArray, points: FloatArray, starts: IntArray, ends: IntArray, radius2: float, enough: int) -> int:
    count = 0
    for j in range(9):
        for i in range(starts[j], ends[j]):
            if squared_distance(point, points[i]) <= radius2:
                count += 1
        if count >= enough:
            break
    return count


@njit(cache=True)
def _count_within(
    queries: FloatArray,
    points: FloatArray,
    keys: IntArray,
    origin: FloatArray,
    dims: IntArray,
    cell: float,
    radius2: float,
    enough: int,
) -> IntArray:
    counts = np.zeros(len(queries), dtype=np.int64)
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    last = -1
    for q in range(len(queries)):
        key = key_of(queries[q], origin, dims, cell)
        if key < 0:
            continue
        if key != last:
            runs_around(keys, key, dims[1] * dims[2], dims[2], starts, ends)
            last = key
        counts[q] = _count_in_runs(queries[q], points, starts, ends, radius2, enough)
    return counts


@njit(cache=True)
def _count_self(points: FloatArray, keys: IntArray, dims: IntArray, radius2: float, enough: int) -> IntArray:
    counts = np.zeros(len(points), dtype=np.int64)
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    last = -1
    for q in range(len(points)):
        if keys[q] != last:
            last = keys[q]
            runs_around(keys, last, dims[1] * dims[2], dims[2], starts, ends)
        counts[q] = _count_in_runs(points[q], points, starts, ends, radius2, enough)
    return counts


@njit(cache=True)
def find_root(parent: IntArray, i: int) -> int:
    """Return the root of i and shorten the path to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def _near(points: FloatArray, features: FloatArray, a: int, b: int, radius2: float, feature2: float) -> bool:
    if squared_distance(points[a], points[b]) > radius2:
        return False
    difference = 0.0
    for k in range(features.shape[1]):
        difference += (features[a, k] - features[b, k]) ** 2
    return difference <= feature2


@njit(cache=True)
def _connect(
    points: FloatArray, keys: IntArray, dims: IntArray, radius2: float, features: FloatArray, feature2: float
) -> IntArray:
    parent = np.arange(len(points))
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    last = -1
    for q in range(len(points)):
        if keys[q] != last:
            last = keys[q]
            runs_around(keys, last, dims[1] * dims[2], dims[2], starts, ends)
        for j in range(9):
            for i in range(max(starts[j], q + 1), ends[j]):
                if _near(points, features, q, i, radius2, feature2):
                    a, b = find_root(parent, q), find_root(parent, i)
                    parent[max(a, b)] = min(a, b)
    for q in range(len(points)):
        parent[q] = find_root(parent, q)
    return parent


@njit(cache=True)
def _adjacent(points: FloatArray, keys: IntArray, dims: IntArray, radius2: float, labels: IntArray, count: int) -> IntArray:
    found = np.zeros(1024, dtype=np.int64)
    size = 0
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    last = -1
    for q in range(len(points)):
        if keys[q] != last:
            last = keys[q]
            runs_around(keys, last, dims[1] * dims[2], dims[2], starts, ends)
        previous = -1
        for j in range(9):
            for i in range(max(starts[j], q + 1), ends[j]):
                if labels[i] == labels[q] or squared_distance(points[q], points[i]) > radius2:
                    continue
                code = min(labels[i], labels[q]) * count + max(labels[i], labels[q])
                if code == previous:
                    continue
                previous = code
                if size == len(found):
                    grown = np.zeros(2 * size, dtype=np.int64)
                    grown[:size] = found
                    found = grown
                found[size] = code
                size += 1
    return found[:size]
