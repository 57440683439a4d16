# mypy: allow-untyped-decorators
"""Solves with a multifrontal factor: for a few right-hand sides, for many by BLAS, and for sparse ones; compiled."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.linalg.blas import Blas, gemm, numbers_at, syrk, trsm
from femsense.fem.linalg.symbolic import Tree
from femsense.fem.rotation import FAST

SIDES = 3
"""Number of right-hand sides that `solve_few` takes through the columns of a node at once, if there are several: nine products for six
numbers read."""


@njit(cache=True, fastmath={"contract"})
def _forward(sides: int, like: FloatArray, at: int, step: int, y: int, line: int, rows: int) -> None:
    """Eliminate a node, whose three columns begin with the diagonal at the address `at`, from right-hand sides at y, `line` bytes apart."""
    a, b, c = numbers_at(like, at), numbers_at(like, at + step), numbers_at(like, at + 2 * step)
    for k in range(sides):
        u = numbers_at(like, y + k * line)
        u[0] /= a[0]
        u[1] = (u[1] - a[1] * u[0]) / b[1]
        u[2] = (u[2] - a[2] * u[0] - b[2] * u[1]) / c[2]
    u, v, w = numbers_at(like, y), numbers_at(like, y + line), numbers_at(like, y + 2 * line)
    u0, u1, u2 = u[0], u[1], u[2]
    if sides == 1:
        for i in range(3, rows):
            u[i] -= a[i] * u0 + b[i] * u1 + c[i] * u2
        return
    v0, v1, v2, w0, w1, w2 = v[0], v[1], v[2], w[0], w[1], w[2]
    for i in range(3, rows):
        p, q, r = a[i], b[i], c[i]
        u[i] -= p * u0 + q * u1 + r * u2
        v[i] -= p * v0 + q * v1 + r * v2
        w[i] -= p * w0 + q * w1 + r * w2


@njit(inline="always")
def _finish(a, b, c, u, u0, u1, u2):  # type: ignore[no-untyped-def]
    """Solve with the transposed triangle of a node, given the products with what is below."""
    u[2] = (u[2] - u2) / c[2]
    u[1] = (u[1] - u1 - b[2] * u[2]) / b[1]
    u[0] = (u[0] - u0 - a[1] * u[1] - a[2] * u[2]) / a[0]


@njit(cache=True, fastmath=FAST)
def _backward(sides: int, like: FloatArray, at: int, step: int, y: int, line: int, rows: int) -> None:
    """Solve for the unknowns of a node by backward substitution: the unknowns below it are known. Arguments as of `_forward`."""
    a, b, c = numbers_at(like, at), numbers_at(like, at + step), numbers_at(like, at + 2 * step)
    u, v, w = numbers_at(like, y), numbers_at(like, y + line), numbers_at(like, y + 2 * line)
    u0 = u1 = u2 = v0 = v1 = v2 = w0 = w1 = w2 = like.dtype.type(0.0)
    if sides == 1:
        for i in range(3, rows):
            u0 += a[i] * u[i]
            u1 += b[i] * u[i]
            u2 += c[i] * u[i]
    else:
        for i in range(3, rows):
            p, q, r = a[i], b[i], c[i]
            u0 += p * u[i]
            u1 += q * u[i]
            u2 += r * u[i]
            v0 += p * v[i]
            v1 += q * v[i]
            v2 += r * v[i]
            w0 += p * w[i]
            w1 += q * w[i]
            w2 += r * w[i]
        _finish(a, b, c, v, v0, v1, v2)
        _finish(a, b, c, w, w0, w1, w2)
    _finish(a, b, c, u, u0, u1, u2)


@njit(cache=True, nogil=True)
def solve_few(tree: Tree, L: FloatArray, x: FloatArray, fronts: FloatArray) -> None:
    """Solve in place for right-hand sides x (k, f), k = 1 or a multiple of SIDES, in the order of elimination.

    All of them go through a panel while it is in the cache. `fronts` (k, …) is work memory for the tallest front.
    """
    firsts, begin, below, width, work = tree.firsts, tree.begin, tree.below, L.itemsize, fronts.ctypes.data
    sides, line = min(SIDES, len(x)), width * fronts.shape[1]
    for s in range(len(firsts) - 1):
        c0, columns, nodes = 3 * firsts[s], 3 * (firsts[s + 1] - firsts[s]), below[begin[s] : begin[s + 1]]
        height, panel = columns + 3 * len(nodes), L.ctypes.data + width * tree.offset[s]
        for r in range(len(x)):
            for i in range(columns):
                fronts[r, i] = x[r, c0 + i]
            for i in range(columns, height):
                fronts[r, i] = 0.0
        for r in range(0, len(x), sides):
            for j in range(0, columns, 3):
                at, y = panel + width * j * (height + 1), work + line * r + width * j
                _forward(sides, L, at, width * height, y, line, height - j)
        for r in range(len(x)):
            for i in range(columns):
                x[r, c0 + i] = fronts[r, i]
            for q in range(len(nodes)):
                for i in range(3):
                    x[r, 3 * nodes[q] + i] += fronts[r, columns + 3 * q + i]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns, nodes = 3 * firsts[s], 3 * (firsts[s + 1] - firsts[s]), below[begin[s] : begin[s + 1]]
        height, panel = columns + 3 * len(nodes), L.ctypes.data + width * tree.offset[s]
        for r in range(len(x)):
            for i in range(columns):
                fronts[r, i] = x[r, c0 + i]
            for q in range(len(nodes)):
                for i in range(3):
                    fronts[r, columns + 3 * q + i] = x[r, 3 * nodes[q] + i]
        for r in range(0, len(x), sides):
            for j in range(columns - 3, -1, -3):
                at, y = panel + width * j * (height + 1), work + line * r + width * j
                _backward(sides, L, at, width * height, y, line, height - j)
        for r in range(len(x)):
            for i in range(columns):
                x[r, c0 + i] = fronts[r, i]


@njit(cache=True, nogil=True)
def solve_many(tree: Tree, blas: Blas, L: FloatArray, X: FloatArray, work: FloatArray) -> None:
    """Solve in place for the columns of X (f, k) in the order of elimination; `work` holds k times the tallest front."""
    firsts, begin, below, offset = tree.firsts, tree.begin, tree.below, tree.offset
    width, k, after = L.itemsize, X.shape[1], work.ctypes.data
    for s in range(len(firsts) - 1):
        c0, columns, rows = 3 * firsts[s], 3 * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        height, panel, here = columns + 3 * rows, L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        trsm(blas, True, k, columns, panel, height, here, k)
        if rows > 0:
            gemm(blas, False, True, k, 3 * rows, columns, 1.0, here, k, panel + width * columns, height, 0.0, after, k)
        for q in range(rows):
            for a in range(3):
                line, part = X[3 * below[begin[s] + q] + a], work[(3 * q + a) * k : (3 * q + a + 1) * k]
                for r in range(k):
                    line[r] -= part[r]
    for s in range(len(firsts) - 2, -1, -1):
        c0, columns, rows = 3 * firsts[s], 3 * (firsts[s + 1] - firsts[s]), begin[s + 1] - begin[s]
        height, panel, here = columns + 3 * rows, L.ctypes.data + width * offset[s], X.ctypes.data + width * c0 * k
        for q in range(rows):
            for a in range(3):
                for r in range(k):
                    work[(3 * q + a) * k + r] = X[3 * below[begin[s] + q] + a, r]
        if rows > 0:
            gemm(blas, False, False, k, columns, 3 * rows, -1.0, after, k, panel + width * columns, height, 1.0, here, k)
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
    firsts, begin, below, offset = tree.firsts, tree.begin, tree.below, tree.offset
    width, here = L.itemsize, work.ctypes.data
    for s in range(len(firsts) - 1):
        seen = active[start[s] : start[s + 1]]
        k = len(seen)
        if k == 0:
            continue
        c0, columns = 3 * firsts[s], 3 * (firsts[s + 1] - firsts[s])
        rest = 3 * (begin[s + 1] - begin[s])
        height, panel, after = columns + rest, L.ctypes.data + width * offset[s], here + width * columns * k
        for i in range(columns):
            for r in range(k):
                work[i * k + r] = X[c0 + i, seen[r]]
                X[c0 + i, seen[r]] = 0.0
        trsm(blas, True, k, columns, panel, height, here, k)
        if rest > 0:
            gemm(blas, False, True, k, rest, columns, 1.0, here, k, panel + width * columns, height, 0.0, after, k)
            for q in range(begin[s + 1] - begin[s]):
                to = 3 * below[begin[s] + q]
                for a in range(3):
                    line = (columns + 3 * q + a) * k
                    for r in range(k):
                        X[to + a, seen[r]] -= work[line + r]
        syrk(blas, k, columns, 1.0, here, k, after, k)
        for c in range(k):
            for r in range(c, k):
                W[seen[r], seen[c]] += work[(columns + c) * k + r]
