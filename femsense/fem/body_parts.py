"""The parts of a body: its material, cables and chambers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import Embedding

LAWS = ("corotational", "neo_hookean", "gent")


@dataclass(frozen=True, eq=False, slots=True)
class Material:
    """An isotropic material, one modulus and Poisson ratio for each element."""

    young_modulus: FloatArray
    """[Pa], shape (m,)."""
    poisson_ratio: FloatArray
    """[1], shape (m,), in (−1, 0.5)."""
    density: float
    """[kg/m³]."""
    law: str = "corotational"
    """One of LAWS."""
    stretch_limit: float = np.inf
    """Gent's limit of I₁ − 3 [1]."""

    def lame(self) -> tuple[FloatArray, FloatArray]:
        """Return μ and λ [Pa], shapes (m,)."""
        E, nu = self.young_modulus, self.poisson_ratio
        return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@dataclass(frozen=True, eq=False, slots=True)
class Cable:
    """A cable through points of the body to a pull point that is fixed in space."""

    name: str
    path: Embedding
    """Points of the body, far end first."""
    pull_point: FloatArray
    """[m], shape (3,)."""
    exit_direction: FloatArray | None = None
    """Unit vector along which the cable leaves the pull point, shape (3,); only friction depends on it."""
    min_tension: float = 0.0
    """[N]."""
    max_tension: float = np.inf
    """[N]."""
    friction: float = 0.0
    """Capstan coefficient μ at every bend [1]."""
    stretch_stiffness: float = np.inf
    """Stiffness of the cable itself [N/m]; inf: it does not stretch."""


@dataclass(frozen=True, eq=False, slots=True)
class Chamber:
    """A closed cavity of the body under pressure; `femsense.fem.cavities.find_chamber` finds it in a mesh."""

    name: str
    faces: IntArray
    """Nodes of its surface, looking into the material, shape (t, 3), or (t, 6): corners, then the middles of ab, bc, ca."""
    seed: FloatArray
    """A point inside at rest [m], shape (3,)."""
    max_pressure: float = np.inf
    """[Pa]."""


def segment_nodes(path: Embedding) -> IntArray:
    """Return the nodes that move each segment of a cable, those of its near end first, shape (s, 2k).

    The last segment ends at the pull point, which no node moves: its own nodes fill the second half.
    """
    return np.hstack([path.nodes, np.vstack([path.nodes[1:], path.nodes[-1:]])])
