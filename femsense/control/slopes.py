"""The tangent of the controlled coordinates and of the wound-up lengths by tensions and pressures, and its update by steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from femsense.control.goal import Goal
from femsense.core.arrays import FloatArray
from femsense.fem.body import BodyModel
from femsense.fem.cables import pull_rows
from femsense.fem.compliance import drive_rows, tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.linalg.factorization import Factorization


@dataclass(frozen=True, eq=False, slots=True)
class Slopes:
    """The linearised problem at a state."""

    points: FloatArray
    """W_pa, derivative of the rows by the efforts [m/N, m/Pa], shape (r, a + c)."""
    wound: FloatArray
    """W_aa, derivative of the lengths wound up by the motors, shape (a, a + c)."""
    body: FloatArray
    """Displacement of the farthest node per unit of effort [m/N, m/Pa], shape (a + c,)."""
    exact: bool
    """Whether it is the exact tangent at this state."""

    def learned(self, change: FloatArray, moved: FloatArray, wound: FloatArray) -> Slopes:
        """Return the tangent with Broyden's update (1965): the smallest change that reproduces a step.

        Arguments:
            change: step of the efforts [N, Pa], shape (a + c,).
            moved: change of the rows [m], shape (r,).
            wound: change of the lengths wound up by the motors [m], shape (a,).
        """
        share = (self.points**2).sum(axis=0) * change  # efforts are weighted by the motion they cause, which removes their units
        work = float(share @ change)
        if not work > 0.0:
            return replace(self, exact=False)
        share = share / work
        points = self.points + np.outer(moved - self.points @ change, share)
        wound_up = self.wound + np.outer(wound - self.wound @ change, share)
        return replace(self, points=points, wound=wound_up, exact=False)


def exact_slopes(body: BodyModel, goal: Goal, state: Equilibrium) -> tuple[Slopes, Equilibrium]:
    """Return the exact tangent at a state, and the state with its factorisation.
    Raises FemsenseError if the body is not supported."""
    tangent = tangent_at(body, state)
    return _slopes(body, goal, state, tangent.factor, exact=True), replace(state, factor=tangent.factor)


def approximate_slopes(body: BodyModel, goal: Goal, state: Equilibrium) -> Slopes | None:
    """Return the tangent by the factorisation that a state keeps from a neighbouring one; None if there is none or it is not usable."""
    return (
        _slopes(body, goal, state, state.factor, exact=False)
        if state.factor is not None and has_factorisation(body, state)
        else None
    )


def has_factorisation(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether a state keeps a positive definite factorisation of matching size."""
    return state.factor is not None and state.factor.negative == 0 and state.factor.size == len(body.free_map.dofs)


def _slopes(body: BodyModel, goal: Goal, state: Equilibrium, factor: Factorization, *, exact: bool) -> Slopes:
    dofs = body.free_map.dofs
    shares = [t / T if T > 0 else np.ones_like(t) for t, T in zip(state.segment_tensions, state.tension.values())]
    forces = drive_rows(body, state.positions, shares)
    moves = np.zeros_like(forces)
    moves[:, dofs] = factor.solve(forces[:, dofs].T).T
    wound = pull_rows(body, state.positions) @ moves.T
    stretch = np.array([1.0 / cable.stretch_stiffness for cable in body.cables])
    wound[:, : len(stretch)] += np.diag(stretch)
    shapes = moves.reshape(len(moves), -1, 3)
    return Slopes(goal.rows(shapes), wound, np.linalg.norm(shapes, axis=2).max(axis=1, initial=0.0), exact)
