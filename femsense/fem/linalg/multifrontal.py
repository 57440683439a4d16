# mypy: allow-untyped-decorators
"""The numbers of a multifrontal factor: fronts, panels and update matrices, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.linalg.simd_tiles import WIDE, add_run, subtract_and_solve, subtract_product, write_product

LARGE = 144
"""Columns of a front from which on BLAS does as well as tiles in registers, and that tiles factorise at a time:
two solid bars were slower by up to 2 % with 120, and with 180 by up to 5 % in double precision (in single 1–2 % faster)."""


@intrinsic
def call_blas(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call a Fortran routine at an address; all its arguments are pointers, given as a tuple of integers."""
    del typing_context

    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        integer = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [integer] * len(arguments))
        pointers = [builder.extract_value(values[1], i) for i in range(len(arguments))]
        builder.call(builder.inttoptr(values[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return types.void(address, arguments), build


@njit(cache=True)
def _factor_corner(L: FloatArray, at: int, height: int, columns: int, corner: FloatArray) -> bool:
    """Factorise the first columns ≤ 6 and rows of a panel that begins at `at`; write them to `corner` too,
    with reciprocal diagonal."""
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
def factorise(
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
                call_blas(blas[0], (no, yes, at, at + 4, at + 8, minus, x, at + 12, x, at + 12, one, y, at + 12))
        x = base + width * (start + columns)
        if columns > LARGE and rest > 0:
            numbers[0], numbers[1], numbers[2], numbers[3] = rest, columns, height, rest
            call_blas(blas[1], (lower, no, at, at + 4, minus, x, at + 8, zero, update, at + 12))
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
