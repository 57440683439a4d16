"""How wanted coordinates and what the motors wind up change with tensions and pressures, and what a step shows of that."""

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
    """W_pa, the rows' change by unit efforts [m/N, m/Pa], shape (r, a + c)."""
    wound: FloatArray
    """W_aa, that of what the cables wind up, shape (a, a + c)."""
    body: FloatArray
    """How far the farthest node moves by unit efforts [m/N, m/Pa], shape (a + c,)."""
    exact: bool
    """Whether they are of the exact tangent at this state."""

    def learned(self, change: FloatArray, moved: FloatArray, wound: FloatArray) -> Slopes:
        """Return the slopes that a step shows, changed as little as possible otherwise (Broyden 1965).

        Arguments:
            change: step of the efforts [N, Pa], shape (a + c,).
            moved: by how much the rows changed [m], shape (r,).
            wound: by how much what the cables wind up changed [m], shape (a,).
        """
        share = (self.points**2).sum(axis=0) * change  # efforts count by what they move, so that units drop out
        work = float(share @ change)
        if not work > 0.0:
            return replace(self, exact=False)
        share = share / work
        points = self.points + np.outer(moved - self.points @ change, share)
        wound_up = self.wound + np.outer(wound - self.wound @ change, share)
        return replace(self, points=points, wound=wound_up, exact=False)


def exact_slopes(body: BodyModel, goal: Goal, state: Equilibrium) -> tuple[Slopes, Equilibrium]:
    """Return the slopes of the exact tangent at a state, and the state with the factor of this tangent.
    Raises FemsenseError where nothing holds the body."""
    tangent = tangent_at(body, state)
    return _slopes(body, goal, state, tangent.factor, exact=True), replace(state, factor=tangent.factor)


def lent_slopes(body: BodyModel, goal: Goal, state: Equilibrium) -> Slopes | None:
    """Return the slopes by the factor that a state keeps, of a state near by; None where there is none that serves."""
    return (
        _slopes(body, goal, state, state.factor, exact=False) if state.factor is not None and may_be_lent(body, state) else None
    )


def may_be_lent(body: BodyModel, state: Equilibrium) -> bool:
    """Return whether a state keeps a factor that leads downhill."""
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
