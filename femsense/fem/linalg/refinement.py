"""Solves with a stiffness to a given tolerance: from a factor in single precision with refinement, or by conjugate gradients."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.fem.linalg.cholesky import Cholesky
from femsense.fem.linalg.factorization import Factorization, Pattern, factorize, factorize_definite
from femsense.fem.linalg.iterative import UnsettledError, iterative

REFINED_FROM = 3000
"""Number of unknowns from which on a factor in single precision and one more solve take less time than a factor in double precision."""
REFINED = 1e-6
"""Largest relative correction of a solution that is still to come when the refinement ends."""
MOST_REFINED = 4
"""Largest number of corrections; after these the factor is made in double precision."""
NEAR_ENOUGH = 3e-2
"""The factor of a nearby state is used if the first correction of its solution is below this share of the solution."""
ROUGH = 1e-3
"""Largest error of a rough solution, relative in the energy norm. With 1e-2, a fit whose discretisation error was computed in this way changed
by two percent when the nodes were numbered in another order."""
ROUGH_FROM = 9000
"""Number of unknowns from which on a rough solution takes conjugate gradients instead of a factor."""


class Refined:
    """A stiffness with its factor in single precision: solutions are corrected from their true residual (Wilkinson 1963)."""

    def __init__(self, pattern: Pattern, values: FloatArray, plain: Cholesky, *, lent: bool = False) -> None:
        self.negative, self.size, self.bytes = 0, pattern.size, plain.bytes + values.nbytes
        self.plain = plain
        self._lent = lent
        """Whether the factor was made at a nearby state, and no solution has converged with it yet."""
        self._pattern, self._values = pattern, values
        self._matrix = sp.csr_matrix((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
        self._exact: Factorization | None = None

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        if self._exact is None:
            answer = self._refined(right)
            if answer is not None:
                return answer
            self._exact = factorize(self._pattern, self._values)
            if self._exact is None:
                raise FemsenseError("the stiffness is singular")
        return self._exact.solve(right)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B, shape (k, k), for sparse columns B, shape (f, k)."""
        return np.asarray(columns.T @ self.solve(columns.toarray()))

    def _refined(self, right: FloatArray) -> FloatArray | None:
        """Return the corrected solution; None if MOST_REFINED corrections are not enough."""
        answer, first = self.plain.solve(right), 0.0
        for _ in range(MOST_REFINED):
            more = self.plain.solve(right - self._matrix @ answer)
            share = _share(more, answer)
            if self._lent and not share <= NEAR_ENOUGH:
                return self._refined(right) if self._has_own_factor() else None
            self._lent, first = False, first or share
            answer = answer + more
            if share * first <= REFINED:
                return np.asarray(answer)
        return None

    def _has_own_factor(self) -> bool:
        """Replace a lent factor by the factor of this stiffness; return whether there is such a factor in single precision."""
        own = factorize_definite(self._pattern, self._values, tries=0, single=True)[0]
        self._lent = False
        self.plain = own if isinstance(own, Cholesky) else self.plain
        return isinstance(own, Cholesky)


def _share(more: FloatArray, answer: FloatArray) -> float:
    """Return the largest ratio of the norms of correction and solution over the columns."""
    sizes = np.abs(answer).max(axis=0)
    return float((np.abs(more).max(axis=0) / np.where(sizes > 0, sizes, 1.0)).max(initial=0.0))


def refined(
    pattern: Pattern, values: FloatArray, lent: Factorization | None = None, *, pays_from: int = REFINED_FROM
) -> Factorization | None:
    """Return a stiffness that is solved to REFINED or better, with a factor in single precision if that is faster and accurate enough.

    Arguments:
        lent: factor of a nearby state, which is used as long as solutions converge with it.
        pays_from: number of unknowns from which on single precision is faster.
    """
    if pattern.size < pays_from or not np.isfinite(values).all():
        return factorize(pattern, values)
    if isinstance(lent, Cholesky) and lent.size == pattern.size:
        return Refined(pattern, values, lent, lent=True)
    plain = factorize_definite(pattern, values, tries=0, single=True)[0]
    return Refined(pattern, values, plain) if isinstance(plain, Cholesky) else plain or factorize(pattern, values)


def prepare_roughly(pattern: Pattern) -> None:
    """Make the data of a pattern that `roughly` needs for all values; the pattern keeps the data."""
    if pattern.size < ROUGH_FROM or pattern.grid is None:
        pattern.analysis()
    else:
        pattern.levels()


def roughly(
    pattern: Pattern, values: FloatArray, tolerance: float = ROUGH, *, pays_from: int = ROUGH_FROM
) -> Factorization | None:
    """Return a stiffness that is solved to a tolerance; by conjugate gradients from `pays_from` unknowns on, where these are faster than a
    factor."""
    if pattern.size < pays_from or pattern.grid is None or not np.isfinite(values).all():
        return factorize(pattern, values)
    try:
        return iterative(pattern.levels(), values, tolerance=tolerance) or factorize(pattern, values)
    except UnsettledError:
        return factorize(pattern, values)
