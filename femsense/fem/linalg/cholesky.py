# mypy: allow-untyped-decorators
"""Sparse Cholesky of stiffness matrices: multifrontal, supernodal, in single or double precision.

The analysis (elimination tree, supernodes, where every entry goes) depends on the sparsity pattern alone and is kept. Dense
work goes to the BLAS that SciPy brings. Right-hand sides with few entries, as points and cables have, only visit the part of
the tree above them: that is what makes `gram` (B'K⁻¹B without K⁻¹B) cheap. References: Liu 1992 (multifrontal method),
Ashcraft & Grimes 1989 (relaxed supernodes), Gilbert 1994 (the reach of a sparse right-hand side).
"""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from llvmlite import ir
from numba import njit, types
from numba.extending import get_cython_function_address, intrinsic

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.parallel import one_blas_thread
from femsense.fem.linalg.simd_kernels import (
    SIDES,
    WIDE,
    add_run,
    down_one,
    down_six,
    down_six_sides,
    down_three,
    down_three_sides,
    subtract_and_solve,
    subtract_product,
    up_one,
    up_six,
    up_six_sides,
    up_three,
    up_three_sides,
    write_product,
)
from femsense.fem.linalg.symbolic import Analysis

FEW = 4
"""Right-hand sides that are solved one by one where the matrix has no blocks; more go through BLAS together."""
BESIDE = 40
"""Right-hand sides that are solved beside each other in groups of SIDES; BLAS takes less time for more. For 10 to 16 of a bar it took twice as long in a trial."""
LARGE = 144
"""Columns of a front from which on BLAS does as well as tiles in registers, and that tiles factorise at a time: two solid bars were slower
by up to 2 % with 120, and with 180 by up to 5 % in double precision (in single 1–2 % faster)."""


@intrinsic
def _call(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call a Fortran routine at an address; all its arguments are pointers, given as a tuple of integers."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        integer = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [integer] * len(arguments))
        pointers = [builder.extract_value(values[1], i) for i in range(len(arguments))]
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, arguments), build


# --- numbers -------------------------------------------------------------------------------------------------------------


@njit(cache=True)
def _factor_corner(L: FloatArray, at: int, height: int, columns: int, corner: FloatArray) -> bool:
    """Factorise the first columns ≤ 6 and rows of a panel that begins at `at`; write them to `corner` too, with reciprocal diagonal."""
    for j in range(columns):
        pivot = L[at + j * height + j]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / np.sqrt(pivot)
        corner[j * WIDE + j] = inverse
        L[at + j * height + j] = pivot * inverse
        for i in range(j + 1, columns):
            value = L[at + j * height + i] * inverse
            L[at + j * height + i] = value
            corner[i * WIDE + j] = value
        for k in range(j + 1, columns):
            scale = corner[k * WIDE + j]
            for i in range(k, columns):
                L[at + k * height + i] -= scale * corner[i * WIDE + j]
    return True


@njit(cache=True)
def _factor_panel(L: FloatArray, start: int, height: int, first: int, last: int, corner: FloatArray) -> bool:
    """Factorise columns first … last of a panel, those before being done with; False where a pivot is not positive."""
    width = L.itemsize
    for j in range(first, last, WIDE):
        columns, depth = min(WIDE, last - j), j - first
        at = start + j * height + j
        left, here = L.ctypes.data + width * (start + first * height + j), L.ctypes.data + width * at
        subtract_product(L, left, left, height, here, height, columns, columns, depth)
        if not _factor_corner(L, at, height, columns, corner):
            return False
        step, rows = width * columns, height - j - columns
        subtract_and_solve(L, left + step, left, height, here + step, height, rows, columns, depth, corner.ctypes.data)
    return True


@njit(cache=True)
def _take_children(
    low: int,
    high: int,
    front: int,
    height: int,
    child: int,
    follow: IntArray,
    unit: int,
    begin: IntArray,
    place: IntArray,
    heads: IntArray,
    runs: IntArray,
    room: IntArray,
    pile: int,
    L: FloatArray,
) -> None:
    """Add the update matrices of a child and its followers to nodes low … high of columns of a front at an address.

    It goes from one pair of runs to the next: columns with the same few rows follow each other, which the processor foresees.
    """
    node, step = L.itemsize * unit, L.itemsize * height
    while child != -1:
        rows, end = place[begin[child] : begin[child + 1]], heads[child + 1]
        update, size = pile + L.itemsize * room[child], node * len(rows)
        for c in range(heads[child], end):
            last = runs[c + 1] if c + 1 < end else len(rows)
            shift = rows[runs[c]] - runs[c]
            left, right = max(runs[c], low - shift), min(last, high - shift)
            for j in range(left, right):
                to, line = front + (unit * step + node) * (j + shift), update + (unit * size + node) * j
                for b in range(unit):
                    add_run(L, to + step * b, line + size * b, unit * (last - j))
            for r in range(c + 1, end if left < right else c):
                i, after = runs[r], runs[r + 1] if r + 1 < end else len(rows)
                to, line = front + unit * step * (left + shift) + node * rows[i], update + unit * size * left + node * i
                for b in range(unit * (right - left)):
                    add_run(L, to + step * b, line + size * b, unit * (after - i))
        child = follow[child]


@njit(cache=True, nogil=True)
def _factorise(
    values: FloatArray,
    entries: IntArray,
    source: IntArray,
    target: IntArray,
    unit: int,
    firsts: IntArray,
    parent: IntArray,
    begin: IntArray,
    place: IntArray,
    offset: IntArray,
    heads: IntArray,
    runs: IntArray,
    room: IntArray,
    blas: IntArray,
    L: FloatArray,
    stack: FloatArray,
    head: IntArray,
    follow: IntArray,
    letters: npt.NDArray[np.uint8],
    numbers: npt.NDArray[np.int32],
    scalars: FloatArray,
) -> bool:
    """Write the factor; False where the matrix is not positive definite."""
    width, corner = L.itemsize, np.empty(WIDE * WIDE, L.dtype)
    lower, no, yes = letters.ctypes.data, letters.ctypes.data + 1, letters.ctypes.data + 2
    at, minus, one, zero = numbers.ctypes.data, scalars.ctypes.data, scalars.ctypes.data + width, scalars.ctypes.data + 2 * width
    base, pile = L.ctypes.data, stack.ctypes.data
    family = (follow, unit, begin, place, heads, runs, room, pile, L)
    head[:] = -1
    for s in range(len(parent)):
        own = firsts[s + 1] - firsts[s]
        columns, rest = unit * own, unit * (begin[s + 1] - begin[s])
        height, start, update = columns + rest, offset[s], pile + width * room[s]
        L[start : offset[s + 1]] = 0.0
        for k in range(entries[s], entries[s + 1]):
            L[start + target[k]] = values[source[k]]
        _take_children(0, own, base + width * start, height, head[s], *family)
        for j in range(0, columns, LARGE):
            last = min(j + LARGE, columns)
            if not _factor_panel(L, start, height, j, last, corner):
                return False
            if last < columns:  # the rest of the panel: A[last:, last:columns] −= X[last:, j:last] X[last:columns, j:last]ᵀ
                numbers[0], numbers[1], numbers[2], numbers[3] = height - last, columns - last, last - j, height
                x, y = base + width * (start + j * height + last), base + width * (start + last * height + last)
                _call(blas[0], (no, yes, at, at + 4, at + 8, minus, x, at + 12, x, at + 12, one, y, at + 12))
        x = base + width * (start + columns)
        if columns > LARGE and rest > 0:
            numbers[0], numbers[1], numbers[2], numbers[3] = rest, columns, height, rest
            _call(blas[1], (lower, no, at, at + 4, minus, x, at + 8, zero, update, at + 12))
        else:
            for j in range(0, rest, WIDE):
                here = x + width * j
                to = update + width * (j * rest + j)
                write_product(L, here, here, height, to, rest, rest - j, min(WIDE, rest - j), columns)
        _take_children(own, height, update - width * columns * (rest + 1), rest, head[s], *family)
        if parent[s] != -1:
            follow[s] = head[parent[s]]
            head[parent[s]] = s
    return True


@njit(cache=True, nogil=True)
def _solve_one(
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
def _solve_sides(
    unit: int,
    firsts: IntArray,
    begin: IntArray,
    below: IntArray,
    offset: IntArray,
    L: FloatArray,
    x: FloatArray,
    half: FloatArray,
) -> None:
    """Solve in place for groups of SIDES right-hand sides, x (g, f · SIDES), in the order of elimination; unit is 3 here. half (g, …) has room for the
    tallest front. What is read of the factor for one group is in the cache for the others."""
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
def _solve_many(
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
        _call(blas[2], (right, lower, yes, no, at, at + 4, one, panel, at + 12, here, at))
        if rows > 0:
            _call(
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
            _call(
                blas[0],
                (no, no, at, at + 4, at + 8, minus, work.ctypes.data, at, panel + width * columns, at + 12, one, here, at),
            )
        _call(blas[2], (right, lower, no, no, at, at + 4, one, panel, at + 12, here, at))


@njit(cache=True)
def _reach(parent: IntArray, owner: IntArray, indptr: IntArray, rows: IntArray) -> tuple[IntArray, IntArray]:
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
def _gram(
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
        _call(blas[2], (right, lower, yes, no, at, at + 4, one, L.ctypes.data + width * offset[s], at + 12, here, at))
        if rest > 0:
            below_panel = L.ctypes.data + width * (offset[s] + columns)
            _call(blas[0], (no, yes, at, at + 8, at + 4, one, here, at, below_panel, at + 12, zero, after, at))
            for q in range(begin[s + 1] - begin[s]):
                to = unit * below[begin[s] + q]
                for a in range(unit):
                    line = (columns + unit * q + a) * k
                    for r in range(k):
                        X[to + a, seen[r]] -= work[line + r]
        _call(blas[1], (lower, no, at, at + 4, one, here, at, zero, after, at))
        for c in range(k):
            for r in range(c, k):
                W[seen[r], seen[c]] += work[(columns + c) * k + r]


class Cholesky:
    """A factor K = LLᵀ of a positive definite matrix."""

    def __init__(self, analysis: Analysis, L: npt.NDArray[Any]) -> None:
        self.negative = 0
        self.size = analysis.size
        self.bytes = int(analysis.offset[-1]) * L.itemsize
        self._analysis, self._L = analysis, L
        weakref.finalize(self, analysis.give_back, L)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        a, kind = self._analysis, self._L.dtype
        right = np.asarray(right)
        columns = right.reshape(a.size, -1)
        count = columns.shape[1]
        if 1 < count <= BESIDE and a.unit == 3:
            groups = -(-count // SIDES)
            x, half = np.zeros((groups, a.size, SIDES), kind), np.empty((groups, SIDES * a.tallest), kind)
            for own, part in zip(x, np.split(columns, range(SIDES, count, SIDES), axis=1)):
                own[:, : part.shape[1]] = part[a.order]
            _solve_sides(a.unit, a.firsts, a.begin, a.below, a.offset, self._L, x.reshape(groups, -1), half)
            ordered = np.concatenate(list(x), axis=1)[:, :count]
        elif count < FEW:
            x = np.ascontiguousarray(columns[a.order].T, dtype=kind)
            work = np.empty(a.size, kind)
            for one in x:
                _solve_one(a.unit, a.firsts, a.begin, a.below, a.offset, self._L, one, work)
            ordered = x.T
        else:
            ordered = np.ascontiguousarray(columns[a.order], dtype=kind)
            work = np.empty(a.unit * int(np.diff(a.begin).max(initial=0)) * ordered.shape[1], kind)
            _solve_many(
                a.unit, a.firsts, a.begin, a.below, a.offset, _BLAS[kind.char], self._L, ordered, work, *_constants(kind.char)
            )
        return ordered[a.rank].astype(np.float64, copy=False).reshape(right.shape)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B = (L⁻¹B)ᵀ(L⁻¹B), shape (k, k), for sparse columns B, shape (f, k)."""
        a, k, kind = self._analysis, columns.shape[1], self._L.dtype
        rows = a.rank[columns.indices]
        indptr = columns.indptr.astype(np.int64)
        start, active = _reach(a.parent, a.owner, indptr, rows)
        X = a.columns.pop((kind.char, k), None)
        X = np.zeros((a.size, k), kind) if X is None else X
        X[rows, np.repeat(np.arange(k), np.diff(indptr))] = columns.data
        W = np.zeros((k, k))
        tallest = int((np.diff(a.firsts) + np.maximum(np.diff(a.begin), k)).max(initial=0))
        work = np.empty(a.unit * tallest * k, kind)
        _gram(
            a.unit,
            a.firsts,
            a.begin,
            a.below,
            a.offset,
            start,
            active,
            _BLAS[kind.char],
            self._L,
            X,
            work,
            W,
            *_constants(kind.char),
        )
        a.columns[kind.char, k] = X
        return np.asarray(W + np.tril(W, -1).T)


def cholesky(
    analysis: Analysis, values: FloatArray, *, single: bool = False, source: npt.NDArray[np.int32] | None = None
) -> Cholesky | None:
    """Factorise a symmetric matrix of an analysed pattern; None where it is not positive definite.

    Arguments:
        analysis: from `analyse`.
        values: its entries in CSC order, shape (nnz,).
        single: work in single precision (errors of 1e-7 times the condition of the matrix: a preconditioner).
        source: where the entries that `Analysis.source` names are in `values`, where these are in another order.
    """
    a, kind = analysis, "f" if single else "d"
    L, stack = a.take(kind, int(a.offset[-1])), a.take(kind, a.stack)
    head, follow = np.empty(len(a.parent), np.int64), np.empty(len(a.parent), np.int64)
    with one_blas_thread():
        definite = _factorise(
            values,
            a.entries,
            a.source if source is None else source,
            a.target,
            a.unit,
            a.firsts,
            a.parent,
            a.begin,
            a.place,
            a.offset,
            a.heads,
            a.runs,
            a.room,
            _BLAS[kind],
            L,
            stack,
            head,
            follow,
            *_constants(kind),
        )
    a.give_back(stack)
    if definite:
        return Cholesky(a, L)
    a.give_back(L)
    return None


def _addresses(kind: str) -> IntArray:
    return np.array(
        [get_cython_function_address("scipy.linalg.cython_blas", kind + name) for name in ("gemm", "syrk", "trsm")],
        dtype=np.int64,
    )


def _constants(kind: str) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32], npt.NDArray[Any]]:
    """Return what BLAS is pointed at: letters L N T R, room for integers, and −1, 1, 0."""
    return np.frombuffer(b"LNTR", np.uint8), np.zeros(4, np.int32), np.array([-1.0, 1.0, 0.0], kind)


_BLAS = {"d": _addresses("d"), "f": _addresses("s")}
