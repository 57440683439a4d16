"""The equilibrium on a finer mesh, by a few Newton steps from a state of a coarse one."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.fem.body import BodyModel
from femsense.fem.cables import shortening
from femsense.fem.compliance import drive_rows, tangent_at
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.linalg.factorization import Factorization, Pattern, factorize, factorize_definite
from femsense.fem.linalg.iterative import UnsettledError, iterative
from femsense.fem.linalg.refinement import ROUGH, ROUGH_FROM, prepare_roughly, roughly
from femsense.fem.mesh import Embedding
from femsense.fem.rotated_step import rotated_step
from femsense.model.balance import Balance, rubbed
from femsense.model.drive import DrivenRobot

FINER_STEPS = 8


LAST_STEP = 0.2
"""Newton steps end when the last one was at most this share of the total displacement. The residual force is not a criterion, because it
is small for a compliant motion far from equilibrium."""


@dataclass(frozen=True, slots=True)
class FinerOptions:
    """How far the steps on the finer mesh go."""

    enough: float = 5e-3
    """Newton steps end when the unbalanced force has fallen to this share …"""
    paces: tuple[float, ...] = (1.0, 0.5)
    """Shares of the first steps that are gone, tried in turn: whole ones fold elements where a body is bent much,
    until the force has fallen to NEAR."""
    rough_from: int = ROUGH_FROM
    """Unknowns from which on conjugate gradients take the place of a factor."""


NEAR = 0.1
"""Steps are whole once the unbalanced force has fallen to this share."""


LET_BE = 0.01
"""A held cable may push by this share of the largest tension, or a slack one be too long by this share of the way,
before it goes slack or taut."""


EARLY = 3e-2
"""Share of the first of these steps that may be missing, in energy, which the next one mends; of the last ones ROUGH."""


def share_on_finer(body: BodyModel) -> None:
    """Compute the data common to the steps of all states on a finer mesh, independent of the material; cached with the body's free map."""
    prepare_roughly(body.free_map.pattern)
    rotated_step(body, body.mesh.nodes, np.zeros_like(body.mesh.nodes))


def finer_state(
    driven: DrivenRobot,
    fine: DrivenRobot,
    frame: int,
    base: Equilibrium,
    ties: Embedding,
    *,
    options: FinerOptions | None = None,
) -> FloatArray | None:
    """Return the equilibrium on a finer mesh [m], shape (n, 3), nearly: Newton steps from a state of a coarser one.

    The finer mesh represents the coarse state exactly, but its refinement softens single elements, so that two to four steps with rotated
    elements are needed. None if the steps do not converge or diverge: forces are small again far away.

    Rejected on the bar of `benchmarks/improve.py`: a preconditioner kept from the first step of a state costs as much in further
    iterations as it saves, one of another state several times as much, and `FinerOptions.enough` = 0.02 changes the error by a sixth.
    Starting from the finer state of another model saves one step of three, but elements may invert there: the state was then missing, and
    the mesh error of that frame a third too small.

    Arguments:
        driven: the coarse robot and its drive.
        fine: the same on the finer mesh.
        frame: index of the frame.
        base: the coarse state of that frame.
        ties: of the fine nodes to the coarse mesh.
        options: stopping criteria.

    Raises:
        FemsenseError: the stiffness on the way is singular or, on a fine mesh, not stable.
    """
    how = options or FinerOptions()
    for pace in how.paces:
        try:
            x = _stepped(driven, fine, frame, base, ties, pace, how)
        except FemsenseError:
            if pace == how.paces[-1]:
                raise
            continue
        if x is not None:
            return x
    return None


def _stepped(
    driven: DrivenRobot,
    fine: DrivenRobot,
    frame: int,
    base: Equilibrium,
    ties: Embedding,
    pace: float,
    how: FinerOptions,
) -> FloatArray | None:
    """Return the state that `finer_state` computes; the first steps are damped."""
    body, balance = fine.robot.body, Balance(driven, frame, base)
    x = coarse = ties.positions(base.positions)
    at, force, first = _pulling(fine, balance, base, x)
    size, share = first, 1.0
    for _ in range(FINER_STEPS):
        if size <= how.enough * first and share <= LAST_STEP:
            held, at = at.held, retaut(fine, frame, at, x, LET_BE * np.abs(x - coarse).max())
            if (at.held == held).all():
                return x
        enough = min(EARLY, ROUGH * first / size) if size < first else EARLY
        here = replace(base, positions=x, factor=None, held=at.held)
        solver = roughly if at.held.any() else stable
        tangent = tangent_at(body, here, partial(solver, tolerance=enough, pays_from=how.rough_from))
        move = tangent.respond(force[None])[0]
        if at.held.any():
            missing = _missing(fine, frame, at, x)[at.held[: len(body.cables)]]
            move = move + np.tensordot(missing, tangent.respond_to_held(), axes=1)
        move *= pace if size > NEAR * first else 1.0
        turned = rotated_step(body, x, move)
        x = np.asarray(x + move) if turned is None else turned
        way = np.abs(x - coarse).max()
        if not way < body.reach:
            return None
        share = np.abs(move).max() / max(way, 1e-300)
        at, force, size = _pulling(fine, balance, at, x)
    return x if size <= how.enough * first else None


def stable(pattern: Pattern, values: FloatArray, *, tolerance: float, pays_from: int) -> Factorization | None:
    """Return a stiffness as `roughly` does, from `pays_from` unknowns on only one that is positive definite. Raises FemsenseError.

    Steps with any other lead to no state that a body could stay in, unless cables hold it: on the arm of `benchmarks/real.py`, whose
    chambers are blown up, three indefinite factors took 20 s a state, and no state was found.
    """
    if pattern.size < pays_from or pattern.grid is None or not np.isfinite(values).all():
        return factorize(pattern, values)
    with contextlib.suppress(UnsettledError):  # too ill-conditioned for conjugate gradients
        found = iterative(pattern.levels(), values, tolerance=tolerance)
        if found is not None:
            return found
    direct = factorize_definite(pattern, values, tries=0)[0]
    if direct is None:
        raise FemsenseError("the body is not stable there on the finer mesh")
    return direct


def _pulling(fine: DrivenRobot, balance: Balance, at: Equilibrium, x: FloatArray) -> tuple[Equilibrium, FloatArray, float]:
    """Return a state with the least-squares tensions of its held cables at x, the remaining nodal forces [N], (n, 3), and their norm [N]."""
    body, dofs = fine.robot.body, fine.robot.body.free_map.dofs
    force = balance.whole(fine, rubbed(fine, balance.frame, at, x), x)
    rest, held = force.ravel()[dofs], np.flatnonzero(at.held[: len(body.cables)])
    if len(held):
        pulls = drive_rows(body, x)[held][:, dofs].T
        more = -np.linalg.lstsq(pulls, rest, rcond=None)[0]
        rest = rest + pulls @ more
        names = body.cable_names
        at = replace(at, tension={**at.tension, **{names[i]: at.tension[names[i]] + float(m) for i, m in zip(held, more)}})
    whole = np.zeros(force.size)
    whole[dofs] = rest
    return at, whole.reshape(force.shape), float(np.linalg.norm(rest))


def _missing(fine: DrivenRobot, frame: int, at: Equilibrium, x: FloatArray) -> FloatArray:
    """Return the missing shortening of each cable at x [m], (a,): prescribed minus actual shortening and stretch."""
    body = fine.robot.body
    stretch = np.array([at.tension[c.name] / c.stretch_stiffness for c in body.cables])
    return np.asarray(fine.drive.inputs[frame] - stretch - shortening(body, x))


def retaut(fine: DrivenRobot, frame: int, at: Equilibrium, x: FloatArray, least: float) -> Equilibrium:
    """Return a state at x with the held cables slack that would push there,
    and those taut that are too long by more than a length [m]."""
    if fine.drive.control != "displacement":
        return at
    names, held = fine.robot.body.cable_names, at.held.copy()
    T = np.array([at.tension[name] for name in names])
    taut, most = held[: len(names)], np.abs(T).max(initial=0.0)
    now = np.where(taut, -LET_BE * most < T, _missing(fine, frame, at, x) > least)
    held[: len(names)] = now
    return replace(at, held=held, tension={name: float(t) for name, t in zip(names, np.where(now, T, 0.0))})
