"""Von Mises stress on the surface of a body, computed from its states, for visualisation.

    E = ½ (FᵀF − I),   S = λ tr(E) I + 2 μ E,   σ_vm = √(3/2) |dev S| = √6 μ |dev E|

with F of each element's corners (St. Venant–Kirchhoff, Holzapfel 2000, section 6.5),
averaged at each corner over the elements around it by their volumes; the middle of an edge has the mean of its ends.
At the strains of soft robots in use it agrees with the corotational law; it is a visualisation, not a measurement.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import EDGES


def nodal_strain(rest: FloatArray, tets: IntArray, nodes: npt.ArrayLike) -> FloatArray:
    """Return the equivalent strain √(2/3) |dev E| at each node of each frame, shape (F, n).

    Arguments:
        rest: nodes at rest [m], shape (n, 3).
        tets: node indices, shape (m, 4) or (m, 10); corners first.
        nodes: node positions in each of F frames [m], shape (F, n, 3).
    """
    corners = np.asarray(tets)[:, :4]
    edges = rest[corners[:, 1:]] - rest[corners[:, :1]]
    inverse = np.linalg.inv(edges)
    volume = np.abs(np.linalg.det(edges)) / 6.0
    touched = np.zeros(len(rest))
    np.add.at(touched, corners.ravel(), np.repeat(volume, 4))
    states = np.asarray(nodes)
    found = np.zeros((len(states), len(rest)))
    for row, state in zip(found, states):
        moved = np.asarray(state, dtype=float)
        F = inverse @ (moved[corners[:, 1:]] - moved[corners[:, :1]])  # rows: Fᵀ
        E = 0.5 * (F @ F.transpose(0, 2, 1) - np.eye(3))
        deviator = E - np.trace(E, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        strain = np.sqrt(2.0 / 3.0 * (deviator**2).sum(axis=(1, 2)))
        np.add.at(row, corners.ravel(), np.repeat(volume * strain, 4))
    found /= np.where(touched > 0, touched, np.inf)
    if np.shape(tets)[1] > 4:
        middles = np.asarray(tets)[:, 4:]
        found[:, middles] = found[:, corners[:, EDGES]].mean(axis=-1)
    return found


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceStress:
    """Stress at the vertices of a surface over time, as coarse as colours need it."""

    largest: float
    """[Pa]; strain [%] where no material is known."""
    shares: npt.NDArray[np.uint8]
    """Of the largest, 0 … 255, shape (F, V)."""

    def to_bytes(self) -> bytes:
        """Return the largest as float32, little-endian, and the shares, frame after frame."""
        return struct.pack("<f", self.largest) + self.shares.tobytes()


def surface_stress(strain: FloatArray, stiffness_pa: float) -> SurfaceStress:
    """Return the stress of strains at vertices, shape (F, V).

    stiffness_pa: 3 μ; 100 gives strains in percent if the material is unknown.
    """
    largest = float(strain.max(initial=0.0))
    return SurfaceStress(stiffness_pa * largest, np.rint(255.0 * strain / max(largest, 1e-12)).astype(np.uint8))
