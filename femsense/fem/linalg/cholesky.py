"""Sparse Cholesky of stiffness matrices: multifrontal, supernodal, in single or double precision.

1. `symbolic.analyse` orders the unknowns and lays out the factor, from the sparsity pattern alone: once for all matrices of one pattern.
2. `cholesky` computes the numbers of a factor (`multifrontal`).
3. `Cholesky` solves with them (`substitution`). The compiled kernels number the unknowns in the order of elimination, and what comes in or
   goes out is reordered here: `analysis.order` lists the unknowns as they are eliminated, `analysis.rank` the place of each unknown.

A right-hand side with few entries, such as the force on a point, only visits the part of the elimination tree above its entries, which makes
`gram` (BᵀK⁻¹B without K⁻¹B) cheap. CHOLMOD takes 1.4 to 4 times as long for a factor, and 29 times or more for BᵀK⁻¹B (docs/results/speed.md).
References: Liu 1992 (multifrontal method), Ashcraft & Grimes 1989 (relaxed supernodes), Gilbert 1994 (reach of a sparse right-hand side).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from femsense.core.arrays import FloatArray
from femsense.fem.linalg.blas import blas_of
from femsense.fem.linalg.multifrontal import factorize
from femsense.fem.linalg.substitution import SIDES, add_gram, reach, solve_few, solve_many
from femsense.fem.linalg.symbolic import Analysis

FEW = 24
"""Largest number of right-hand sides that `solve_few` takes."""


def cholesky(
    analysis: Analysis, values: FloatArray, *, single: bool = False, source: npt.NDArray[np.int32] | None = None
) -> Cholesky | None:
    """Factorise a symmetric matrix of an analysed pattern; None where the matrix is not positive definite.

    Arguments:
        analysis: from `analyse`.
        values: entries in CSC order, shape (nnz,).
        single: work in single precision (errors of 1e-7 times the condition of the matrix: a preconditioner).
        source: where `values` are in another order: entry j in CSC order is values[source[j]] for each j that `analysis.tree.source` lists, in its order.
    """
    tree, kind = analysis.tree, "f" if single else "d"
    L, stack = analysis.pool.empty(kind, analysis.factor_entries), analysis.pool.empty(kind, tree.stack)
    is_definite = factorize(tree, values, tree.source if source is None else source, L, stack)
    return Cholesky(analysis, L) if is_definite else None


class Cholesky:
    """A factor K = LLᵀ of a positive definite matrix."""

    negative = 0
    """Negative eigenvalues of the matrix."""

    def __init__(self, analysis: Analysis, L: npt.NDArray[Any]) -> None:
        self.size = analysis.size
        self.bytes = L.nbytes
        self._analysis, self._L = analysis, L

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        if right.size == 0:
            return np.zeros(right.shape)
        a = self._analysis
        columns = np.asarray(right).reshape(a.size, -1)
        # for many columns BLAS is faster; for few, it would copy the panels of L first, which takes most of the time
        ordered = self._solve_few(columns) if columns.shape[1] <= FEW else self._solve_many(columns)
        return ordered[a.rank].astype(np.float64, copy=False).reshape(right.shape)

    def _solve_few(self, columns: FloatArray) -> npt.NDArray[Any]:
        a, kind, count = self._analysis, self._L.dtype, columns.shape[1]
        padded = 1 if count == 1 else -(-count // SIDES) * SIDES
        x = np.zeros((padded, a.size), kind)  # a right-hand side is a row here, so that it is contiguous
        x[:count] = columns.T[:, a.order]
        solve_few(a.tree, self._L, x, np.empty((padded, a.tallest()), kind))
        return x[:count].T

    def _solve_many(self, columns: FloatArray) -> npt.NDArray[Any]:
        a, kind = self._analysis, self._L.dtype
        x = np.ascontiguousarray(columns[a.order], dtype=kind)
        solve_many(a.tree, blas_of(kind.char), self._L, x, np.empty(a.tallest() * x.shape[1], kind))
        return x

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B = (L⁻¹B)ᵀ(L⁻¹B), shape (k, k), for sparse columns B, shape (f, k)."""
        a, k, kind = self._analysis, columns.shape[1], self._L.dtype
        rows = a.rank[columns.indices]
        indptr = columns.indptr.astype(np.int64)
        start, active = reach(a.tree.parent, a.owner, indptr, rows)
        X, W = np.zeros((a.size, k), kind), np.zeros((k, k))
        X[rows, np.repeat(np.arange(k), np.diff(indptr))] = columns.data
        add_gram(a.tree, blas_of(kind.char), start, active, self._L, X, np.empty(a.tallest(k) * k, kind), W)
        return np.asarray(W + np.tril(W, -1).T)
