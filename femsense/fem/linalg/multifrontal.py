# mypy: allow-untyped-decorators
"""The numbers of a multifrontal factor: fronts, panels and update matrices, compiled."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.linalg.blas import Blas, gemm, syrk
from femsense.fem.linalg.simd_tiles import WIDE, add_run, subtract_and_solve, subtract_product, write_product
from femsense.fem.linalg.symbolic import Tree

LARGE = 144
"""Columns that register tiles factorise at a time; wider fronts also call BLAS. Two solid bars were slower by up to 2 % with 120 columns,
and with 180 by up to 5 % in double precision (1–2 % faster in single)."""


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
    """Factorise columns first … last of a panel whose earlier columns are factorised; return False if a pivot is not positive."""
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
def _add_children(
    tree: Tree, low: int, high: int, front: int, height: int, child: int, follow: IntArray, pile: int, L: FloatArray
) -> None:
    """Add the update matrices of a child and its followers to nodes low … high of the columns of a front.

    Arguments:
        front, height: address of the front and rows in it.
        child, follow: the first child, and the next child after each (−1: none).
        pile: address of the update matrices.
        L: the factor, for its kind of numbers.

    The update matrix is added one pair of runs at a time: columns with the same few rows follow each other, which the processor foresees.
    """
    unit, begin, place, heads, runs, room = tree.unit, tree.begin, tree.place, tree.heads, tree.runs, tree.room
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
def factorize(tree: Tree, values: FloatArray, source: IntArray, blas: Blas, L: FloatArray, stack: FloatArray) -> bool:
    """Write the factor of a matrix to L; return False where the matrix is not positive definite.

    Arguments:
        values: entries of the matrix.
        source: where the entries named by `tree.source` stand in `values`.
        blas: the routines for the numbers of L.
        stack: memory for the update matrices, of the same kind, tree.stack entries.
    """
    width, corner, count = L.itemsize, np.empty(WIDE * WIDE, L.dtype), len(tree.parent)
    base, pile = L.ctypes.data, stack.ctypes.data
    head, follow = np.full(count, -1, np.int64), np.empty(count, np.int64)  # children of each supernode as a linked list
    for s in range(count):
        own = tree.firsts[s + 1] - tree.firsts[s]
        columns, rest = tree.unit * own, tree.unit * (tree.begin[s + 1] - tree.begin[s])
        height, start, update = columns + rest, tree.offset[s], pile + width * tree.room[s]
        # assemble the panel
        L[start : tree.offset[s + 1]] = 0.0
        for k in range(tree.entries[s], tree.entries[s + 1]):
            L[start + tree.target[k]] = values[source[k]]
        _add_children(tree, 0, own, base + width * start, height, head[s], follow, pile, L)
        # factorise it
        for j in range(0, columns, LARGE):
            last = min(j + LARGE, columns)
            if not _factor_panel(L, start, height, j, last, corner):
                return False
            if last < columns:  # A[last:, last:columns] −= X[last:, j:last] X[last:columns, j:last]ᵀ
                x, y = base + width * (start + j * height + last), base + width * (start + last * height + last)
                gemm(blas, False, True, height - last, columns - last, last - j, -1.0, x, height, x, height, 1.0, y, height)
        # update matrix: −X Xᵀ with the rows X below, then the parts of the children's update matrices that concern these rows
        x = base + width * (start + columns)
        if columns > LARGE and rest > 0:
            syrk(blas, rest, columns, -1.0, x, height, update, rest)
        else:
            for j in range(0, rest, WIDE):
                here = x + width * j
                to = update + width * (j * rest + j)
                write_product(L, here, here, height, to, rest, rest - j, min(WIDE, rest - j), columns)
        _add_children(tree, own, height, update - width * columns * (rest + 1), rest, head[s], follow, pile, L)
        if tree.parent[s] != -1:
            follow[s] = head[tree.parent[s]]
            head[tree.parent[s]] = s
    return True
