"""The linear equations of a Newton step: the nodes, bordered by the active drives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.assembly import Internal
from femsense.fem.body import BodyModel
from femsense.fem.newton_state import Loads, State, drive_compliance, drive_rows, kinematic_rows, travel_of, unbalanced_force

CLOSED = 1e-12
"""How far an active cable may miss its length [m]."""
CONTRADICTION = 1e-3
"""Active cables contradict each other if a step leaves more than this share of the largest gap open [1]."""


class Solver(Protocol):
    """Anything that solves with a stiffness: a factor, or a factor that has been updated."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return K⁻¹ right, shape (f,) or (f, k)."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class NewtonEquations:
    """Residuals at a state, and all coefficients of a Newton step but the stiffness K of the f free unknowns:

        K du − Cᵀ dT = force
        H du + S dT  = gap,      S = diag(stretch)

    The unknowns are the displacements du (f,) [m] and the changes dT (h,) of the efforts of the active drives: tensions of cables [N],
    then pressures of chambers [Pa]. `Loads` and `State` define effort, travel and the active set.
    """

    active: IntArray
    """Indices of the active drives, shape (h,)."""
    force: FloatArray
    """Unbalanced forces on the free unknowns [N], shape (f,)."""
    gap: FloatArray
    """Travel that each active drive still misses [m or m³], shape (h,)."""
    H: FloatArray
    """Derivative of the travel of each active drive, shape (h, f)."""
    C: FloatArray
    """Forces that a unit effort of each active drive exerts on the unknowns; H without friction, shape (h, f)."""
    stretch: FloatArray
    """Compliance of each active cable itself [m/N]; 0 for a chamber, shape (h,)."""
    lever: FloatArray
    """Scale that makes drives comparable: effort × lever is a force, travel / lever a length. 1 for a cable, the surface of a
    chamber [m²], shape (h,)."""

    @property
    def residual(self) -> float:
        """Largest unbalanced nodal force [N]."""
        return float(np.linalg.norm(self.force.reshape(-1, 3), axis=1).max(initial=0.0))

    @property
    def is_closed(self) -> bool:
        """Whether every active drive has its imposed travel."""
        return bool((np.abs(self.gap) / self.lever).max(initial=0.0) <= CLOSED)

    def step(self, stiffness: Solver) -> tuple[FloatArray, FloatArray]:
        """Return du (f,) and dT (h,), by elimination of du (Schur complement)."""
        if not len(self.active):
            return stiffness.solve(self.force), self.gap
        columns = stiffness.solve(np.column_stack([self.force, self.C.T]))
        alone, per_effort = columns[:, 0], columns[:, 1:]
        # least squares: drives on one path make the complement singular
        dT = np.linalg.lstsq(self._complement(per_effort), (self.gap - self.H @ alone) / self.lever, rcond=None)[0] / self.lever
        return alone + per_effort @ dT, np.asarray(dT, dtype=np.float64)

    def is_contradicted_by(self, du: FloatArray, dT: FloatArray) -> bool:
        """Return whether a step leaves gaps open, because the rows of active drives are linearly dependent."""
        if self.is_closed:
            return False
        left = np.abs(self.H @ du + self.stretch * dT - self.gap) / self.lever
        return bool(left.max() > CONTRADICTION * (np.abs(self.gap) / self.lever).max() + CLOSED)

    def is_definite(self, stiffness: Solver, negative: int) -> bool:
        """Return whether a stiffness with some negative eigenvalues is positive definite on all motions that the active drives allow.

        Inertia is additive (Haynsworth 1968): the complement H K⁻¹ Cᵀ + S then has as many negative eigenvalues as K.
        """
        complement = self._complement(stiffness.solve(self.C.T))
        if not np.isfinite(complement).all():
            return False
        return int((np.linalg.eigvalsh((complement + complement.T) / 2.0) < 0).sum()) == negative

    def _complement(self, per_effort: FloatArray) -> FloatArray:
        """Return H K⁻¹ Cᵀ + S for the columns K⁻¹ Cᵀ, scaled to m/N, shape (h, h)."""
        return np.asarray((self.H @ per_effort + np.diag(self.stretch)) / np.outer(self.lever, self.lever))


def equations_at(body: BodyModel, loads: Loads, state: State, here: Internal) -> NewtonEquations:
    """Return the equations at a state with its internal forces."""
    free, active = body.free_map.dofs, np.flatnonzero(state.active)
    rows, stretch = drive_rows(body, state), drive_compliance(body)[active]
    gap, H = np.zeros(0), np.zeros((0, len(free)))
    if len(active):  # travels of many cables take as long as a solve
        gap = (loads.target - travel_of(body, state.x))[active] - stretch * state.T[active]
        H = kinematic_rows(body, state, rows)[active][:, free]
    return NewtonEquations(
        active=active,
        force=unbalanced_force(loads, state, here, rows)[free],
        gap=gap,
        H=H,
        C=rows[active][:, free],
        stretch=stretch,
        lever=loads.lever[active],
    )
