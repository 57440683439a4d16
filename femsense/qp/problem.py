"""A quadratic problem, and the certificate of an answer.

    minimise   ½ xᵀ P x + qᵀ x    subject to   G x ≤ h,   lb ≤ x ≤ ub

Signs of the multipliers are those of qpsolvers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError


@dataclass(frozen=True, eq=False, slots=True)
class Problem:
    """A quadratic problem in n unknowns; parts that are absent have no rows, bounds that are absent are ±inf.

    Raises InputError.
    """

    P: FloatArray
    """Symmetric, positive semidefinite, shape [n, n]."""
    q: FloatArray
    """Shape [n]."""
    G: FloatArray | None = None
    """Inequalities G x ≤ h, shape [m, n]."""
    h: FloatArray | None = None
    """Shape [m]."""
    lb: FloatArray | None = None
    """Lower bounds, shape [n]; −inf: none."""
    ub: FloatArray | None = None
    """Upper bounds, shape [n]; +inf: none."""

    def __post_init__(self) -> None:
        q = _vector(self.q, "q")
        n = len(q)
        P = _matrix(self.P, n, "P")
        if len(P) != n:
            raise InputError("P must be square", where="P", found=P.shape, expected=(n, n))
        asymmetry = float(np.abs(P - P.T).max(initial=0.0))
        if asymmetry > 1e-9 * max(float(np.abs(P).max(initial=0.0)), 1e-300):
            raise InputError("P must be symmetric", where="P", found=f"|P − Pᵀ| up to {asymmetry:.3g}", expected="P = Pᵀ")
        G, h = _rows(self.G, self.h, n)
        lb, ub = _bounds(self.lb, -np.inf, n, "lb"), _bounds(self.ub, np.inf, n, "ub")
        for name, value in zip(["P", "q", "G", "h", "lb", "ub"], (0.5 * (P + P.T), q, G, h, lb, ub)):
            object.__setattr__(self, name, freeze(value))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.q)

    def parts(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return P, q, G, h, lb, ub, all of them arrays."""
        G, h, lb, ub = self.G, self.h, self.lb, self.ub
        assert G is not None and h is not None and lb is not None and ub is not None
        return self.P, self.q, G, h, lb, ub


@dataclass(frozen=True, eq=False, slots=True)
class Multipliers:
    """Lagrange multipliers of a problem."""

    z: FloatArray
    """Multipliers of G x ≤ h, ≥ 0, shape [m]."""
    z_box: FloatArray
    """Multipliers of the bounds, shape [n]: ≤ 0 at an active lower bound, ≥ 0 at an active upper bound."""


@dataclass(frozen=True, eq=False, slots=True)
class Residuals:
    """Residuals of the conditions of Karush, Kuhn and Tucker; inf without an answer."""

    primal: float
    """Largest violation of a constraint [units of x and of the rows]."""
    dual: float
    """Largest entry of P x + q + Gᵀ z + z_box, or a multiplier of the wrong sign [objective / unit of x]."""
    gap: float
    """|xᵀ P x + qᵀ x + hᵀ z + bounds · z_box| [objective]."""


def kkt_residuals(problem: Problem, x: FloatArray | None, multipliers: Multipliers | None) -> Residuals:
    """Return the residuals of the optimality conditions; inf for an answer that is missing or not finite.

    Primal residual, dual residual and gap are all zero if and only if x is optimal, because the problem is convex.
    """
    P, q, G, h, lb, ub = problem.parts()
    if x is None or multipliers is None:
        return Residuals(np.inf, np.inf, np.inf)
    z, z_box = multipliers.z, multipliers.z_box
    if not all(np.isfinite(part).all() for part in (x, z, z_box)):
        return Residuals(np.inf, np.inf, np.inf)
    violations = np.concatenate([G @ x - h, lb - x, x - ub])
    gradient = P @ x + q + G.T @ z + z_box
    gap = x @ P @ x + q @ x + h @ z + _bound_work(lb, np.minimum(z_box, 0.0)) + _bound_work(ub, np.maximum(z_box, 0.0))
    return Residuals(
        primal=float(np.max(violations, initial=0.0)),
        dual=float(np.max(np.concatenate([np.abs(gradient), -z]), initial=0.0)),
        gap=float(abs(gap)),
    )


# --- coercion ---------------------------------------------------------------------------------------------------------


def _vector(values: npt.ArrayLike, name: str) -> FloatArray:
    array = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if array.ndim != 1 or not np.isfinite(array).all():
        raise InputError("not a vector of finite numbers", where=name, found=_brief(array), expected="shape (n,)")
    return array


def _sized(values: npt.ArrayLike, length: int, name: str) -> FloatArray:
    array = _vector(values, name)
    if len(array) != length:
        raise InputError(f"{name} has the wrong length", where=name, found=len(array), expected=length)
    return array


def _matrix(values: npt.ArrayLike, columns: int, name: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns or not np.isfinite(array).all():
        raise InputError("not a matrix that fits", where=name, found=_brief(array), expected=f"finite, {columns} columns")
    return array


def _brief(array: FloatArray) -> str:
    return f"shape {array.shape}" + ("" if np.isfinite(array).all() else ", with NaN or inf")


def _rows(matrix: npt.ArrayLike | None, right: npt.ArrayLike | None, n: int) -> tuple[FloatArray, FloatArray]:
    if matrix is None and right is None:
        return np.zeros((0, n)), np.zeros(0)
    if matrix is None or right is None:
        missing, there = ("G", "h") if matrix is None else ("h", "G")
        raise InputError(f"{missing} is missing", where=missing, found=f"{there} alone", expected="G and h")
    rows = _matrix(matrix, n, "G")
    return rows, _sized(right, len(rows), "h")


def _bounds(values: npt.ArrayLike | None, absent: float, n: int, name: str) -> FloatArray:
    array = np.full(n, absent) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape != (n,) or np.isnan(array).any() or (array == -absent).any():
        raise InputError("bounds that do not fit", where=name, found=array.tolist(), expected=f"{n} numbers; {absent} for none")
    return array


def _bound_work(bounds: FloatArray, multipliers: FloatArray) -> float:
    """Return Σ bound · multiplier over the nonzero multipliers: an absent bound (±inf) then contributes nothing, and an absent bound with
    a nonzero multiplier makes the sum infinite."""
    acting = multipliers != 0.0
    return float(bounds[acting] @ multipliers[acting])
