# mypy: allow-untyped-decorators
"""The numbers of a multifrontal factor: fronts, panels and update matrices, compiled."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit
from femsense.fem.linalg.blas import numbers_at
from femsense.fem.linalg.symbolic import Tree


@njit(cache=True, fastmath={"contract"})
def _subtract_product(
    like: FloatArray, a: int, step: int, c: int, step_c: int, rows: int, columns: int, depth: int, fresh: bool
) -> None:
    """C −= A Bᵀ on and below the diagonal of C (rows, columns), where B is the first rows of A (rows, depth); if `fresh`, C ← −A Bᵀ.

    Matrices stand by columns, A from the address `a` on, `step` bytes from column to column, and C likewise. Their numbers are of the kind
    of `like`. Three columns of A go into three of C at a time: nine products for six numbers read, as vector instructions.
    """
    for j in range(0, columns, 3):
        n, down = rows - j, like.itemsize * j
        here = c + j * step_c + down
        c0, c1, c2 = numbers_at(like, here), numbers_at(like, here + step_c), numbers_at(like, here + 2 * step_c)
        for m in range(3 if fresh else 0):  # column by column, which compiles to one memset each
            column = numbers_at(like, here + m * step_c)
            for i in range(n):
                column[i] = 0.0
        for m in range(0, depth, 3):
            k = a + down + m * step
            a0, a1, a2 = numbers_at(like, k), numbers_at(like, k + step), numbers_at(like, k + 2 * step)
            x0, x1, x2, y0, y1, y2, z0, z1, z2 = a0[0], a0[1], a0[2], a1[0], a1[1], a1[2], a2[0], a2[1], a2[2]
            for i in range(n):
                x, y, z = a0[i], a1[i], a2[i]
                c0[i] -= x * x0 + y * y0 + z * z0
                c1[i] -= x * x1 + y * y1 + z * z1
                c2[i] -= x * x2 + y * y2 + z * z2


@njit(cache=True, fastmath={"contract"})
def _factor_node(like: FloatArray, at: int, step: int, rows: int) -> bool:
    """Factorise the columns of a node from its diagonal on, with the products of earlier columns subtracted; return False if a pivot is not positive."""
    a, b, c = numbers_at(like, at), numbers_at(like, at + step), numbers_at(like, at + 2 * step)
    if not a[0] > 0.0:
        return False
    a[0] = np.sqrt(a[0])
    p = 1.0 / a[0]
    s, t = a[1] * p, a[2] * p
    second = b[1] - s * s
    if not second > 0.0:
        return False
    b[1] = np.sqrt(second)
    q = 1.0 / b[1]
    u = (b[2] - s * t) * q
    third = c[2] - t * t - u * u
    if not third > 0.0:
        return False
    c[2] = np.sqrt(third)
    r = 1.0 / c[2]
    a[1], a[2], b[2] = s, t, u
    for i in range(3, rows):
        x = a[i] * p
        y = (b[i] - x * s) * q
        a[i], b[i], c[i] = x, y, (c[i] - x * t - y * u) * r
    return True


@njit(cache=True)
def _add_children(
    tree: Tree, low: int, high: int, like: FloatArray, front: int, step: int, child: int, follow: IntArray, pile: int
) -> None:
    """Add the update matrices of a child and its followers to nodes low … high of the columns of a front.

    Arguments:
        like, front, step: an array of the kind of the numbers, the address of the diagonal of node `low`, and bytes from column to column.
        child, follow: the first child, and the next child after each (−1: none).
        pile: address of the update matrices.
    """
    begin, place, room, width = tree.begin, tree.place, tree.room, like.itemsize
    while child != -1:
        rows = place[begin[child] : begin[child + 1]]
        for j in range(len(rows)):
            if not low <= rows[j] < high:
                continue
            for b in range(3):
                column = numbers_at(like, front + step * (3 * (rows[j] - low) + b) - width * 3 * low)
                part = numbers_at(like, pile + width * (room[child] + (3 * j + b) * 3 * len(rows)))
                for i in range(j, len(rows)):
                    r, k = 3 * rows[i], 3 * i
                    column[r] += part[k]
                    column[r + 1] += part[k + 1]
                    column[r + 2] += part[k + 2]
        child = follow[child]


@njit(cache=True, nogil=True)
def factorize(tree: Tree, values: FloatArray, source: IntArray, L: FloatArray, stack: FloatArray) -> bool:
    """Write the factor of a matrix to L; return False where the matrix is not positive definite.

    Arguments:
        values: entries of the matrix.
        source: where the entries named by `tree.source` stand in `values`.
        stack: memory for the update matrices, of the kind of L, tree.stack entries.
    """
    width, count, pile = L.itemsize, len(tree.parent), stack.ctypes.data
    head, follow = np.full(count, -1, np.int64), np.empty(count, np.int64)  # children of each supernode as a linked list
    for s in range(count):
        own = tree.firsts[s + 1] - tree.firsts[s]
        columns, rest = 3 * own, 3 * (tree.begin[s + 1] - tree.begin[s])
        height, start = columns + rest, tree.offset[s]
        panel, update, step = L.ctypes.data + width * start, pile + width * tree.room[s], width * height
        # assemble the panel
        L[start : tree.offset[s + 1]] = 0.0
        for k in range(tree.entries[s], tree.entries[s + 1]):
            L[start + tree.target[k]] = values[source[k]]
        _add_children(tree, 0, own, L, panel, step, head[s], follow, pile)
        # factorise it
        for j in range(0, columns, 3):
            here = panel + j * (step + width)
            if j > 0:
                _subtract_product(L, panel + width * j, step, here, step, height - j, 3, j, False)
            if not _factor_node(L, here, step, height - j):
                return False
        # update matrix: −X Xᵀ with the rows X below, then the parts of the children's update matrices that concern these rows
        if rest > 0:
            _subtract_product(L, panel + width * columns, step, update, width * rest, rest, rest, columns, True)
        _add_children(tree, own, height, L, update, width * rest, head[s], follow, pile)
        if tree.parent[s] != -1:
            follow[s] = head[tree.parent[s]]
            head[tree.parent[s]] = s
    return True
