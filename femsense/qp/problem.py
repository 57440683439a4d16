"""The quadratic problem of force sensing, and the certificate of an answer.

    minimise   ½ xᵀ P x + qᵀ x    subject to   G x ≤ h,   A x = b,   lb ≤ x ≤ ub

Source: "Calibration and force sensing with an RGB-D camera", section V.B, equations 10–14;
signs of the multipliers as in qpsolvers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.qp.friction_cone import FrictionCone, pyramid_rows


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
    A: FloatArray | None = None
    """Equalities A x = b, shape [k, n]."""
    b: FloatArray | None = None
    """Shape [k]."""
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
        G, h = _rows(self.G, self.h, n, "G", "h")
        A, b = _rows(self.A, self.b, n, "A", "b")
        lb, ub = _bounds(self.lb, -np.inf, n, "lb"), _bounds(self.ub, np.inf, n, "ub")
        for name, value in zip(["P", "q", "G", "h", "A", "b", "lb", "ub"], (0.5 * (P + P.T), q, G, h, A, b, lb, ub)):
            object.__setattr__(self, name, freeze(value))

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.q)

    def parts(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return P, q, G, h, A, b, lb, ub, all of them arrays."""
        G, h, A, b, lb, ub = self.G, self.h, self.A, self.b, self.lb, self.ub
        assert G is not None and h is not None and A is not None and b is not None and lb is not None and ub is not None
        return self.P, self.q, G, h, A, b, lb, ub


@dataclass(frozen=True, eq=False, slots=True)
class Multipliers:
    """Lagrange multipliers of a problem."""

    z: FloatArray
    """Multipliers of G x ≤ h, ≥ 0, shape [m]."""
    y: FloatArray
    """Multipliers of A x = b, shape [k]."""
    z_box: FloatArray
    """Multipliers of the bounds, shape [n]: ≤ 0 at an active lower bound, ≥ 0 at an active upper bound."""


@dataclass(frozen=True, eq=False, slots=True)
class Residuals:
    """Residuals of the conditions of Karush, Kuhn and Tucker; inf without an answer."""

    primal: float
    """Largest violation of a constraint [units of x and of the rows]."""
    dual: float
    """Largest entry of P x + q + Gᵀ z + Aᵀ y + z_box, or a multiplier of the wrong sign [objective / unit of x]."""
    gap: float
    """|xᵀ P x + qᵀ x + hᵀ z + bᵀ y + bounds · z_box| [objective]."""


@dataclass(frozen=True, eq=False, slots=True)
class ForceOptions:
    """Inputs, bounds and priors of the force problem."""

    cable_inputs: npt.ArrayLike | None = None
    """Measured tensions [N], shape (a,). Without measured tensions or displacements, the tensions are unknowns."""
    cable_displacements: npt.ArrayLike | None = None
    """Measured displacements of the cables [m], shape (a,); require W_aa, W_af and delta_a_free."""
    W_aa: npt.ArrayLike | None = None
    """Displacement of the cables per tension [m/N], shape (a, a)."""
    W_af: npt.ArrayLike | None = None
    """Displacement of the cables per force [m/N], shape (a, f)."""
    delta_a_free: npt.ArrayLike | None = None
    """Displacement of the cables without tensions and contact forces [m], shape (a,)."""
    force_lower: npt.ArrayLike | None = None
    """Bounds of the forces [N]: a number, (f,), or (f/3, 3)."""
    force_upper: npt.ArrayLike | None = None
    tension_lower: npt.ArrayLike | None = None
    """Bounds of the tensions [N]: a number or (a,)."""
    tension_upper: npt.ArrayLike | None = None
    friction_cone: FrictionCone | None = None
    """For forces in three components (f = 3 n): the pyramid of each of the n contacts."""
    ridge: float = 0.0
    """Price of force [objective / N²]: 1/σ² for forces expected to be about σ."""
    nuisance: npt.ArrayLike | None = None
    """Columns of k nuisance parameters, shape (r, k); their factors are further unknowns."""
    nuisance_std: npt.ArrayLike | None = None
    """Prior standard deviations of the factors of `nuisance`, shape (k,); inf: no prior. Default 1."""


def build_force_problem(
    W_forces: npt.ArrayLike,
    W_cables: npt.ArrayLike | None,
    free: npt.ArrayLike,
    target: npt.ArrayLike,
    *,
    weights: npt.ArrayLike | None = None,
    options: ForceOptions | None = None,
) -> Problem:
    """Return the problem whose answer x = (tensions, forces, nuisance) moves the features to their targets.

        minimise  ½ Σ_i weights_i (W_cables λ_a + W_forces λ_f + nuisance η + free − target)_i²  +  ½ ridge |λ_f|²  +  ½ Σ (η/nuisance_std)²
        such that λ_a = cable_inputs                                              (13)
               or W_aa λ_a + W_af λ_f + delta_a_free = cable_displacements        (14)

    Arguments:
        W_forces: displacement of each row (a feature along its normal) per force [m/N], shape (r, f).
        W_cables: the same per cable tension [m/N], shape (r, a); None without cables.
        free, target: displacement or position of each row without these forces, and as observed [m], shape (r,).
        weights: 1 / variance of each row [1/m²], shape (r,); 1 where not given; 0 leaves a row out.
        options: inputs, bounds and priors.
    Returns:
        The Problem, in a + f + k unknowns.
    Raises:
        InputError: shapes that do not fit, or (13) and (14) together.
    """
    o = options or ForceOptions()
    forces = _columns(W_forces, None, "W_forces")
    rows, f = forces.shape
    cables = np.zeros((rows, 0)) if W_cables is None else _columns(W_cables, rows, "W_cables")
    extra = np.zeros((rows, 0)) if o.nuisance is None else _columns(o.nuisance, rows, "nuisance")
    a, k = cables.shape[1], extra.shape[1]
    W = np.hstack([cables, forces, extra])
    scale = _weights(weights, rows)
    misfit = _sized(free, rows, "free") - _sized(target, rows, "target")
    prior = np.concatenate([np.zeros(a), np.full(f, _not_negative(o.ridge, "ridge")), prior_precision(o.nuisance_std, k)])
    A, b = _actuation(o.cable_inputs, o.cable_displacements, o.W_aa, o.W_af, o.delta_a_free, a, f, k)
    G = None if o.friction_cone is None else pyramid_rows(o.friction_cone, a, f, k)
    lower = np.concatenate(
        [_limit(o.tension_lower, -np.inf, a, "tension_lower"), _limit(o.force_lower, -np.inf, f, "force_lower")]
    )
    upper = np.concatenate([_limit(o.tension_upper, np.inf, a, "tension_upper"), _limit(o.force_upper, np.inf, f, "force_upper")])
    return Problem(
        P=W.T @ (scale[:, None] * W) + np.diag(prior),
        q=W.T @ (scale * misfit),
        G=G,
        h=None if G is None else np.zeros(len(G)),
        A=A,
        b=b,
        lb=np.concatenate([lower, np.full(k, -np.inf)]),
        ub=np.concatenate([upper, np.full(k, np.inf)]),
    )


def kkt_residuals(problem: Problem, x: FloatArray | None, multipliers: Multipliers | None) -> Residuals:
    """Return the residuals of the optimality conditions; inf for an answer that is missing or not finite.

    Primal residual, dual residual and gap are all zero if and only if x is optimal, because the problem is convex.
    """
    P, q, G, h, A, b, lb, ub = problem.parts()
    if x is None or multipliers is None:
        return Residuals(np.inf, np.inf, np.inf)
    z, y, z_box = multipliers.z, multipliers.y, multipliers.z_box
    if not all(np.isfinite(part).all() for part in (x, z, y, z_box)):
        return Residuals(np.inf, np.inf, np.inf)
    violations = np.concatenate([G @ x - h, np.abs(A @ x - b), lb - x, x - ub])
    gradient = P @ x + q + G.T @ z + A.T @ y + z_box
    gap = x @ P @ x + q @ x + h @ z + b @ y + _bound_work(lb, np.minimum(z_box, 0.0)) + _bound_work(ub, np.maximum(z_box, 0.0))
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


def _columns(values: npt.ArrayLike, rows: int | None, name: str) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    fits = array.ndim == 2 and (rows is None or array.shape[0] == rows)
    if not fits or not np.isfinite(array).all():
        raise InputError("not a matrix that fits", where=name, found=_brief(array), expected=f"finite, {rows or 'r'} rows")
    return array


def _brief(array: FloatArray) -> str:
    return f"shape {array.shape}" + ("" if np.isfinite(array).all() else ", with NaN or inf")


def _rows(
    matrix: npt.ArrayLike | None, right: npt.ArrayLike | None, n: int, matrix_name: str, right_name: str
) -> tuple[FloatArray, FloatArray]:
    if matrix is None and right is None:
        return np.zeros((0, n)), np.zeros(0)
    if matrix is None or right is None:
        missing, there = (matrix_name, right_name) if matrix is None else (right_name, matrix_name)
        raise InputError(
            f"{missing} is missing", where=missing, found=f"{there} alone", expected=f"{matrix_name} and {right_name}"
        )
    rows = _matrix(matrix, n, matrix_name)
    return rows, _sized(right, len(rows), right_name)


def _bounds(values: npt.ArrayLike | None, absent: float, n: int, name: str) -> FloatArray:
    array = np.full(n, absent) if values is None else np.asarray(values, dtype=np.float64)
    if array.shape != (n,) or np.isnan(array).any() or (array == -absent).any():
        raise InputError("bounds that do not fit", where=name, found=array.tolist(), expected=f"{n} numbers; {absent} for none")
    return array


def _weights(weights: npt.ArrayLike | None, rows: int) -> FloatArray:
    scale = np.ones(rows) if weights is None else _sized(weights, rows, "weights")
    if (scale < 0.0).any():
        raise InputError("negative weights", where="weights", found=float(scale.min()), expected="≥ 0")
    return scale


def _not_negative(value: float, name: str) -> float:
    if not (np.isfinite(value) and value >= 0.0):
        raise InputError(f"{name} must not be negative", where=name, found=value, expected="a finite number ≥ 0")
    return float(value)


def prior_precision(std: npt.ArrayLike | None, k: int) -> FloatArray:
    """Return 1 / std² of k nuisance factors, shape (k,); std a number or (k,), 1 where not given. Raises InputError."""
    values = np.ones(k) if std is None else np.broadcast_to(np.asarray(std, dtype=np.float64), (k,))
    if k and not (values > 0.0).all():
        raise InputError(
            "standard deviations must be positive", where="nuisance_std", found=values.tolist(), expected="> 0, inf: free"
        )
    return np.asarray(1.0 / values**2)


def _limit(values: npt.ArrayLike | None, absent: float, n: int, name: str) -> FloatArray:
    array = np.asarray(absent if values is None else values, dtype=np.float64)
    if array.ndim == 0:
        return np.full(n, float(array))
    if array.size != n:
        raise InputError(
            "as many bounds as unknowns", where=name, found=array.shape, expected=f"a number, ({n},) or ({n} / 3, 3)"
        )
    return array.ravel()


# --- constraints ------------------------------------------------------------------------------------------------------


def _actuation(
    inputs: npt.ArrayLike | None,
    displacements: npt.ArrayLike | None,
    W_aa: npt.ArrayLike | None,
    W_af: npt.ArrayLike | None,
    delta_a_free: npt.ArrayLike | None,
    a: int,
    f: int,
    k: int,
) -> tuple[FloatArray | None, FloatArray | None]:
    """Return A and b of equation (13) or (14), None without either."""
    if inputs is not None and displacements is not None:
        found = "cable_inputs (13) and cable_displacements (14)"
        raise InputError("two statements of the cables", where="cable_inputs", found=found, expected="one of them")
    if inputs is not None:
        return np.hstack([np.eye(a), np.zeros((a, f + k))]), _sized(inputs, a, "cable_inputs")
    if displacements is None:
        return None, None
    for name, part in (("W_aa", W_aa), ("W_af", W_af), ("delta_a_free", delta_a_free)):
        if part is None:
            raise InputError(
                f"{name} is missing", where=name, found="cable_displacements (14)", expected="W_aa, W_af, delta_a_free"
            )
    assert W_aa is not None and W_af is not None and delta_a_free is not None
    A = np.hstack([_matrix(W_aa, a, "W_aa"), _matrix(W_af, f, "W_af"), np.zeros((a, k))])
    return A, _sized(displacements, a, "cable_displacements") - _sized(delta_a_free, a, "delta_a_free")


def _bound_work(bounds: FloatArray, multipliers: FloatArray) -> float:
    """Return Σ bound · multiplier over the nonzero multipliers: an absent bound (±inf) then contributes nothing, and an absent bound with
    a nonzero multiplier makes the sum infinite."""
    acting = multipliers != 0.0
    return float(bounds[acting] @ multipliers[acting])
