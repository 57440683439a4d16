# mypy: allow-untyped-decorators
"""Solves with a multifrontal factor: one side, a few side by side, many by BLAS, and sparse ones; compiled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.linalg.multifrontal import call_blas
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


@njit(cache=True, nogil=True)
def solve_one(
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    L: FloatArray,
    x: FloatArray,
    half: FloatArray,
) -> None:
    """Solve in place for one right-hand side in the order of elimination."""
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
def solve_sides(
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    L: FloatArray,
    x: FloatArray,
    half: FloatArray,
) -> None:
    """Solve in place for groups of SIDES right-hand sides, x (g, f · SIDES), in the order of elimination; unit is 3 here.
    half (g, …) has room for the tallest front. What is read of the factor for one group is in the cache for the others."""
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
def solve_many(
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    blas: IntArray,
    L: FloatArray,
    X: FloatArray,
    work: FloatArray,
    letters: npt.NDArray[np.uint8],
    numbers: npt.NDArray[np.int32],
    scalars: FloatArray,
) -> None:
    """Solve in place for the columns of X (f, k) in the order of elimination; work holds k times the tallest front."""
    width, k = L.itemsize, X.shape[1]
    lower, no, yes, right = letters.ctypes.data, letters.ctypes.data + 1, letters.ctypes.data + 2, letters.ctypes.data + 3
    at = numbers.ctypes.data
    minus, one, zero = scalars.ctypes.data, scalars.ctypes.data + width, scalars.ctypes.data + 2 * width
    numbers[0] = k
    for s in range(len(firsts) - 1):
        c0, columns, rows = unit * firsts[s], unit * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        numbers[1], numbers[2], numbers[3] = columns, unit * rows, columns + unit * rows
        panel, here = L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        call_blas(blas[2], (right, lower, yes, no, at, at + 4, one, panel, at + 12, here, at))
        if rows > 0:
            call_blas(
                blas[0],
                (no, yes, at, at + 8, at + 4, one, here, at, panel + width * columns, at + 12, zero, work.ctypes.data, at),
            )
        for q in range(rows):
            for a in range(unit):
                line, part = X[unit * below[begin[s] + q] + a], work[(unit * q + a) * k : (unit * q + a + 1) * k]
                for r in range(k):
                    line[r] -= part[r]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns, rows = unit * firsts[s], unit * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        numbers[1], numbers[2], numbers[3] = columns, unit * rows, columns + unit * rows
        panel, here = L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        for q in range(rows):
            for a in range(unit):
                for r in range(k):
                    work[(unit * q + a) * k + r] = X[unit * below[begin[s] + q] + a, r]
        if rows > 0:
            call_blas(
                blas[0],
                (no, no, at, at + 4, at + 8, minus, work.ctypes.data, at, panel + width * columns, at + 12, one, here, at),
            )
        call_blas(blas[2], (right, lower, no, no, at, at + 4, one, panel, at + 12, here, at))


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
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    start: IntArray,
    active: IntArray,
    blas: IntArray,
    L: FloatArray,
    X: FloatArray,
    work: FloatArray,
    W: FloatArray,
    letters: npt.NDArray[np.uint8],
    numbers: npt.NDArray[np.int32],
    scalars: FloatArray,
) -> None:
    """Add XᵀK⁻¹X to W (lower half in the order of `active`); X (f, k), in the order of elimination, is zero after it."""
    width = L.itemsize
    lower, no, yes, right = letters.ctypes.data, letters.ctypes.data + 1, letters.ctypes.data + 2, letters.ctypes.data + 3
    at = numbers.ctypes.data
    one, zero = scalars.ctypes.data + width, scalars.ctypes.data + 2 * width
    for s in range(len(firsts) - 1):
        seen = active[start[s] : start[s + 1]]
        k = len(seen)
        if k == 0:
            continue
        c0, columns = unit * firsts[s], unit * (firsts[s + 1] - firsts[s])
        rest = unit * (begin[s + 1] - begin[s])
        height = columns + rest
        for i in range(columns):
            for r in range(k):
                work[i * k + r] = X[c0 + i, seen[r]]
                X[c0 + i, seen[r]] = 0.0
        numbers[0], numbers[1], numbers[2], numbers[3] = k, columns, rest, height
        here = work.ctypes.data
        after = here + width * columns * k
        call_blas(blas[2], (right, lower, yes, no, at, at + 4, one, L.ctypes.data + width * offset[s], at + 12, here, at))
        if rest > 0:
            below_panel = L.ctypes.data + width * (offset[s] + columns)
            call_blas(blas[0], (no, yes, at, at + 8, at + 4, one, here, at, below_panel, at + 12, zero, after, at))
            for q in range(begin[s + 1] - begin[s]):
                to = unit * below[begin[s] + q]
                for a in range(unit):
                    line = (columns + unit * q + a) * k
                    for r in range(k):
                        X[to + a, seen[r]] -= work[line + r]
        call_blas(blas[1], (lower, no, at, at + 4, one, here, at, zero, after, at))
        for c in range(k):
            for r in range(c, k):
                W[seen[r], seen[c]] += work[(columns + c) * k + r]
