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
"""Unknowns from which on a factor in single precision, and a solve more, take less time than one in double precision."""
REFINED, MOST_REFINED = 1e-6, 4
"""Share of a solution that the next correction may still bring;
corrections at most before the factor is made in double precision."""
NEAR_ENOUGH = 3e-2
"""A factor of a nearby state is used if the first relative correction of its solution is smaller than this."""
ROUGH = 1e-3
"""Share of a rough solution that may be missing, in energy. With ten times as much in the mesh's error the order of the nodes
moved a fit by two percent."""
ROUGH_FROM = 9000
"""Unknowns from which on a rough solution takes conjugate gradients instead of a factor."""


class Refined:
    """A stiffness behind its factor in single precision: solutions are corrected from their true residual (Wilkinson 1963)."""

    def __init__(self, pattern: Pattern, values: FloatArray, plain: Cholesky, *, lent: bool = False) -> None:
        self.negative, self.size, self.bytes = 0, pattern.size, plain.bytes + values.nbytes
        self.plain = plain
        self._lent = lent
        """Whether the factor is that of a state near by, and has not shown yet that it serves."""
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
        """Return the corrected solution; None where corrections do not shrink as they should."""
        answer, first = self.plain.solve(right), 0.0
        for _ in range(MOST_REFINED):
            more = self.plain.solve(right - self._matrix @ answer)
            share = _share(more, answer)
            if self._lent and not share <= NEAR_ENOUGH:
                return self._refined(right) if self._factorised() else None
            self._lent, first = False, first or share
            answer = answer + more
            if share * first <= REFINED:
                return np.asarray(answer)
        return None

    def _factorised(self) -> bool:
        """Put a factor of its own in the place of the one that was lent; return whether there is one in single precision."""
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
    """Return a stiffness that is solved to REFINED or better,
    from a factor in single precision where that pays and is enough: from that which a state near by has lent, as long as it
    serves. `pays_from`: unknowns from which single precision pays."""
    if pattern.size < pays_from or not np.isfinite(values).all():
        return factorize(pattern, values)
    if isinstance(lent, Cholesky) and lent.size == pattern.size:
        return Refined(pattern, values, lent, lent=True)
    plain = factorize_definite(pattern, values, tries=0, single=True)[0]
    return Refined(pattern, values, plain) if isinstance(plain, Cholesky) else plain or factorize(pattern, values)


def prepare_roughly(pattern: Pattern) -> None:
    """Make the data of a pattern that `roughly` needs for any values; they are kept with the pattern."""
    if pattern.size < ROUGH_FROM or pattern.grid is None:
        pattern.analysis()
    else:
        pattern.levels()


def roughly(
    pattern: Pattern, values: FloatArray, tolerance: float = ROUGH, *, pays_from: int = ROUGH_FROM
) -> Factorization | None:
    """Return a stiffness that is solved to a tolerance, by conjugate gradients where these are faster than a factor:
    from `pays_from` unknowns on."""
    if pattern.size < pays_from or pattern.grid is None or not np.isfinite(values).all():
        return factorize(pattern, values)
    try:
        return iterative(pattern.levels(), values, tolerance=tolerance) or factorize(pattern, values)
    except UnsettledError:
        return factorize(pattern, values)
