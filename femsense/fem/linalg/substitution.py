# mypy: allow-untyped-decorators
"""Solves with a multifrontal factor: for one right-hand side, a few side by side, many by BLAS, and for sparse ones; compiled."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.linalg.blas import Blas, gemm, syrk, trsm
from femsense.fem.linalg.simd_columns import (
    SIDES,
    down_one,
    down_six,
    down_six_sides,
    down_three,
    down_three_sides,
    up_one,
    up_six,
    up_six_sides,
    up_three,
    up_three_sides,
)
from femsense.fem.linalg.simd_tiles import add_run
from femsense.fem.linalg.symbolic import Tree


@njit(cache=True, nogil=True)
def solve_one(tree: Tree, L: FloatArray, x: FloatArray, half: FloatArray) -> None:
    """Solve in place for one right-hand side x (f,) in the order of elimination; `half` (f,) is work memory."""
    unit, firsts, begin, below, offset = tree.unit, tree.firsts, tree.begin, tree.below, tree.offset
    width, base, y = L.itemsize, L.ctypes.data, half.ctypes.data
    for s in range(len(firsts) - 1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        for i in range(columns):
            half[i] = x[c0 + i]
        for i in range(columns, height):
            half[i] = 0.0
        j = 0
        while j < columns:
            size = 6 if columns - j >= 6 else 3 if columns - j >= 3 else 1
            at, to = base + width * (offset[s] + j * height + j), y + width * j
            left, ahead = height - j - size, width * size * (height + 1)
            if size == 6:
                down_six(L, at, height, to, left, ahead)
            elif size == 3:
                down_three(L, at, height, to, left, ahead)
            else:
                down_one(L, at, height, to, left, ahead)
            j += size
        for i in range(columns):
            x[c0 + i] = half[i]
        for q in range(begin[s + 1] - begin[s]):
            line = unit * below[begin[s] + q]
            for a in range(unit):
                x[line + a] += half[columns + unit * q + a]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        for i in range(columns):
            half[i] = x[c0 + i]
        for q in range(begin[s + 1] - begin[s]):
            line = unit * below[begin[s] + q]
            for a in range(unit):
                half[columns + unit * q + a] = x[line + a]
        j = columns
        while j > 0:
            size = 6 if j >= 6 else 3 if j >= 3 else 1
            j -= size
            at, to = base + width * (offset[s] + j * height + j), y + width * j
            left, ahead = height - j - size, -width * size * (height + 1)
            if size == 6:
                up_six(L, at, height, to, left, ahead)
            elif size == 3:
                up_three(L, at, height, to, left, ahead)
            else:
                up_one(L, at, height, to, left, ahead)
        for i in range(columns):
            x[c0 + i] = half[i]


@njit(cache=True, nogil=True)
def solve_sides(tree: Tree, L: FloatArray, x: FloatArray, half: FloatArray) -> None:
    """Solve in place for groups of SIDES right-hand sides, x (g, f · SIDES), in the order of elimination, where a node has 3 unknowns.

    `half` (g, …) is work memory for the tallest front. All groups go through a panel while it is in the cache.
    """
    unit, firsts, begin, below, offset = tree.unit, tree.firsts, tree.begin, tree.below, tree.offset
    width, base, groups = L.itemsize, L.ctypes.data, len(x)
    line, block = width * SIDES, SIDES * unit
    for s in range(len(firsts) - 1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        for g in range(groups):
            for i in range(SIDES * columns):
                half[g, i] = x[g, SIDES * c0 + i]
            for i in range(SIDES * columns, SIDES * height):
                half[g, i] = 0.0
        j = 0
        while j < columns:
            size = 6 if columns - j >= 6 else 3
            at, left, ahead = base + width * (offset[s] + j * height + j), height - j - size, width * size * (height + 1)
            for g in range(groups):
                if size == 6:
                    down_six_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
                else:
                    down_three_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
            j += size
        for g in range(groups):
            for i in range(SIDES * columns):
                x[g, SIDES * c0 + i] = half[g, i]
            to, y = x[g].ctypes.data, half[g].ctypes.data
            for q in range(begin[s + 1] - begin[s]):
                add_run(L, to + width * block * below[begin[s] + q], y + line * (columns + unit * q), block)
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        height = columns + unit * (begin[s + 1] - begin[s])
        for g in range(groups):
            for i in range(SIDES * columns):
                half[g, i] = x[g, SIDES * c0 + i]
            for q in range(begin[s + 1] - begin[s]):
                source, to = block * below[begin[s] + q], SIDES * (columns + unit * q)
                for i in range(block):
                    half[g, to + i] = x[g, source + i]
        j = columns
        while j > 0:
            size = 6 if j >= 6 else 3
            j -= size
            at, left, ahead = base + width * (offset[s] + j * height + j), height - j - size, -width * size * (height + 1)
            for g in range(groups):
                if size == 6:
                    up_six_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
                else:
                    up_three_sides(L, at, height, half[g].ctypes.data + line * j, left, ahead)
        for g in range(groups):
            for i in range(SIDES * columns):
                x[g, SIDES * c0 + i] = half[g, i]


@njit(cache=True, nogil=True)
def solve_many(tree: Tree, blas: Blas, L: FloatArray, X: FloatArray, work: FloatArray) -> None:
    """Solve in place for the columns of X (f, k) in the order of elimination; `work` holds k times the tallest front."""
    unit, firsts, begin, below, offset = tree.unit, tree.firsts, tree.begin, tree.below, tree.offset
    width, k, after = L.itemsize, X.shape[1], work.ctypes.data
    for s in range(len(firsts) - 1):
        c0, columns, rows = unit * firsts[s], unit * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        height, panel, here = columns + unit * rows, L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        trsm(blas, True, k, columns, panel, height, here, k)
        if rows > 0:
            gemm(blas, False, True, k, unit * rows, columns, 1.0, here, k, panel + width * columns, height, 0.0, after, k)
        for q in range(rows):
            for a in range(unit):
                line, part = X[unit * below[begin[s] + q] + a], work[(unit * q + a) * k : (unit * q + a + 1) * k]
                for r in range(k):
                    line[r] -= part[r]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns, rows = unit * firsts[s], unit * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        height, panel, here = columns + unit * rows, L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        for q in range(rows):
            for a in range(unit):
                for r in range(k):
                    work[(unit * q + a) * k + r] = X[unit * below[begin[s] + q] + a, r]
        if rows > 0:
            gemm(blas, False, False, k, columns, unit * rows, -1.0, after, k, panel + width * columns, height, 1.0, here, k)
        trsm(blas, False, k, columns, panel, height, here, k)


@njit(cache=True)
def reach(parent: IntArray, owner: IntArray, indptr: IntArray, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return which right-hand sides (columns of B, rows in the order of elimination) each supernode sees: indptr, columns."""
    count, columns = len(parent), len(indptr) - 1
    mark = np.full(count, -1, np.int64)
    size = np.zeros(count + 1, np.int64)
    for fill in range(2):
        mark[:] = -1
        if fill == 1:
            start = np.zeros(count + 1, np.int64)
            for s in range(count):
                start[s + 1] = start[s] + size[s]
            active = np.empty(start[count], np.int64)
            size[:] = 0
        for r in range(columns):
            for p in range(indptr[r], indptr[r + 1]):
                s = owner[rows[p]]
                while s != -1 and mark[s] != r:
                    mark[s] = r
                    if fill == 1:
                        active[start[s] + size[s]] = r
                    size[s] += 1
                    s = parent[s]
    return start, active


@njit(cache=True)
def add_gram(
    tree: Tree, blas: Blas, start: IntArray, active: IntArray, L: FloatArray, X: FloatArray, work: FloatArray, W: FloatArray
) -> None:
    """Add XᵀK⁻¹X to the lower half of W (in the order of `active`); X (f, k), in the order of elimination, is zero afterwards.

    Arguments:
        start, active: which columns of X each supernode sees (`reach`).
        work: memory for k columns of the tallest front, or of a supernode with k rows below.
    """
    unit, firsts, begin, below, offset = tree.unit, tree.firsts, tree.begin, tree.below, tree.offset
    width, here = L.itemsize, work.ctypes.data
    for s in range(len(firsts) - 1):
        seen = active[start[s] : start[s + 1]]
        k = len(seen)
        if k == 0:
            continue
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        rest = unit * (begin[s + 1] - begin[s])
        height, panel, after = columns + rest, L.ctypes.data + width * offset[s], here + width * columns * k
        for i in range(columns):
            for r in range(k):
                work[i * k + r] = X[c0 + i, seen[r]]
                X[c0 + i, seen[r]] = 0.0
        trsm(blas, True, k, columns, panel, height, here, k)
        if rest > 0:
            gemm(blas, False, True, k, rest, columns, 1.0, here, k, panel + width * columns, height, 0.0, after, k)
            for q in range(begin[s + 1] - begin[s]):
                to = unit * below[begin[s] + q]
                for a in range(unit):
                    line = (columns + unit * q + a) * k
                    for r in range(k):
                        X[to + a, seen[r]] -= work[line + r]
        syrk(blas, k, columns, 1.0, here, k, after, k)
        for c in range(k):
            for r in range(c, k):
                W[seen[r], seen[c]] += work[(columns + c) * k + r]
