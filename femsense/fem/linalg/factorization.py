"""Factor once, solve many: the sparse symmetric systems of the body.

A positive definite stiffness is factorised by `femsense.fem.linalg.cholesky`, with one analysis per sparsity pattern; an indefinite one
by SuperLU of SciPy. If the factor does not fit into memory, conjugate gradients replace it (see `femsense.fem.linalg.iterative`).
FEMSENSE_SOLVER overrides the choice: `direct` or `iterative`; `superlu` for all matrices.
FEMSENSE_MEMORY_GB sets the memory for factors, if the figure of the machine does not apply (a container, a shared machine).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import FemsenseError, InputError
from femsense.fem.linalg.cholesky import cholesky
from femsense.fem.linalg.iterative import Level, Levels, UnsettledError, iterative, make_levels
from femsense.fem.linalg.symbolic import Analysis, analyse

SOLVERS = ("direct", "iterative", "superlu")
"""Values of FEMSENSE_SOLVER."""
ITERATIVE_FROM = 100_000
"""Number of unknowns from which on the memory of a direct factor is checked.
Up to 165 321 unknowns the direct factor was several times faster, linear and quadratic (docs/results/speed.md, `python benchmarks/body.py
iterative`), so memory is the only criterion."""
ITERATIVE_LEAST = 60
"""Number of unknowns below which the factor is always direct: the coarse space of the iterative solver needs larger bodies."""
MEMORY_SHARE = 0.6
"""Largest share of the free memory for a direct factor."""
LEAST_SHIFT = 1e-6
"""Smallest shift by which a matrix is made positive definite, relative to its typical diagonal entry."""


@dataclass(frozen=True, eq=False, slots=True)
class Pattern:
    """The sparsity pattern of a symmetric matrix in CSC (which is CSR too), with sorted indices."""

    indptr: IntArray
    """shape (f + 1,)."""
    indices: IntArray
    """shape (nnz,)."""
    analyses: list[Analysis] = field(default_factory=list)
    """The analysis for Cholesky, after the first use."""
    grid: Level | None = None
    """The nodes behind the unknowns, for the iterative solver; None: unknown."""
    levels_made: list[Levels] = field(default_factory=list)
    """The levels of the iterative solver, after the first use."""
    fits: list[bool] = field(default_factory=list)
    """Whether a direct factor fits into memory; empty until this was checked."""

    @property
    def size(self) -> int:
        return len(self.indptr) - 1

    def analysis(self) -> Analysis:
        """Return the analysis for Cholesky, made at the first call."""
        if not self.analyses:
            self.analyses.append(analyse(self.indptr, self.indices))
        return self.analyses[0]

    def levels(self) -> Levels:
        """Return the levels of the iterative solver, made at the first call."""
        if not self.levels_made:
            assert self.grid is not None
            self.levels_made.append(make_levels(self.indptr, self.indices, self.grid))
        return self.levels_made[0]


class Factorization(Protocol):
    """A factorised stiffness of the free unknowns."""

    negative: int
    """Negative pivots: 0 where the matrix is positive definite (Sylvester's law of inertia)."""
    size: int
    """Number of unknowns."""
    bytes: int
    """Rough size in memory."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        ...

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        """Return BᵀK⁻¹B, shape (k, k), for sparse columns B, shape (f, k)."""
        ...


def factorize(pattern: Pattern, values: FloatArray) -> Factorization | None:
    """Factorise a symmetric matrix; None where it is singular or not finite.

    Arguments:
        pattern: its sparsity pattern.
        values: its entries in CSC order [N/m], shape (nnz,).
    """
    if not np.isfinite(values).all():
        return None
    if iterates(pattern):
        found = _iterate(pattern, values)
        if found is not None:
            return found
        _require_memory(pattern)
    return (_cholesky(pattern, values) if _wanted() != "superlu" else None) or _factorize_any(pattern, values)


def factorize_definite(
    pattern: Pattern, values: FloatArray, *, first: float = 0.0, tries: int = 30, single: bool = False, indefinite: bool = False
) -> tuple[Factorization | None, float]:
    """Factorise matrix + shift·I with the smallest tried shift that makes it positive definite.

    Arguments:
        first: the shift to try first if the matrix is indefinite [N/m], such as a quarter of the shift at a nearby state.
        single: single precision is enough, as for a Newton step.
        indefinite: the matrix is known to be indefinite without a shift.

    Returns:
        the factor (None if no shift helped) and the shift [N/m], 0 for a positive definite matrix.
    """
    factor = None if indefinite else _definite(pattern, values, single)
    if factor is not None:
        return factor, 0.0
    least = least_shift(pattern, values)
    if not 0.0 < least < np.inf:
        return None, 0.0
    shift, diagonal = max(first, least), _diagonal(pattern)
    for _ in range(tries):
        shifted = values.copy()
        shifted[diagonal] += shift
        factor = _definite(pattern, shifted, single)
        if factor is not None:
            return factor, shift
        shift *= 4.0
    return None, shift


def least_shift(pattern: Pattern, values: FloatArray) -> float:
    """Return the smallest shift that `factorize_definite` tries [N/m]. A matrix that needs a larger shift is indefinite in exact
    arithmetic, not only by the rounding errors of single precision."""
    size = np.abs(values[_diagonal(pattern)])
    return LEAST_SHIFT * float(np.median(size)) if len(size) and np.isfinite(size).all() else np.inf


def _diagonal(pattern: Pattern) -> IntArray:
    """Return where the entries on the diagonal are, shape (f,)."""
    columns = np.repeat(np.arange(pattern.size), np.diff(pattern.indptr))
    return np.flatnonzero(pattern.indices == columns)


def _wanted() -> str:
    """Return what FEMSENSE_SOLVER says, "" where it is not set. Raises InputError for what is none of `SOLVERS`."""
    chosen = os.environ.get("FEMSENSE_SOLVER", "").lower()
    if chosen not in ("", *SOLVERS):
        raise InputError("no such solver", where="FEMSENSE_SOLVER", found=chosen, expected=" or ".join(SOLVERS))
    return chosen


def iterates(pattern: Pattern, *, asked_from: int = ITERATIVE_FROM) -> bool:
    """Return whether matrices of a pattern are solved by conjugate gradients: by choice, or because a factor does not fit into memory.

    Arguments:
        pattern: the sparsity pattern.
        asked_from: number of unknowns from which on the memory is checked.
    """
    chosen = _wanted()
    if pattern.grid is None or pattern.size < ITERATIVE_LEAST:
        return False
    if chosen:
        return chosen == "iterative"
    if pattern.size < asked_from:
        return False
    if not pattern.fits:  # decided once: the memory of an existing factor is no longer free, but the next factor reuses it
        pattern.fits.append(direct_bytes(pattern) <= MEMORY_SHARE * available_memory())
    return not pattern.fits[0]


def _iterate(pattern: Pattern, values: FloatArray) -> Factorization | None:
    """Return a stiffness solved by conjugate gradients; None if it is indefinite, or if too many iterations are needed."""
    try:
        return iterative(pattern.levels(), values)
    except UnsettledError:
        return None


def _require_memory(pattern: Pattern) -> None:
    """Raise FemsenseError if a direct factor does not fit into memory."""
    needed, free = direct_bytes(pattern), MEMORY_SHARE * available_memory()
    if needed > free:
        raise FemsenseError(
            f"conjugate gradients cannot solve this stiffness (not definite, or too ill-conditioned), and its factor "
            f"needs {needed / 1e9:.1f} GB where {free / 1e9:.1f} GB may be used: "
            "(a) smaller loads, (b) a coarser mesh, (c) more memory"
        )


def direct_bytes(pattern: Pattern) -> int:
    """Return the memory that the direct factor takes while it is made [bytes]."""
    analysis = pattern.analysis()
    return 8 * (analysis.factor_entries + analysis.tree.stack)


def available_memory() -> float:
    """Return the memory available for factorised matrices [bytes]: FEMSENSE_MEMORY_GB, else the free memory of the machine; inf if unknown.

    Raises:
        InputError: FEMSENSE_MEMORY_GB is not a number ≥ 0.
    """
    said = os.environ.get("FEMSENSE_MEMORY_GB", "")
    if said:
        return 1e9 * _gigabytes(said)
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        pass
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return float("inf")


def _gigabytes(said: str) -> float:
    try:
        size = float(said)
    except ValueError:
        size = -1.0
    if not size >= 0.0:
        raise InputError("not an amount of memory", where="FEMSENSE_MEMORY_GB", found=said, expected="gigabytes, 0 or more")
    return size


def _cholesky(pattern: Pattern, values: FloatArray, single: bool = False) -> Factorization | None:
    return cholesky(pattern.analysis(), values, single=single)


def _definite(pattern: Pattern, values: FloatArray, single: bool = False) -> Factorization | None:
    """Return the factor of a matrix that is positive definite, None where it is not."""
    if iterates(pattern):
        try:
            return iterative(pattern.levels(), values)
        except UnsettledError:
            _require_memory(pattern)
    if _wanted() != "superlu":
        return _cholesky(pattern, values, single)
    factor = factorize(pattern, values)
    return factor if factor is not None and factor.negative == 0 else None


def _factorize_any(pattern: Pattern, values: FloatArray) -> Factorization | None:
    """Factorise a matrix that may be indefinite; None where it is singular."""
    matrix = sp.csc_matrix((values, pattern.indices, pattern.indptr), shape=(pattern.size,) * 2)
    try:
        return _SuperLU(splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}))
    except RuntimeError:  # exactly singular
        return None


class _SuperLU:
    def __init__(self, lu: Any) -> None:
        kept_order = bool((lu.perm_r == np.arange(len(lu.perm_r))).all())
        pivots = lu.U.diagonal()
        self.negative = int((pivots <= 0).sum()) if kept_order else len(pivots)
        self.size = len(pivots)
        self.bytes = 12 * int(lu.nnz)
        self._lu = lu

    def solve(self, right: FloatArray) -> FloatArray:
        return np.asarray(self._lu.solve(np.ascontiguousarray(right)))

    def gram(self, columns: sp.csc_matrix) -> FloatArray:
        return np.asarray(columns.T @ self.solve(columns.toarray()))
