# mypy: allow-untyped-decorators
"""Conjugate gradients with a two-level preconditioner: stiffnesses whose direct factor costs too much time or memory.

One step of the preconditioner is a forward sweep of block Gauss–Seidel, a correction from a coarse space whose matrix PᵀKP is
factorised (see `femsense.fem.linalg.cholesky`), and a backward sweep; it works in single precision.
The coarse space of a quadratic mesh are the linear functions on the same tetrahedra (p-multigrid):
a node in the middle of an edge moves as the mean of its ends. That of a linear mesh are the rigid motions of aggregates, a node
and its neighbours. References: Saad 2003 (sections 9.2 and 13), Vaněk, Mandel & Brezina 1996 (aggregates with rigid motions),
Paige, Parlett & van der Vorst 1995 (Lanczos and inertia).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import FemsenseError
from femsense.fem.linalg.cholesky import Cholesky, cholesky
from femsense.fem.linalg.ordering import fill_reducing_order
from femsense.fem.linalg.sweeps import (
    ShortArray,
    SingleArray,
    diagonal_inverses,
    galerkin,
    galerkin_of_corners,
    grouped,
    multiply,
    sweep_backward,
    sweep_forward,
)
from femsense.fem.linalg.symbolic import Analysis, analyse

TOLERANCE = 1e-10
"""Relative tolerance of the preconditioned residual √(rᵀM⁻¹r)."""
PROBE = 1e-5
"""Relative tolerance for the random right-hand side by which a matrix is tested for being positive definite."""
MOST = 300
"""Largest number of iterations for a right-hand side; a matrix that needs more goes to the direct solver."""
RESTARTS = 4
"""Largest number of restarts from the true residual, after rounding errors have stopped the iteration."""


class UnsettledError(Exception):
    """Conjugate gradients did not converge in MOST iterations."""


@dataclass(frozen=True, eq=False, slots=True)
class Level:
    """Data of the free nodes for the coarse space, in the order of the matrix."""

    points: FloatArray
    """Where they are at rest [m], shape (p, 3)."""
    ends: IntArray
    """Ends of the edge that a node is in the middle of (−1: fixed); twice itself for a corner, shape (p, 2)."""

    @property
    def is_quadratic(self) -> bool:
        return bool((self.ends[:, 0] != np.arange(len(self.ends))).any())


@dataclass(frozen=True, eq=False, slots=True)
class Levels:
    """Data common to the preconditioners of all matrices of one pattern."""

    rows: ShortArray
    """Nodes coupled with each node, in CSR: indptr, shape (p + 1,)."""
    columns: ShortArray
    """Indices, rising in each row, shape (blocks,)."""
    diagonal: ShortArray
    """Where the block on the diagonal of each row is, shape (p,)."""
    prolong: sp.csr_matrix
    """P in single precision, shape (f, c)."""
    restrict: sp.csr_matrix
    """Pᵀ."""
    parents: sp.csr_matrix
    """Coarse nodes that each node follows, and entry numbers as data, shape (p, q)."""
    children: sp.csr_matrix
    """Its transpose."""
    weights: FloatArray
    """Displacement of a node per displacement of a coarse node, for each entry of `parents`, shape (entries, 3, u)."""
    coarse_rows: IntArray
    """Coarse nodes coupled with each coarse node, in CSR, shape (q + 1,)."""
    coarse_columns: IntArray
    analysis: Analysis
    """Of the coarse matrix."""


def make_levels(indptr: IntArray, indices: IntArray, grid: Level) -> Levels:
    """Return the two levels of a pattern of 3 × 3 blocks (CSC, sorted) on the nodes of a grid."""
    p = len(grid.points)
    counts = np.diff(indptr)[::3] // 3
    rows = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    columns = (indices[(np.repeat(indptr[:-1:3] - 3 * rows[:-1], counts) + 3 * np.arange(rows[-1]))] // 3).astype(np.int32)
    graph = sp.csr_matrix((np.ones(len(columns), np.float32), columns, rows), shape=(p, p))
    follows, weights = _corners(grid) if grid.is_quadratic else _aggregates(grid, rows, columns)
    coarse = sp.csr_matrix(abs(follows).T @ graph @ abs(follows))
    first, second = (np.asarray(index, np.int64) for index in coarse.nonzero())
    order = fill_reducing_order(first, second, np.ones(coarse.shape[0], dtype=bool))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    follows.indices = place[follows.indices].astype(follows.indices.dtype)
    coarse = sp.csr_matrix(coarse[order][:, order])
    coarse.sort_indices()
    u = weights.shape[2]
    numbers = sp.csr_matrix((np.arange(len(weights)), follows.indices, follows.indptr), shape=follows.shape)
    prolong = sp.bsr_matrix((weights.astype(np.float32), follows.indices, follows.indptr), shape=(3 * p, u * len(order))).tocsr()
    prolong.eliminate_zeros()
    coarse_rows, coarse_columns = np.asarray(coarse.indptr, np.int64), np.asarray(coarse.indices, np.int64)
    children = numbers.T.tocsr()
    diagonal = np.flatnonzero(columns == np.repeat(np.arange(p), counts)).astype(np.int32)
    return Levels(
        rows,
        columns,
        diagonal,
        prolong,
        prolong.T.tocsr(),
        numbers,
        children,
        weights,
        coarse_rows,
        coarse_columns,
        analyse(*_expanded(coarse_rows, coarse_columns, u)),
    )


def _corners(grid: Level) -> tuple[sp.csr_matrix, FloatArray]:
    """Return which corners each node follows and how: as itself, or half with each end of its edge that is free."""
    p = len(grid.points)
    corner = grid.ends[:, 0] == np.arange(p)
    number = np.where(corner, np.cumsum(corner) - 1, -1)
    own = np.flatnonzero(corner)
    middle, end = np.repeat(np.flatnonzero(~corner), 2), grid.ends[~corner].ravel()
    middle, end = middle[end >= 0], end[end >= 0]
    nodes, to = np.concatenate([own, middle]), np.concatenate([number[own], number[end]])
    share = np.where(np.arange(len(nodes)) < len(own), 1.0, 0.5)
    follows = sp.csr_matrix((share, (nodes, to)), shape=(p, len(own)))
    return follows, follows.data[:, None, None] * np.eye(3)


def _aggregates(grid: Level, rows: ShortArray, columns: ShortArray) -> tuple[sp.csr_matrix, FloatArray]:
    """Return the aggregate that each node belongs to, and its move under the six rigid motions of the aggregate."""
    group = grouped(rows, columns)
    count = int(group.max()) + 1
    size = np.bincount(group, minlength=count)
    centre = np.column_stack([np.bincount(group, grid.points[:, i], count) for i in range(3)]) / size[:, None]
    arm = grid.points - centre[group]
    reach = np.sqrt(np.bincount(group, (arm**2).sum(axis=1), count) / size)
    arm = arm / np.where(reach > 0, reach, 1.0)[group][:, None]
    weights = np.zeros((len(group), 3, 6))
    weights[:, :, :3] = np.eye(3)
    x, y, z = arm.T
    weights[:, 0, 4], weights[:, 0, 5] = z, -y
    weights[:, 1, 3], weights[:, 1, 5] = -z, x
    weights[:, 2, 3], weights[:, 2, 4] = y, -x
    follows = sp.csr_matrix((np.ones(len(group)), group, np.arange(len(group) + 1)), shape=(len(group), count))
    return follows, weights


def _expanded(rows: IntArray, columns: IntArray, unit: int) -> tuple[IntArray, IntArray]:
    """Return the pattern of unknowns of a pattern of nodes with `unit` unknowns each."""
    blocks = sp.csr_matrix((np.ones(len(columns), np.int8), columns, rows))
    full = sp.csr_matrix(sp.kron(blocks, np.ones((unit, unit), np.int8), format="csr"))
    full.sort_indices()
    return np.asarray(full.indptr, np.int64), np.asarray(full.indices, np.int64)


# --- kernels: a matrix of 3 × 3 blocks lies row by row, so that entry (a, b) of block k of node i is at 9 rows[i] + 3 (a m + k) + b
# with m blocks in the row ---


class Iterative:
    """A positive definite stiffness that is solved by conjugate gradients, behind the face of a factor."""

    def __init__(
        self, levels: Levels, values: FloatArray, inverse: SingleArray, coarse: Cholesky, tolerance: float = TOLERANCE
    ) -> None:
        self.negative = 0
        self.size = len(levels.rows) * 3 - 3
        self.bytes = values.nbytes + values.nbytes // 2 + inverse.nbytes + coarse.bytes
        self.iterations = 0
        """Of the last right-hand side."""
        self._levels, self._values, self._inverse, self._coarse = levels, values, inverse, coarse
        self._tolerance = tolerance
        self._single = values.astype(np.float32)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k). Raises FemsenseError where the iteration does not converge."""
        b = np.asarray(right, dtype=np.float64)
        columns = b.reshape(self.size, -1).T
        return np.array([self._solve_one(column) for column in columns]).reshape(-1, self.size).T.reshape(b.shape)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B, shape (k, k), for sparse columns B, shape (f, k)."""
        return np.asarray(columns.T @ self.solve(columns.toarray()))

    def is_definite(self) -> bool:
        """Return whether conjugate gradients on a random right-hand side meet positive curvature only.

        The curvatures are the pivots of Lanczos' matrix: one of them is negative as soon as that matrix has a negative eigenvalue. Conjugate
        gradients do not converge before they have met every eigenvector that is part of the right-hand side. Raises UnsettledError.
        """
        right = self._levels.prolong @ np.random.default_rng(1).standard_normal(self._levels.prolong.shape[1]).astype(np.float32)
        b = np.random.default_rng(0).standard_normal(self.size) + right
        answer, share = self._conjugate(b, PROBE, MOST)
        if answer is not None and share > PROBE:
            raise UnsettledError
        return answer is not None

    def _solve_one(self, b: FloatArray) -> FloatArray:
        x, left, wanted, total = np.zeros(self.size), b, self._tolerance, 0
        product = np.empty(self.size)
        for _ in range(RESTARTS):
            part, share = self._conjugate(left, wanted, MOST)
            total += self.iterations
            if part is None:
                raise FemsenseError("the stiffness is not positive definite: FEMSENSE_SOLVER=direct gives details")
            x += part
            if share <= wanted:
                self.iterations = total
                return x
            wanted = wanted / share
            multiply(self._levels.rows, self._levels.columns, self._values, x, product)
            left = b - product
        raise FemsenseError(f"conjugate gradients did not converge in {RESTARTS * MOST} iterations: FEMSENSE_SOLVER=direct")

    def _conjugate(self, b: FloatArray, tolerance: float, most: int) -> tuple[FloatArray | None, float]:
        """Return the solution and its relative residual √(rᵀM⁻¹r); None for negative curvature."""
        levels = self._levels
        x, r, q = np.zeros(self.size), b.copy(), np.empty(self.size)
        z = self._precondition(r)
        p, rz = z, float(r @ z)
        first, self.iterations = rz, 0
        while self.iterations < most and rz > tolerance**2 * first:
            multiply(levels.rows, levels.columns, self._values, p, q)
            curvature = float(p @ q)
            if not curvature > 0.0:
                return None, 1.0
            step = rz / curvature
            x += step * p
            r -= step * q
            z = self._precondition(r)
            last, rz = rz, float(r @ z)
            p = z + (rz / last) * p
            self.iterations += 1
        return x, float(np.sqrt(max(rz, 0.0) / first)) if first > 0.0 else 0.0

    def _precondition(self, right: FloatArray) -> FloatArray:
        levels = self._levels
        size = float(np.abs(right).max(initial=0.0)) or 1.0  # single precision has a small range
        r = (right / size).astype(np.float32)
        x, left = np.empty_like(r), np.empty_like(r)
        sweep_forward(levels.rows, levels.columns, levels.diagonal, self._single, self._inverse, r, x, left)
        x += levels.prolong @ self._coarse.solve(levels.restrict @ left).astype(np.float32)
        sweep_backward(levels.rows, levels.columns, self._single, self._inverse, r, x)
        return x.astype(np.float64) * size


def iterative(levels: Levels, values: FloatArray, *, tolerance: float = TOLERANCE) -> Iterative | None:
    """Prepare conjugate gradients for a symmetric matrix; None if the matrix is not positive definite.

    Arguments:
        levels: coarse levels of the matrix pattern, result of `make_levels`.
        values: its entries in CSC order, shape (nnz,); kept, not copied.
        tolerance: share of √(rᵀM⁻¹r) that a solution may leave. With more than that of the test for being definite, the matrix is
            taken to be so until curvature says otherwise.

    Raises:
        UnsettledError: conjugate gradients take too long.
    """
    inverse = np.empty((len(levels.rows) - 1, 9), np.float32)
    if not diagonal_inverses(levels.rows, levels.diagonal, values, inverse):
        return None
    coarse = coarse_factor(levels, values)
    if coarse is None:
        return None
    made = Iterative(levels, values, inverse, coarse, tolerance)
    return made if tolerance > PROBE or made.is_definite() else None


def coarse_factor(levels: Levels, values: FloatArray) -> Cholesky | None:
    """Return the factor of PᵀKP; None if PᵀKP, and therefore K, is not positive definite."""
    fine: tuple[Any, ...] = (levels.rows, levels.columns, values, levels.parents.indptr, levels.parents.indices)
    coarse = (levels.coarse_rows, levels.coarse_columns)
    if levels.weights.shape[2] == 3:
        small = galerkin_of_corners(*fine, levels.weights[:, 0, 0].copy(), *coarse)
    else:
        of = levels.children
        small = galerkin(*fine, of.indptr, of.indices, of.data, levels.weights, *coarse)
    return cholesky(levels.analysis, small, single=True) or cholesky(levels.analysis, small)
