"""The friction cone of a contact, and the pyramid inside it that a quadratic programme takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError


@dataclass(frozen=True, eq=False, slots=True)
class FrictionCone:
    """Coulomb's cone about each inward normal, replaced by a pyramid inside it.

    The force f on the body obeys  f·(−n) ≥ 0  and  f·tⱼ ≤ mu cos(π/sides) f·(−n)  for tangents t₁ … t_sides, evenly spread.
    """

    normals: FloatArray
    """Outward normals of the body, shape [n, 3]; made unit here."""
    mu: float
    """Coefficient of friction, ≥ 0."""
    sides: int = 8
    """Sides of the pyramid, at least 4."""

    def __post_init__(self) -> None:
        normals = np.atleast_2d(np.asarray(self.normals, dtype=np.float64))
        if normals.ndim != 2 or normals.shape[1] != 3 or not (np.linalg.norm(normals, axis=1) > 0.0).all():
            raise InputError(
                "not normals", where="normals", found=normals.tolist(), expected="directions (n, 3), none of length zero"
            )
        if not self.mu >= 0.0:
            raise InputError("a negative coefficient of friction", where="mu", found=self.mu, expected="≥ 0")
        if self.sides < 4:
            raise InputError("too few sides", where="sides", found=self.sides, expected="at least 4")
        object.__setattr__(self, "normals", freeze(normals / np.linalg.norm(normals, axis=1, keepdims=True)))


def pyramid_rows(cone: FrictionCone, a: int, f: int, k: int) -> FloatArray:
    """Return G, shape (n (sides + 1), a + f + k), of G x ≤ 0."""
    n = len(cone.normals)
    if f != 3 * n:
        raise InputError(
            "a cone needs forces in three components", where="friction_cone", found=f"{f} columns", expected=f"{3 * n}"
        )
    angles = 2.0 * np.pi * np.arange(cone.sides) / cone.sides
    G = np.zeros((n, cone.sides + 1, a + f + k))
    for i, normal in enumerate(cone.normals):
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        tangents = np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * np.cross(normal, first)
        columns = slice(a + 3 * i, a + 3 * i + 3)
        G[i, :-1, columns] = tangents + cone.mu * np.cos(np.pi / cone.sides) * normal
        G[i, -1, columns] = normal
    return G.reshape(-1, a + f + k)
