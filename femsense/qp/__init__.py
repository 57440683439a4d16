"""The quadratic problem of force sensing: build it, solve it with a certificate, and say how far the forces can be trusted."""

from femsense.qp.forces import ForceEstimate, estimate_forces
from femsense.qp.friction_cone import FrictionCone
from femsense.qp.problem import ForceOptions, Multipliers, Problem, Residuals, build_force_problem, kkt_residuals
from femsense.qp.solve import SOLVERS, ProgramStatus, Solution, solve

__all__ = [
    "SOLVERS",
    "ForceEstimate",
    "ForceOptions",
    "FrictionCone",
    "Multipliers",
    "Problem",
    "ProgramStatus",
    "Residuals",
    "Solution",
    "build_force_problem",
    "estimate_forces",
    "kkt_residuals",
    "solve",
]
