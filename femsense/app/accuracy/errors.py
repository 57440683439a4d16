"""The errors of spaces against the limit of ever finer ones.

Where a mesh h and its refinement h/2 with the same element are both known, that limit is estimated by Richardson's extrapolation,

    u* = u(h/2) + (u(h/2) − u(h)) / (2^p − 1),

with p = 2, which is careful: linear elements reach it in smooth bodies, quadratic ones in bodies with inward corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray

ORDER = 2.0
"""p, see above."""


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """How one space answers."""

    element: str
    refinements: int
    tetrahedra: int
    unknowns: int
    step_ms: float
    """Processor time of assembling and factorising the stiffness once [ms]."""
    motions: FloatArray
    """Displacement of the observed points under each load [m], shape (l, p, 3)."""
    per_newton: FloatArray
    """Displacement of the observed points under each contact force [m/N], shape (k, p, 3)."""

    def is_space(self, element: str, refinements: int) -> bool:
        return (self.element, self.refinements) == (element, refinements)


@dataclass(frozen=True, eq=False, slots=True)
class Reference:
    motions: FloatArray
    per_newton: FloatArray
    motion_doubt: FloatArray
    """How far the reference itself may be off [m], shape (l, p); NaN: not known."""
    description: dict[str, Any]
    answer: Answer
    is_limit: bool


def reference_of(answers: Sequence[Answer]) -> Reference:
    """Return the extrapolated limit of finer meshes if two with the same element are known, else the result of the finest quadratic one."""
    pairs = [(a, b) for a in answers for b in answers if b.is_space("tet10", a.refinements + 1) and a.element == "tet10"]
    if pairs:
        coarse, fine = pairs[-1]
        step = 1.0 / (2.0**ORDER - 1.0)
        motions = fine.motions + step * (fine.motions - coarse.motions)
        text = f"the limit of tet10 meshes, extrapolated from {coarse.tetrahedra} and {fine.tetrahedra} tetrahedra"
        description = {"text": text, "unknowns": fine.unknowns, "extrapolated": True}
        doubt = np.linalg.norm(motions - fine.motions, axis=2)
        return Reference(motions, fine.per_newton + step * (fine.per_newton - coarse.per_newton), doubt, description, fine, True)
    fine = max(answers, key=lambda answer: (answer.element == "tet10", answer.unknowns))
    text = f"{fine.element} with {fine.tetrahedra} tetrahedra, the finest space that is affordable; its own error is not known"
    description = {"text": text, "unknowns": fine.unknowns, "extrapolated": False}
    return Reference(fine.motions, fine.per_newton, np.full(fine.motions.shape[:2], np.nan), description, fine, False)


@dataclass(frozen=True, eq=False, slots=True)
class Errors:
    known: bool
    motion: FloatArray  # largest motion under each load [m], (l,)
    largest: FloatArray  # largest error [m], (l,)
    rms: FloatArray  # [m], (l,)
    share: FloatArray  # rms error over rms motion, (l,)
    doubt: FloatArray  # largest doubt [m], (l,)
    force: FloatArray  # sensed over true force − 1, (k,)


def errors_of(answer: Answer, reference: Reference) -> Errors:
    """Return the errors of an answer against the reference, load by load."""
    off, true = answer.motions - reference.motions, reference.motions
    distance, moved = np.linalg.norm(off, axis=2), np.linalg.norm(true, axis=2)
    rms, size = np.sqrt((distance**2).mean(axis=1)), np.sqrt((moved**2).mean(axis=1))
    known = reference.is_limit or answer is not reference.answer
    share = np.divide(rms, size, out=np.zeros_like(rms), where=size > 0)
    return Errors(
        known,
        moved.max(axis=1),
        distance.max(axis=1),
        rms,
        share,
        reference.motion_doubt.max(axis=1),
        _force_errors(answer, reference),
    )


def _force_errors(answer: Answer, reference: Reference) -> FloatArray:
    """Return sensed force / true force − 1 at each contact, shape (k,).

    The force that a camera's points call for on a model is the one whose displacement field U comes nearest to the true field U*:
    least squares gives ⟨U, U*⟩ / ⟨U, U⟩ times the true force.
    """
    own, true = answer.per_newton, reference.per_newton
    return np.asarray((own * true).sum(axis=(1, 2)) / (own**2).sum(axis=(1, 2)) - 1.0)


def space_name(element: str, refinements: int) -> str:
    """Return the name of an element space in words."""
    return f"{element}, split into eight" if refinements else element
