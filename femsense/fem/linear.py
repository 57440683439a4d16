"""Factor once, solve many: the sparse symmetric systems of the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from femsense.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Factorization:
    """A factorised stiffness of the free unknowns."""

    lu: Any
    negative: int
    """Negative pivots: 0 where the matrix is positive definite (Sylvester's law of inertia)."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.lu.shape[0])

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        return np.asarray(self.lu.solve(np.ascontiguousarray(right)))


def factorize(matrix: sp.csc_matrix) -> Factorization | None:
    """Factorise a symmetric matrix that is ordered already; None where it is singular or not finite."""
    if not np.isfinite(matrix.data).all():
        return None
    try:
        lu = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # exactly singular
        return None
    kept_order = bool((lu.perm_r == np.arange(len(lu.perm_r))).all())
    pivots = lu.U.diagonal()
    return Factorization(lu, int((pivots <= 0).sum()) if kept_order else len(pivots))


def factorize_definite(matrix: sp.csc_matrix, *, tries: int = 30) -> tuple[Factorization | None, float]:
    """Factorise matrix + shift·I with the smallest tried shift that makes it positive definite.

    Returns:
        the factorisation (None where nothing helped) and the shift [N/m], 0 where none was needed.
    """
    factor = factorize(matrix)
    if factor is not None and factor.negative == 0:
        return factor, 0.0
    diagonal = np.abs(matrix.diagonal())
    if not np.isfinite(diagonal).all() or diagonal.max(initial=0.0) == 0.0:
        return None, 0.0
    shift = 1e-6 * float(np.median(diagonal))
    eye = sp.eye_array(matrix.shape[0], format="csc")
    for _ in range(tries):
        factor = factorize(sp.csc_matrix(matrix + shift * eye))
        if factor is not None and factor.negative == 0:
            return factor, shift
        shift *= 4.0
    return None, shift
