"""Normal equations of one recording in the shared parameters; they add up over recordings.

Near shared parameters β, with the parameters aᵢ of recording i alone (camera poses, initial inputs) at their optimum, its whitened residual is
rᵢ + Aᵢ δaᵢ + Bᵢ δβ. With Pᵢ the projector on the orthogonal complement of Aᵢ, all recordings together have

    χ²(β + δβ) = Σᵢ rᵢᵀPᵢrᵢ + 2 δβᵀ g + δβᵀ N δβ,    N = Σᵢ BᵢᵀPᵢBᵢ,    g = Σᵢ BᵢᵀPᵢrᵢ,

so that a recording can be released once its N and g are known: block elimination, as in bundle adjustment (Triggs et al. 2000), of a separable
problem (Golub & Pereyra 1973). The columns of an effect that is not in the model yet are reduced in the same way; its score needs its own block and
that with β.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray

ROUNDING = 1e-12
"""Directions with less than this share of the largest curvature are rounding errors."""


@dataclass(frozen=True, eq=False, slots=True)
class Block:
    """Normal equations of the columns C of a candidate, with P and r as in the module docstring."""

    own: FloatArray
    """CᵀPC, shape (q, q)."""
    shared: FloatArray
    """BᵀPC, shape (p, q)."""
    slope: FloatArray
    """CᵀPr, shape (q,)."""

    def __add__(self, other: Block) -> Block:
        return Block(self.own + other.own, self.shared + other.shared, self.slope + other.slope)


@dataclass(frozen=True, eq=False, slots=True)
class Squares:
    """Sums of squared marker residuals and numbers of rows."""

    fitted: float = 0.0
    """[m²]"""
    fitted_count: int = 0
    held: float = 0.0
    """On held-out sweeps [m²]."""
    held_count: int = 0

    def __add__(self, other: Squares) -> Squares:
        return Squares(
            self.fitted + other.fitted,
            self.fitted_count + other.fitted_count,
            self.held + other.held,
            self.held_count + other.held_count,
        )

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square 3-D residuals, fitted and held out [m]."""
        return float(np.sqrt(self.fitted / max(self.fitted_count, 1))), float(np.sqrt(self.held / max(self.held_count, 1)))


@dataclass(frozen=True, eq=False, slots=True)
class NormalEquations:
    """Normal equations of one recording, or the sum of several."""

    normal: FloatArray
    """N, shape (p, p)."""
    slope: FloatArray
    """g, shape (p,)."""
    chi2: float
    """Σ rᵀPr."""
    observations: float
    """Number of independent observations, as BIC counts them."""
    before: Squares
    """Residuals of the declared model, camera calibrated."""
    after: Squares
    """Of the model at β."""
    candidates: Mapping[str, Block]
    """By key."""
    count: int = 1
    """Number of recordings."""

    def __add__(self, other: NormalEquations) -> NormalEquations:
        both = self.candidates.keys() & other.candidates.keys()  # a candidate that cannot act in a recording has no columns there
        return NormalEquations(
            self.normal + other.normal,
            self.slope + other.slope,
            self.chi2 + other.chi2,
            self.observations + other.observations,
            self.before + other.before,
            self.after + other.after,
            {
                key: self.candidates[key] + other.candidates[key] if key in both else {**self.candidates, **other.candidates}[key]
                for key in dict.fromkeys((*self.candidates, *other.candidates))
            },
            self.count + other.count,
        )

    def rows(self, coordinates: FloatArray) -> Rows:
        """Return rows whose sum of squares equals χ² near β = `coordinates`, shape (p,), up to a constant."""
        size, turn = np.linalg.eigh(self.normal)
        seen = size > ROUNDING * max(float(size.max(initial=0.0)), 1e-300)
        root = np.sqrt(size[seen])
        matrix = root[:, None] * turn[:, seen].T
        return Rows(matrix, turn[:, seen].T @ self.slope / root - matrix @ coordinates)

    def beside(self, key: str, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return R and s such that χ² = ‖R x + s‖² + const for a candidate with coordinates x, shape (q,), the shared parameters refitted.

        Arguments:
            key: key of the candidate; its coordinates count from its null.
            prior: 1/σ² of the shared parameters, shape (p,); they are at their optimum.
        """
        block = self.candidates[key]
        inner = np.linalg.pinv(self.normal + np.diag(prior), rcond=ROUNDING, hermitian=True)
        size, turn = np.linalg.eigh(block.own - block.shared.T @ inner @ block.shared)
        seen = size > ROUNDING * max(float(np.abs(block.own).max(initial=0.0)), 1e-300)
        root = np.sqrt(size[seen])
        return root[:, None] * turn[:, seen].T, turn[:, seen].T @ block.slope / root


@dataclass(frozen=True, eq=False, slots=True)
class Rows:
    """Rows M β + d of a least-squares problem that represent other recordings."""

    matrix: FloatArray
    """Shape (m, p)."""
    offset: FloatArray
    """Shape (m,)."""

    def at(self, coordinates: FloatArray) -> FloatArray:
        """Return the residual at coordinates, shape (≥ p,); the rows do not depend on those beyond p."""
        return np.asarray(self.matrix @ coordinates[: self.matrix.shape[1]] + self.offset)

    def keeping(self, keep: BoolArray, still: FloatArray) -> Rows:
        """Return the rows in some of the coordinates, `keep` (p,), with the others fixed at `still`, shape (p,)."""
        return Rows(self.matrix[:, keep], self.offset + self.matrix[:, ~keep] @ still[: len(keep)][~keep])
