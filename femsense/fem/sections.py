"""Cross-sections of a body: area, centroid and bending stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import EDGES, TetMesh

OPPOSITE = np.array([5, 3, 4, 1, 2, 0])
"""The edge of a tetrahedron that shares no corner with each of EDGES."""


@dataclass(frozen=True, eq=False, slots=True)
class CutSection:
    """Cross-section of a body by a plane."""

    area: float
    """[m²]."""
    stiffness: float
    """∫ E dA [N]."""
    centroid: FloatArray
    """Weighted with the modulus [m], shape (3,)."""
    bending: FloatArray
    """Bending stiffness ∫ E y² dA about the weaker and the stronger principal axis [N m²], shape (2,)."""


def cut_section(mesh: TetMesh, young_modulus: FloatArray, point: FloatArray, normal: FloatArray) -> CutSection | None:
    """Return the section of a straight-edged body through a point [m], shape (3,), across a direction, shape (3,).

    Only the part connected to the element nearest to the point counts, so that a body that bends back is cut once.
    None if the plane does not cut the body.
    """
    tets = mesh.tets[:, :4]
    unit = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    height = (mesh.nodes - point) @ unit
    sides = height[tets] > 0
    cut = np.flatnonzero(sides.any(axis=1) & ~sides.all(axis=1))
    if not len(cut):
        return None
    cut = cut[_nearest_part(mesh, tets[cut], point)]
    axes = np.linalg.svd(unit[None])[2][1:]
    triangles, owner = _cut_triangles(mesh.nodes[tets[cut]], height[tets[cut]])
    flat = (triangles - point) @ axes.T
    u, v = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = 0.5 * np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    weight = area * young_modulus[cut][owner]
    if not weight.sum() > 0:
        return None
    center = (weight[:, None] * flat.mean(axis=1)).sum(axis=0) / weight.sum()
    corners = flat - center
    sums = corners.sum(axis=1)
    second = np.einsum("t,tki,tkj->ij", weight, corners, corners) + np.einsum("t,ti,tj->ij", weight, sums, sums)
    return CutSection(float(area.sum()), float(weight.sum()), point + center @ axes, np.linalg.eigvalsh(second / 12.0))


def _cut_triangles(corners: FloatArray, height: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the triangles [m] in which a plane cuts tetrahedra, shape (t, 3, 3), and whose they are, shape (t,)."""
    a, b = height[:, EDGES[:, 0]], height[:, EDGES[:, 1]]
    crossed = (a > 0) != (b > 0)
    share = np.where(crossed, a / np.where(crossed, a - b, 1.0), 0.0)[..., None]
    points = (1.0 - share) * corners[:, EDGES[:, 0]] + share * corners[:, EDGES[:, 1]]
    three, four = np.flatnonzero(crossed.sum(axis=1) == 3), np.flatnonzero(crossed.sum(axis=1) == 4)
    single = points[three][crossed[three]].reshape(-1, 3, 3)
    quads = points[four][crossed[four]].reshape(-1, 4, 3)
    numbers = np.tile(np.arange(6), (len(four), 1))[crossed[four]].reshape(-1, 4)
    last = np.argmax(numbers == OPPOSITE[numbers[:, :1]], axis=1)  # the edge that shares no corner with the first
    rest = np.array([[k for k in (1, 2, 3) if k != m] for m in last], dtype=int).reshape(-1, 2)
    rows = np.arange(len(four))
    first, p, q, r = quads[:, 0], quads[rows, rest[:, 0]], quads[rows, last], quads[rows, rest[:, 1]]
    pairs = [np.stack([first, p, q], axis=1), np.stack([first, q, r], axis=1)]
    return np.vstack([single, *pairs]), np.concatenate([three, four, four])


def _nearest_part(mesh: TetMesh, tets: IntArray, point: FloatArray) -> IntArray:
    """Return the tetrahedra that are connected with the tetrahedron nearest to a point."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows = np.repeat(np.arange(len(tets)), 4)
    shares = coo_array((np.ones(len(rows)), (rows, tets.ravel())), shape=(len(tets), len(mesh.nodes)))
    parts = connected_components((shares @ shares.T).tocsr(), directed=False)[1]
    near = int(np.linalg.norm(mesh.nodes[tets].mean(axis=1) - point, axis=1).argmin())
    return np.flatnonzero(parts == parts[near])
