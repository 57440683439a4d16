"""Contact patches: the parts of the surface over which a contact force is spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import TetMesh, closest_in_triangle, surface_triangles, triangle_normals


@dataclass(frozen=True, eq=False, slots=True)
class BodySurface:
    """The boundary of a body's mesh."""

    triangles: IntArray
    """Outward, shape (t, 3)."""
    nodes: IntArray
    """Nodes on it, ascending, shape (s,)."""
    area: FloatArray
    """Area at rest that belongs to each of them [m²], shape (s,)."""
    edge: float
    """Mean length of its edges at rest [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class ContactPatch:
    """A piece of the surface that carries one force."""

    nodes: IntArray
    """Surface nodes, shape (k,)."""
    weights: FloatArray
    """Their shares of the force, shape (k,), sum 1."""

    def spread(self, force: FloatArray, node_count: int) -> FloatArray:
        """Return nodal forces [N], shape (n, 3), of a force [N], shape (3,)."""
        result = np.zeros((node_count, 3))
        result[self.nodes] = self.weights[:, None] * force
        return result

    def mean(self, values: FloatArray) -> FloatArray:
        """Return the weighted mean of nodal values (n, 3) over the contact patch, shape (3,)."""
        return np.asarray(self.weights @ values[self.nodes])


def body_surface(mesh: TetMesh) -> BodySurface:
    """Return the boundary of a mesh."""
    triangles = surface_triangles(mesh)
    nodes = np.unique(triangles)
    share = np.linalg.norm(triangle_normals(mesh.nodes, triangles), axis=1) / 3.0
    per_node = np.bincount(triangles.ravel(), np.repeat(share, 3), minlength=len(mesh.nodes))
    area = np.asarray(per_node[nodes], dtype=np.float64)
    corners = mesh.nodes[triangles]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    return BodySurface(triangles, nodes, area, edge)


def flat_nodes(surface: BodySurface, positions: FloatArray) -> IntArray:
    """Return surface nodes around which the surface is nearly flat, shape (k,): along a sharp edge a normal means little."""
    area = triangle_normals(positions, surface.triangles)
    total, together = np.zeros(len(positions)), np.zeros_like(positions)
    for corner in range(3):
        np.add.at(total, surface.triangles[:, corner], np.linalg.norm(area, axis=1))
        np.add.at(together, surface.triangles[:, corner], area)
    flatness = np.linalg.norm(together, axis=1)[surface.nodes] / total[surface.nodes]
    return np.asarray(surface.nodes[flatness > 0.93])


def patch_at(
    surface: BodySurface,
    positions: FloatArray,
    place: FloatArray,
    radius: float,
    clamped: IntArray,
    *,
    facing: FloatArray | None = None,
) -> ContactPatch:
    """Return the contact patch around the point of the surface that is closest to a place.

    The weights fall off as a cone of the given radius, times the area of each node; clamped nodes carry nothing.

    Arguments:
        surface: the boundary.
        positions: node positions in which the place is meant [m], shape (n, 3).
        place: [m], shape (3,).
        radius: [m].
        clamped: nodes that cannot move.
        facing: the outward normal that was seen there, shape (3,): faces that look elsewhere do not count.
    """
    centre = closest_surface_point(surface, positions, place, facing=facing)
    distance = np.linalg.norm(positions[surface.nodes] - centre, axis=1)
    reach = max(radius, 1.01 * float(np.sort(distance)[min(3, len(distance) - 1)]))
    weight = surface.area * np.maximum(1.0 - distance / reach, 0.0)
    weight[np.isin(surface.nodes, clamped)] = 0.0
    if weight.sum() <= 0:  # a place on the clamp: its nearest free node
        free = ~np.isin(surface.nodes, clamped)
        weight = np.zeros(len(distance))
        weight[np.flatnonzero(free)[np.argmin(distance[free])]] = 1.0
    keep = weight > 0
    return ContactPatch(surface.nodes[keep], weight[keep] / weight.sum())


def closest_surface_point(
    surface: BodySurface, positions: FloatArray, place: FloatArray, *, facing: FloatArray | None = None
) -> FloatArray:
    """Return the point of the surface that is closest to a place [m], shape (3,); only faces within 70° of `facing`, if given."""
    triangles = surface.triangles
    if facing is not None:
        normals = triangle_normals(positions, triangles)
        looks = normals @ facing > 0.35 * np.linalg.norm(normals, axis=1) * np.linalg.norm(facing)
        triangles = triangles[looks] if looks.any() else triangles
    corners = positions[triangles]
    weights = closest_in_triangle(corners, np.broadcast_to(place, (len(corners), 3)))
    points = np.einsum("ti,tic->tc", weights, corners)
    return np.asarray(points[np.argmin(np.linalg.norm(points - place, axis=1))])
