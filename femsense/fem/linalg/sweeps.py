# mypy: allow-untyped-decorators
"""Products, Gauss–Seidel sweeps and coarse matrices of the iterative solver, compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.kernels import njit

SingleArray = npt.NDArray[np.float32]
ShortArray = npt.NDArray[np.int32]


@njit(cache=True)
def grouped(rows: ShortArray, columns: ShortArray) -> IntArray:
    """Return aggregates: nodes whose neighbours are all unassigned, with these; remaining nodes join a neighbour's aggregate."""
    count = len(rows) - 1
    group = np.full(count, -1, np.int64)
    number = 0
    for i in range(count):
        near = columns[rows[i] : rows[i + 1]]
        if (group[near] == -1).all() and len(near) > 3:
            group[near] = number
            number += 1
    joined = group.copy()
    for i in range(count):
        if group[i] != -1:
            continue
        for j in columns[rows[i] : rows[i + 1]]:
            if group[j] != -1:
                joined[i] = group[j]
    joined[joined == -1] = 0  # far from the rest: any aggregate will do
    return joined


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"}, inline="always")
def _gathered(columns: ShortArray, first: int, last: int, x: Any, near: Any) -> None:
    """Copy the entries of x at some columns to `near`, so that a row multiplies adjacent numbers."""
    for k in range(last - first):
        j = 3 * np.int64(columns[first + k])
        near[3 * k], near[3 * k + 1], near[3 * k + 2] = x[j], x[j + 1], x[j + 2]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def multiply(rows: ShortArray, columns: ShortArray, values: FloatArray, x: FloatArray, y: FloatArray) -> None:
    """Write y = K x."""
    near = np.empty(3 * np.diff(rows).max(), x.dtype)
    for i in range(len(rows) - 1):
        first, n = np.int64(rows[i]), 3 * np.int64(rows[i + 1] - rows[i])
        _gathered(columns, first, np.int64(rows[i + 1]), x, near)
        at = 9 * first
        v0, v1, v2 = values[at : at + n], values[at + n : at + 2 * n], values[at + 2 * n : at + 3 * n]
        s0, s1, s2 = 0.0, 0.0, 0.0
        for q in range(n):
            s0 += v0[q] * near[q]
            s1 += v1[q] * near[q]
            s2 += v2[q] * near[q]
        y[3 * i], y[3 * i + 1], y[3 * i + 2] = s0, s1, s2


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def sweep_forward(
    rows: ShortArray,
    columns: ShortArray,
    diagonal: ShortArray,
    values: SingleArray,
    inverse: SingleArray,
    r: SingleArray,
    x: SingleArray,
    left: SingleArray,
) -> None:
    """Write x after a forward sweep from zero for K x = r, and the remaining residual −U x, with U the part above the diagonal."""
    near = np.empty(3 * np.diff(rows).max(), np.float32)
    for upper in range(2):
        for i in range(len(rows) - 1):
            row, n = np.int64(rows[i]), 3 * np.int64(rows[i + 1] - rows[i])
            first, last = (row, np.int64(diagonal[i])) if upper == 0 else (np.int64(diagonal[i]) + 1, np.int64(rows[i + 1]))
            _gathered(columns, first, last, x, near)
            at, count = 9 * row + 3 * (first - row), 3 * (last - first)
            v0, v1, v2 = values[at : at + count], values[at + n : at + n + count], values[at + 2 * n : at + 2 * n + count]
            s0, s1, s2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for q in range(count):
                s0 += v0[q] * near[q]
                s1 += v1[q] * near[q]
                s2 += v2[q] * near[q]
            if upper == 0:
                s0, s1, s2 = r[3 * i] - s0, r[3 * i + 1] - s1, r[3 * i + 2] - s2
                for a in range(3):
                    x[3 * i + a] = inverse[i, 3 * a] * s0 + inverse[i, 3 * a + 1] * s1 + inverse[i, 3 * a + 2] * s2
            else:
                left[3 * i], left[3 * i + 1], left[3 * i + 2] = -s0, -s1, -s2


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def sweep_backward(
    rows: ShortArray, columns: ShortArray, values: SingleArray, inverse: SingleArray, r: SingleArray, x: SingleArray
) -> None:
    """Improve x for K x = r by a backward sweep."""
    near = np.empty(3 * np.diff(rows).max(), np.float32)
    for i in range(len(rows) - 2, -1, -1):
        first, n = np.int64(rows[i]), 3 * np.int64(rows[i + 1] - rows[i])
        _gathered(columns, first, np.int64(rows[i + 1]), x, near)
        at = 9 * first
        v0, v1, v2 = values[at : at + n], values[at + n : at + 2 * n], values[at + 2 * n : at + 3 * n]
        s0, s1, s2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for q in range(n):
            s0 += v0[q] * near[q]
            s1 += v1[q] * near[q]
            s2 += v2[q] * near[q]
        s0, s1, s2 = r[3 * i] - s0, r[3 * i + 1] - s1, r[3 * i + 2] - s2
        for a in range(3):
            x[3 * i + a] += inverse[i, 3 * a] * s0 + inverse[i, 3 * a + 1] * s1 + inverse[i, 3 * a + 2] * s2


@njit(cache=True)
def diagonal_inverses(rows: ShortArray, diagonal: ShortArray, values: FloatArray, inverse: SingleArray) -> bool:
    """Write the inverses of the diagonal blocks; False where one is not positive definite."""
    for i in range(len(rows) - 1):
        first, m = rows[i], rows[i + 1] - rows[i]
        p = 9 * np.int64(first) + 3 * np.int64(diagonal[i] - first)
        q = p + 3 * np.int64(m)
        s = q + 3 * np.int64(m)
        a, b, c, d, e, f = values[p], values[p + 1], values[p + 2], values[q + 1], values[q + 2], values[s + 2]
        minor, det = a * d - b * b, a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        if not (a > 0 and minor > 0 and det > 0):
            return False
        inverse[i, 0], inverse[i, 4], inverse[i, 8] = (d * f - e * e) / det, (a * f - c * c) / det, minor / det
        inverse[i, 1] = inverse[i, 3] = (c * e - b * f) / det
        inverse[i, 2] = inverse[i, 6] = (b * e - c * d) / det
        inverse[i, 5] = inverse[i, 7] = (b * c - a * e) / det
    return True


@njit(cache=True, nogil=True)
def galerkin(
    rows: ShortArray,
    columns: ShortArray,
    values: FloatArray,
    parent_rows: ShortArray,
    parents: ShortArray,
    child_rows: ShortArray,
    children: ShortArray,
    entry: IntArray,
    weights: FloatArray,
    coarse_rows: IntArray,
    coarse_columns: IntArray,
) -> FloatArray:
    """Return the values of PᵀKP, block rows of u unknowns, in the order of the expanded coarse pattern."""
    u, count = weights.shape[2], len(coarse_rows) - 1
    result = np.zeros(u * u * coarse_rows[count])
    where = np.zeros(count, np.int64)
    part = np.empty((u, 3))
    for c in range(count):
        width = coarse_rows[c + 1] - coarse_rows[c]
        line = result[u * u * coarse_rows[c] : u * u * coarse_rows[c + 1]]
        for k in range(width):
            where[coarse_columns[coarse_rows[c] + k]] = k
        for t in range(child_rows[c], child_rows[c + 1]):
            i, w = children[t], weights[entry[t]]
            first, m = rows[i], rows[i + 1] - rows[i]
            for k in range(m):
                at = 9 * np.int64(first) + 3 * k
                j = columns[first + k]
                for a in range(u):
                    for b in range(3):
                        part[a, b] = (
                            w[0, a] * values[at + b] + w[1, a] * values[at + 3 * m + b] + w[2, a] * values[at + 6 * m + b]
                        )
                for s in range(parent_rows[j], parent_rows[j + 1]):
                    slot, v = u * where[parents[s]], weights[s]
                    for a in range(u):
                        for b in range(u):
                            line[u * width * a + slot + b] += part[a, 0] * v[0, b] + part[a, 1] * v[1, b] + part[a, 2] * v[2, b]
    return result


@njit(cache=True, nogil=True)
def galerkin_of_corners(
    rows: ShortArray,
    columns: ShortArray,
    values: FloatArray,
    parent_rows: ShortArray,
    parents: ShortArray,
    share: FloatArray,
    coarse_rows: IntArray,
    coarse_columns: IntArray,
) -> FloatArray:
    """Return PᵀKP as `galerkin` does, for weights that are multiples of the unit matrix (`share`): each row of K P is computed once."""
    count, most = len(coarse_rows) - 1, 2 * np.diff(rows).max()
    result = np.zeros(9 * coarse_rows[count])
    number = np.full(count, -1, np.int64)
    met, sums = np.empty(most, np.int64), np.empty((most, 9))
    for i in range(len(rows) - 1):
        first, m, seen = np.int64(rows[i]), np.int64(rows[i + 1] - rows[i]), 0
        for k in range(m):
            at, j = 9 * first + 3 * k, columns[first + k]
            for s in range(parent_rows[j], parent_rows[j + 1]):
                c, w = parents[s], share[s]
                if number[c] < 0:
                    number[c], met[seen] = seen, c
                    sums[seen] = 0.0
                    seen += 1
                line = sums[number[c]]
                for a in range(3):
                    for b in range(3):
                        line[3 * a + b] += w * values[at + 3 * m * a + b]
        for t in range(parent_rows[i], parent_rows[i + 1]):
            c, w = parents[t], share[t]
            begin, width = coarse_rows[c], coarse_rows[c + 1] - coarse_rows[c]
            for k in range(width):
                n = number[coarse_columns[begin + k]]
                if n >= 0:
                    for a in range(3):
                        for b in range(3):
                            result[9 * begin + 3 * width * a + 3 * k + b] += w * sums[n, 3 * a + b]
        for n in range(seen):
            number[met[n]] = -1
    return result
