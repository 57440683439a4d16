# mypy: allow-untyped-decorators
"""Contact patches: the parts of the surface over which a contact force is spread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, read_only
from femsense.core.kernels import njit
from femsense.fem.body_parts import Chamber
from femsense.fem.closest_point import closest_on_surface
from femsense.fem.mesh import TetMesh, surface_triangles, triangle_normals


def _lattice(parts: int) -> FloatArray:
    """Return barycentric coordinates of the centres of the parts² equal triangles of a triangle, shape (parts², 3)."""
    i, j = np.meshgrid(np.arange(parts), np.arange(parts), indexing="ij")
    up, down = i + j < parts, i + j < parts - 1
    first = np.column_stack([i[up] + 1 / 3, j[up] + 1 / 3])
    second = np.column_stack([i[down] + 2 / 3, j[down] + 2 / 3])
    uv = np.vstack([first, second]) / parts
    return np.column_stack([1.0 - uv.sum(axis=1), uv])


LATTICE = _lattice(6)
"""Points of a face at which a pressure is taken: six to a side, so that a patch as wide as half a face still has eight."""


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
    faces: IntArray
    """Nodes of the faces of its elements, shape (f, 3), or (f, 6): corners, then the middles of the sides ab, bc, ca."""


@dataclass(frozen=True, eq=False, slots=True)
class ContactPatch:
    """A piece of the surface that carries one force."""

    nodes: IntArray
    """Surface nodes, shape (k,)."""
    weights: FloatArray
    """Their shares of the force, shape (k,), sum 1; those at corners of quadratic elements may be a little below 0."""

    def spread(self, force: FloatArray, node_count: int) -> FloatArray:
        """Return nodal forces [N], shape (n, 3), of a force [N], shape (3,)."""
        result = np.zeros((node_count, 3))
        result[self.nodes] = self.weights[:, None] * force
        return result

    def mean(self, values: FloatArray) -> FloatArray:
        """Return the weighted mean of nodal values (n, 3) over the contact patch, shape (3,)."""
        return np.asarray(self.weights @ values[self.nodes])


def body_surface(mesh: TetMesh, chambers: Sequence[Chamber] = ()) -> BodySurface:
    """Return the boundary of a mesh, without the walls of chambers: nothing outside touches these."""
    triangles = surface_triangles(mesh)
    faces = _faces(triangles, quadratic=mesh.is_quadratic)
    if chambers:
        is_wall = np.isin(_numbers(faces, mesh), _numbers(np.vstack([chamber.faces for chamber in chambers]), mesh))
        triangles = triangles[np.repeat(~is_wall, len(triangles) // len(faces))]
    nodes = np.unique(triangles)
    share = np.linalg.norm(triangle_normals(mesh.nodes, triangles), axis=1) / 3.0
    per_node = np.bincount(triangles.ravel(), np.repeat(share, 3), minlength=len(mesh.nodes))
    area = np.asarray(per_node[nodes], dtype=np.float64)
    corners = mesh.nodes[triangles]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    return BodySurface(triangles, nodes, area, edge, _faces(triangles, quadratic=mesh.is_quadratic))


def _numbers(faces: IntArray, mesh: TetMesh) -> IntArray:
    """Return a number for the three corners of each face, shape (f,), whatever their order."""
    corners, count = np.sort(faces[:, :3], axis=1).astype(np.int64), len(mesh.nodes)
    return np.asarray((corners[:, 0] * count + corners[:, 1]) * count + corners[:, 2])


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
    along: FloatArray | None = None,
) -> ContactPatch:
    """Return the contact patch around the point of the surface that is closest to a place.

    The pressure p ∝ √(1 − r²/a²) is Hertz's, a the given radius; with `along`, that on an ellipse whose other half axis is this one. Its nodal
    shares are those of the virtual work that it does on the element's own shape functions: quadratic elements carry nothing at the corners of an
    evenly pressed face, and shares by area would dent them.

    Arguments:
        surface: the boundary.
        positions: node positions in which the place is meant [m], shape (n, 3).
        place: [m], shape (3,).
        radius: [m].
        clamped: nodes that cannot move.
        facing: the outward normal that was seen there, shape (3,): faces that look elsewhere do not count.
        along: the half axis of the patch in the direction of a line contact [m], shape (3,); it has an effect where it is longer than the radius.
    """
    centre = closest_surface_point(surface, positions, place, facing=facing)
    values = _shape_values(LATTICE, surface.faces.shape[1])  # at each point of a face, (p, 3 or 6)
    share = np.zeros(len(positions))
    x = positions if along is None else centre + _shortened(positions - centre, along, radius)
    _press(
        read_only(positions),
        read_only(x),
        read_only(surface.faces),
        read_only(values),
        read_only(centre),
        radius,
        surface.edge,
        share,
    )
    share[clamped] = 0.0
    if share.sum() <= 0.0:  # a place on the clamp: its nearest free node
        free = np.setdiff1d(surface.nodes, clamped)
        share[free[np.argmin(np.linalg.norm(positions[free] - centre, axis=1))]] = 1.0
    nodes = np.flatnonzero(share)
    return ContactPatch(nodes, share[nodes] / share.sum())


def _shortened(ways: FloatArray, along: FloatArray, radius: float) -> FloatArray:
    """Return vectors (n, 3) compressed along a half axis (3,), so that its ellipse becomes a circle of the given radius."""
    half = float(np.linalg.norm(along))
    if half <= radius:
        return ways
    line = along / half
    return np.asarray(ways - (1.0 - radius / half) * np.outer(ways @ line, line))


@njit(cache=True)
def _press(nodes, x, faces, values, centre, radius, edge, share):  # type: ignore[no-untyped-def]
    """Write the nodal shares of Hertz's pressure about a centre, over the radius or what holds three points of the faces.

    Distances are those between positions `x`, areas those of `nodes`, both (n, 3).
    """
    corners, points = faces.shape[1], len(values)
    beyond, nearest = np.empty(len(faces)), np.inf
    for f in range(len(faces)):
        near, side = np.inf, 0.0
        for i in range(3):
            near = min(near, _apart(x[faces[f, i]], centre))
        side = _apart(x[faces[f, 0]], x[faces[f, 1]])
        beyond[f] = near - side
        nearest = min(nearest, beyond[f])
    chosen = np.flatnonzero(beyond <= max(radius, nearest + edge))
    distance, at = np.empty((len(chosen), points)), np.empty(3)
    for k in range(len(chosen)):
        for p in range(points):
            at[:] = 0.0
            for i in range(corners):
                for c in range(3):
                    at[c] += values[p, i] * x[faces[chosen[k], i], c]
            distance[k, p] = _apart(at, centre)
    reach = max(radius, 1.01 * np.partition(distance.ravel(), 2)[2])
    for k in range(len(chosen)):
        face = faces[chosen[k]]
        u, v = nodes[face[1]] - nodes[face[0]], nodes[face[2]] - nodes[face[0]]
        area = np.sqrt((u[1] * v[2] - u[2] * v[1]) ** 2 + (u[2] * v[0] - u[0] * v[2]) ** 2 + (u[0] * v[1] - u[1] * v[0]) ** 2)
        for p in range(points):
            pressure = area * np.sqrt(max(1.0 - (distance[k, p] / reach) ** 2, 0.0))
            for i in range(corners):
                share[face[i]] += pressure * values[p, i]


@njit(cache=True)
def _apart(a, b):  # type: ignore[no-untyped-def]
    return np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


def closest_surface_point(
    surface: BodySurface, positions: FloatArray, place: FloatArray, *, facing: FloatArray | None = None
) -> FloatArray:
    """Return the point of the surface that is closest to a place [m], shape (3,); only faces within 70° of `facing`, if given."""
    triangles = surface.triangles
    if facing is not None:
        normals = triangle_normals(positions, triangles)
        looks = normals @ facing > 0.35 * np.linalg.norm(normals, axis=1) * np.linalg.norm(facing)
        triangles = triangles[looks] if looks.any() else triangles
    triangle, weights, gap = np.zeros(1, dtype=np.int64), np.empty((1, 3)), np.empty(1)
    closest_on_surface(read_only(positions), read_only(triangles), read_only(place[None]), triangle, weights, gap)
    return np.asarray(weights[0] @ positions[triangles[triangle[0]]])


def _faces(triangles: IntArray, *, quadratic: bool) -> IntArray:
    """Return the faces that triangles of the boundary represent (see `surface_triangles`), shape (f, 3) or (f, 6)."""
    if not quadratic:
        return triangles
    first, second, third = triangles[0::4], triangles[1::4], triangles[2::4]
    return np.column_stack([first[:, 0], second[:, 1], third[:, 2], first[:, 1], second[:, 2], first[:, 2]])


def _shape_values(places: FloatArray, nodes: int) -> FloatArray:
    """Return the shape functions of a face with 3 or 6 nodes at barycentric coordinates (p, 3), shape (p, nodes)."""
    if nodes == 3:
        return places
    a, b, c = places.T
    return np.column_stack([places * (2.0 * places - 1.0), 4.0 * a * b, 4.0 * b * c, 4.0 * c * a])
