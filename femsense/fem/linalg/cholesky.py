# mypy: allow-untyped-decorators
"""Sparse Cholesky of stiffness matrices: multifrontal, supernodal, in single or double precision.

The analysis (elimination tree, supernodes, positions of all entries) depends on the sparsity pattern only and is reused. Dense work uses
the BLAS of SciPy. Right-hand sides with few entries, such as those of points and cables, only visit the part of the tree above them,
which makes `gram` (B'K⁻¹B without K⁻¹B) cheap. References: Liu 1992 (multifrontal method),
Ashcraft & Grimes 1989 (relaxed supernodes), Gilbert 1994 (the reach of a sparse right-hand side).
"""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from numba.extending import get_cython_function_address

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.parallel import one_blas_thread
from femsense.fem.linalg.multifrontal import factorise
from femsense.fem.linalg.simd_columns import SIDES
from femsense.fem.linalg.substitution import add_gram, reach, solve_many, solve_one, solve_sides
from femsense.fem.linalg.symbolic import Analysis

FEW = 4
"""Right-hand sides that are solved one by one where the matrix has no blocks; more go through BLAS together."""
BESIDE = 40
"""Largest number of right-hand sides that are solved in groups of SIDES; for more, BLAS is faster. For 10 to 16 right-hand sides of a bar
it took twice as long in a trial."""


# --- numbers -------------------------------------------------------------------------------------------------------------


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
            solve_sides(a.unit, a.firsts, a.begin, a.below, a.offset, self._L, x.reshape(groups, -1), half)
            ordered = np.concatenate(list(x), axis=1)[:, :count]
        elif count < FEW:
            x = np.ascontiguousarray(columns[a.order].T, dtype=kind)
            work = np.empty(a.size, kind)
            for one in x:
                solve_one(a.unit, a.firsts, a.begin, a.below, a.offset, self._L, one, work)
            ordered = x.T
        else:
            ordered = np.ascontiguousarray(columns[a.order], dtype=kind)
            work = np.empty(a.unit * int(np.diff(a.begin).max(initial=0)) * ordered.shape[1], kind)
            solve_many(
                a.unit, a.firsts, a.begin, a.below, a.offset, _BLAS[kind.char], self._L, ordered, work, *_constants(kind.char)
            )
        return ordered[a.rank].astype(np.float64, copy=False).reshape(right.shape)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B = (L⁻¹B)ᵀ(L⁻¹B), shape (k, k), for sparse columns B, shape (f, k)."""
        a, k, kind = self._analysis, columns.shape[1], self._L.dtype
        rows = a.rank[columns.indices]
        indptr = columns.indptr.astype(np.int64)
        start, active = reach(a.parent, a.owner, indptr, rows)
        X = a.columns.pop((kind.char, k), None)
        X = np.zeros((a.size, k), kind) if X is None else X
        X[rows, np.repeat(np.arange(k), np.diff(indptr))] = columns.data
        W = np.zeros((k, k))
        tallest = int((np.diff(a.firsts) + np.maximum(np.diff(a.begin), k)).max(initial=0))
        work = np.empty(a.unit * tallest * k, kind)
        add_gram(
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
        definite = factorise(
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
    """Return the constants that BLAS reads by address: letters L N T R, memory for integers, and −1, 1, 0."""
    return np.frombuffer(b"LNTR", np.uint8), np.zeros(4, np.int32), np.array([-1.0, 1.0, 0.0], kind)


_BLAS = {"d": _addresses("d"), "f": _addresses("s")}
