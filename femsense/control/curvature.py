"""Second-order part of the squared error of an unreachable target, estimated from steps.

At the closest state to an unreachable target the residual r is large, and Gauss–Newton converges slowly, because Σ r ∇²r is not small against JᵀJ. It is
estimated by the secant condition of Dennis, Gay and Welsch (1981), as in NL2SOL.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """A state with its exact tangent."""

    effort: FloatArray
    """[N, Pa], shape (d,)."""
    points: FloatArray
    """J, derivative of the rows by the efforts, shape (r, d)."""
    miss: FloatArray
    """Target minus current coordinates [m], shape (r,)."""


def learned(curvature: FloatArray, last: Seen, now: Seen) -> FloatArray:
    """Return Σ r ∇²r at a state [m² per squared unit of effort], shape (d, d), updated with the step to it.

    Arguments:
        curvature: the previous estimate, shape (d, d).
        last, now: the start and the end of the step.
    """
    step = now.effort - last.effort
    bent = -(now.points - last.points).T @ now.miss
    turned = last.points.T @ last.miss - now.points.T @ now.miss
    work = float(turned @ step)
    if abs(work) <= 1e-12 * float(np.linalg.norm(turned) * np.linalg.norm(step)):
        return curvature
    known = float(step @ curvature @ step)
    sized = curvature * (min(1.0, abs(float(step @ bent)) / abs(known)) if known else 1.0)
    rest = bent - sized @ step
    update = (np.outer(rest, turned) + np.outer(turned, rest)) / work
    return np.asarray(sized + update - float(rest @ step) * np.outer(turned, turned) / work**2)


def convex(matrix: FloatArray) -> FloatArray:
    """Return the positive semidefinite part of a symmetric matrix."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
