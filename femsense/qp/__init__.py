"""Quadratic problems: build them, solve them, and certify the answer."""

from femsense.qp.problem import Multipliers, Problem, Residuals, kkt_residuals
from femsense.qp.solve import SOLVERS, ProgramStatus, Solution, solve

__all__ = [
    "SOLVERS",
    "Multipliers",
    "Problem",
    "ProgramStatus",
    "Residuals",
    "Solution",
    "kkt_residuals",
    "solve",
]
