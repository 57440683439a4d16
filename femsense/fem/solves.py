"""Solves with a stiffness to what is asked of them and no more: from a factor in single precision, or by conjugate gradients."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from femsense.arrays import FloatArray
from femsense.errors import FemsenseError
from femsense.fem.cholesky import Cholesky
from femsense.fem.iterative import UnsettledError, iterative
from femsense.fem.linear import Factorization, Pattern, factorize, factorize_definite

REFINED_FROM = 3000
"""Unknowns from which on a factor in single precision, and a solve more, take less time than one in double precision."""
REFINED, MOST_REFINED = 1e-3, 3
"""A correction by less than this share squares to what may be left of an error; solves at most before the factor is made in double precision."""
NEAR_ENOUGH = 1e-2
"""A factor of a state near by serves where a correction of what it makes of an even load is smaller than this share: one more solve is enough then."""
ROUGH = 1e-3
"""Share of a rough solution that may be missing, in energy. With ten times as much in the mesh's error the order of the nodes moved a fit by two percent."""
ROUGH_FROM = 9000
"""Unknowns from which on a rough solution takes conjugate gradients instead of a factor."""


class Refined:
    """A stiffness behind its factor in single precision: solutions are corrected from their true residual (Wilkinson 1963)."""

    def __init__(self, pattern: Pattern, values: FloatArray, plain: Factorization) -> None:
        self.negative, self.size, self.bytes = 0, pattern.size, plain.bytes + values.nbytes
        self.plain = plain
        self._pattern, self._values = pattern, values
        self._matrix = sp.csr_matrix((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
        self._exact: Factorization | None = None

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        if self._exact is not None:
            return self._exact.solve(right)
        answer = self.plain.solve(right)
        for _ in range(MOST_REFINED):
            more = self._correction(right, answer)
            answer = answer + more
            if (np.abs(more).max(axis=0) <= REFINED * np.abs(answer).max(axis=0)).all():
                return np.asarray(answer)
        self._exact = factorize(self._pattern, self._values)
        if self._exact is None:
            raise FemsenseError("the stiffness is singular")
        return self._exact.solve(right)

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B, shape (k, k), for sparse columns B, shape (f, k)."""
        return np.asarray(columns.T @ self.solve(columns.toarray()))

    def serves(self) -> bool:
        """Return whether the factor, which may be that of a state near by, is nearly that of this stiffness."""
        load = np.ones(self.size)
        answer = self.plain.solve(load)
        return bool(np.abs(self._correction(load, answer)).max() <= NEAR_ENOUGH * np.abs(answer).max())

    def _correction(self, right: FloatArray, answer: FloatArray) -> FloatArray:
        return self.plain.solve(right - self._matrix @ answer)


def refined(pattern: Pattern, values: FloatArray, lent: Factorization | None = None) -> Factorization | None:
    """Return a stiffness that is solved to 1e-6 or better, from a factor in single precision where that pays and is enough: from that which a state
    near by has lent, if it serves."""
    if pattern.size < REFINED_FROM or not np.isfinite(values).all():
        return factorize(pattern, values)
    if isinstance(lent, Cholesky) and lent.size == pattern.size and (near := Refined(pattern, values, lent)).serves():
        return near
    plain = factorize_definite(pattern, values, tries=0, single=True)[0]
    return Refined(pattern, values, plain) if isinstance(plain, Cholesky) else plain or factorize(pattern, values)


def prepare_roughly(pattern: Pattern) -> None:
    """Make what `roughly` needs of a pattern whatever its values: it is kept with the pattern."""
    if pattern.size < ROUGH_FROM or pattern.grid is None:
        pattern.analysis()
    else:
        pattern.levels()


def roughly(pattern: Pattern, values: FloatArray, tolerance: float = ROUGH) -> Factorization | None:
    """Return a stiffness that is solved to a tolerance, by conjugate gradients where these are faster than a factor."""
    if pattern.size < ROUGH_FROM or pattern.grid is None or not np.isfinite(values).all():
        return factorize(pattern, values)
    try:
        return iterative(pattern.levels(), values, tolerance=tolerance) or factorize(pattern, values)
    except UnsettledError:
        return factorize(pattern, values)


__all__ = ["ROUGH", "Refined", "prepare_roughly", "refined", "roughly"]
