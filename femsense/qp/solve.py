"""Solving a quadratic problem, with a certificate.

The problem is scaled first: unknowns to unit curvature, rows to unit length, the gradient to one, because the solvers' absolute tolerances
are made for numbers of order one, and compliances are of the order of 1e-3 m/N. An answer is accepted only if its residuals are small;
otherwise the next solver is called.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.qp.problem import Multipliers, Problem, Residuals, kkt_residuals

SOLVERS = ("daqp", "quadprog", "osqp")
_OPTIONS: dict[str, dict[str, float | int | bool]] = {
    "daqp": {"primal_tol": 1e-11, "dual_tol": 1e-12, "iter_limit": 10_000},
    "quadprog": {},
    "osqp": {"eps_abs": 1e-11, "eps_rel": 1e-11, "polishing": True, "polish_refine_iter": 10, "max_iter": 200_000},
}


class ProgramStatus(StrEnum):
    """How a solve ended, with its cause and remedy."""

    SOLVED = "solved"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    NOT_CONVEX = "not_convex"
    INACCURATE = "inaccurate"

    @property
    def cause(self) -> str:
        """Cause of the status."""
        return _TEXTS[self][0]

    @property
    def advice(self) -> str:
        """Remedy."""
        return _TEXTS[self][1]


_TEXTS = {
    ProgramStatus.SOLVED: ("the conditions of optimality hold to the tolerance", "nothing"),
    ProgramStatus.INFEASIBLE: (
        "no point obeys all constraints: bounds that cross, or constraints that exclude each other",
        "widen the bounds; check the signs and units of inputs and limits",
    ),
    ProgramStatus.UNBOUNDED: (
        "the objective falls for ever along some direction: an unknown that no row sees and no constraint holds",
        "use fewer contacts or actuators, or bound the unknowns",
    ),
    ProgramStatus.NOT_CONVEX: (
        "P has a negative eigenvalue: the objective is not a sum of squares",
        "check the weights (≥ 0) and how P was made",
    ),
    ProgramStatus.INACCURATE: (
        "no solver reached the tolerance: the problem is badly conditioned (contacts that the rows do not distinguish)",
        "merge contacts that lie close together, or loosen the tolerance",
    ),
}


@dataclass(frozen=True, eq=False, slots=True)
class Solution:
    """The answer to a problem and its certificate. Without an answer x and multipliers are None and the residuals inf."""

    x: FloatArray | None
    """Shape [n]."""
    multipliers: Multipliers | None
    """Lagrange multipliers of the constraints; `Multipliers` states the signs."""
    primal_residual: float
    """Largest violation of a constraint, in the problem's units."""
    dual_residual: float
    """Largest unbalanced gradient, in the problem's units."""
    gap: float
    """Difference of primal and dual objective, in the problem's units."""
    certificate: float
    """Largest of primal residual, dual residual and gap of the scaled problem [1]; compared with the tolerance."""
    status: ProgramStatus
    """`solved`, or the reason of the failure; with `.cause` and `.advice`."""
    solver: str
    """Name of the solver that gave the answer; empty without an answer."""

    @property
    def solved(self) -> bool:
        """Whether x is the answer."""
        return self.status is ProgramStatus.SOLVED


Answer = tuple[FloatArray | None, Multipliers | None]
"""x and multipliers from a solver; None if the solver has no answer or is not installed."""


def solve(
    problem: Problem,
    *,
    solver: str = "daqp",
    tolerance: float = 1e-7,
    fallback: bool = True,
    call: Callable[[Problem, str], Answer] | None = None,
) -> Solution:
    """Return the answer to a convex quadratic problem.

    Arguments:
        problem: n unknowns, dense.
        solver: `daqp` (active set, dual), `quadprog` (optional package) or `osqp`; the first to try.
        tolerance: largest residual of the scaled problem, where unknowns and gradient are of order one.
        fallback: try the other installed solvers where the first one fails or misses the tolerance.
        call: asks a solver by its name; None: `call_solver`.
    Returns:
        Solution; a problem without an answer is a status, not an exception.
    Raises:
        InputError: an unknown solver.
    """
    if solver not in SOLVERS:
        raise InputError("unknown solver", where="solver", found=solver, expected=", ".join(SOLVERS))
    if (problem.parts()[4] > problem.parts()[5]).any():
        return _without_answer(ProgramStatus.INFEASIBLE)
    scaling = _scaling(problem)
    scaled = _scaled(problem, scaling)
    if _most_negative(scaled.P) < -1e-9:
        return _without_answer(ProgramStatus.NOT_CONVEX)
    order = (solver, *(name for name in SOLVERS if name != solver)) if fallback else (solver,)
    best, best_error, best_solver = None, np.inf, ""
    for name in order:
        answer = (call or call_solver)(scaled, name)
        error = _largest(kkt_residuals(scaled, *answer))
        if error < best_error:
            best, best_error, best_solver = answer, error, name
        if best_error <= tolerance:
            break
    if best_error > tolerance:
        status = _diagnosis(scaled)
        if status is not ProgramStatus.INACCURATE:
            return _without_answer(status)
    if best is None:
        return _without_answer(ProgramStatus.INACCURATE)
    return _unscaled(problem, best, scaling, best_error, best_solver, tolerance)


# --- scaling ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, slots=True)
class _Scaling:
    """x = unknowns · x̂, rows of G and A times inequality and equality, objective divided by energy."""

    unknowns: FloatArray
    inequality: FloatArray
    energy: float


def _scaling(problem: Problem) -> _Scaling:
    P, q, G, h, lb, ub = problem.parts()
    curvature = np.sqrt(np.maximum(np.diag(P), 0.0))
    largest = float(curvature.max(initial=0.0))
    weak = curvature <= 1e-12 * largest
    D = 1.0 / np.where(weak, largest if largest > 0.0 else 1.0, curvature)
    rows = _inverse_lengths(G * D)
    sizes = np.concatenate([np.abs(D * q), np.abs(rows * h)])
    limits = np.abs(np.concatenate([lb / D, ub / D]))
    widest = float(limits[np.isfinite(limits)].max(initial=0.0))
    size = float(sizes.max(initial=0.0)) or widest or 1.0
    if widest > 0.0 and np.isfinite(limits).all():  # no answer is larger, however flat the objective
        size = min(size, widest)
    return _Scaling(size * D, rows / size, size * max(size, float(np.abs(D * q).max(initial=0.0))))


def _inverse_lengths(rows: FloatArray) -> FloatArray:
    lengths = np.linalg.norm(rows, axis=1)
    return np.asarray(1.0 / np.where(lengths > 0.0, lengths, 1.0))


def _scaled(problem: Problem, scaling: _Scaling) -> Problem:
    P, q, G, h, lb, ub = problem.parts()
    D = scaling.unknowns
    return Problem(
        P=D[:, None] * P * D / scaling.energy,
        q=D * q / scaling.energy,
        G=scaling.inequality[:, None] * G * D,
        h=scaling.inequality * h,
        lb=lb / D,
        ub=ub / D,
    )


def _unscaled(
    problem: Problem,
    answer: tuple[FloatArray | None, Multipliers | None],
    scaling: _Scaling,
    error: float,
    solver: str,
    tolerance: float,
) -> Solution:
    x, scaled = answer
    assert x is not None and scaled is not None
    x = scaling.unknowns * x
    multipliers = Multipliers(
        z=freeze(scaling.energy * scaling.inequality * scaled.z),
        z_box=freeze(scaling.energy * scaled.z_box / scaling.unknowns),
    )
    residuals = kkt_residuals(problem, x, multipliers)
    status = ProgramStatus.SOLVED if error <= tolerance else ProgramStatus.INACCURATE
    return Solution(freeze(x), multipliers, residuals.primal, residuals.dual, residuals.gap, error, status, solver)


def _without_answer(status: ProgramStatus) -> Solution:
    return Solution(None, None, np.inf, np.inf, np.inf, np.inf, status, "")


# --- solvers ----------------------------------------------------------------------------------------------------------


def call_solver(problem: Problem, solver: str) -> Answer:
    """Return x and multipliers from a solver; None if the solver has no answer or is not installed."""
    import qpsolvers

    if solver not in qpsolvers.available_solvers:
        return None, None
    P, q, G, h, lb, ub = problem.parts()
    lower, upper = (lb, ub) if np.isfinite(np.concatenate([lb, ub])).any() else (None, None)
    inequality = (G, h) if len(h) else (None, None)
    quadratic = qpsolvers.Problem(np.array(P), np.array(q), *map(_writable, (*inequality, None, None, lower, upper)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            answer = qpsolvers.solve_problem(quadratic, solver=solver, **_OPTIONS[solver])
        except Exception:  # a solver's own ways to fail; the certificate decides
            return None, None
    if not answer.found or answer.x is None:
        return None, None
    return answer.x, _cleaned(problem, answer.z, answer.z_box)


def _writable(part: FloatArray | None) -> FloatArray | None:
    return None if part is None else np.array(part)


def _cleaned(problem: Problem, z: FloatArray | None, z_box: FloatArray | None) -> Multipliers:
    """Return multipliers with zeros for absent parts and absent bounds."""
    _, q, _, h, lb, ub = problem.parts()
    box = _first(z_box, len(q))
    box[(box < 0.0) & ~np.isfinite(lb)] = 0.0
    box[(box > 0.0) & ~np.isfinite(ub)] = 0.0
    return Multipliers(z=_first(z, len(h)), z_box=box)


def _first(values: FloatArray | None, length: int) -> FloatArray:
    """Return the first entries as a new array; zeros if there are too few. Solvers return different values for absent parts."""
    given = np.zeros(0) if values is None else np.asarray(values, dtype=np.float64)
    return np.array(given[:length]) if len(given) >= length else np.zeros(length)


def _largest(residuals: Residuals) -> float:
    """Return the largest residual of the scaled problem."""
    return max(residuals.primal, residuals.dual, residuals.gap)


def _most_negative(P: FloatArray) -> float:
    """Return the smallest eigenvalue over the largest, 0 for an empty or zero matrix."""
    values = np.linalg.eigvalsh(P) if len(P) else np.zeros(1)
    return float(values[0] / max(np.abs(values).max(), 1e-300))


def _diagnosis(scaled: Problem) -> ProgramStatus:
    """Return why no solver had an answer: two linear programmes tell infeasible and unbounded from inaccurate."""
    P, q, G, h, lb, ub = scaled.parts()
    if _linear(np.zeros(len(q)), G, h, P[:0], q[:0], lb, ub)[0] == 2:
        return ProgramStatus.INFEASIBLE
    down, up = np.where(np.isfinite(lb), 0.0, -1.0), np.where(np.isfinite(ub), 0.0, 1.0)
    status, slope = _linear(q, G, np.zeros(len(h)), P, np.zeros(len(q)), down, up)
    return ProgramStatus.UNBOUNDED if status == 0 and slope < -1e-9 else ProgramStatus.INACCURATE


def _linear(
    c: FloatArray, G: FloatArray, h: FloatArray, A: FloatArray, b: FloatArray, lb: FloatArray, ub: FloatArray
) -> tuple[int, float]:
    """Return HiGHS's status (0 solved, 2 infeasible) and the minimum of cᵀx subject to G x ≤ h, A x = b, lb ≤ x ≤ ub."""
    from scipy.optimize import linprog

    limits = [(float(low), float(high)) for low, high in zip(lb, ub)]
    answer = linprog(c, A_ub=G, b_ub=h, A_eq=A, b_eq=b, bounds=limits)
    return int(answer.status), float("nan") if answer.fun is None else float(answer.fun)
