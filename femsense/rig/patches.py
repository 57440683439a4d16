"""The part of the surface that is pressed, and how: around a place with a radius,
or as an object of a form presses an elastic foundation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import TetMesh, closest_in_triangle, surface_triangles, triangle_normals

FOUNDATION = 1.70
"""Stiffness of a foundation that gives a ball the contact of Hertz, in E* over the radius of the contact (Johnson, Contact
Mechanics, 1985, section 4.3)."""
FINEST = 8
"""Maximum number of subdivisions of a triangle's side."""
SAMPLES = 0.3
"""Spacing of the points that carry pressure, relative to the contact radius."""


@dataclass(frozen=True, eq=False, slots=True)
class LoadPatch:
    """A part of the surface that carries a contact force."""

    triangles: IntArray
    """Node indices, shape (t, 3)."""
    share: FloatArray
    """Share of the force on each triangle [1], shape (t,)."""
    corners: FloatArray | None = None
    """Barycentric coordinates of the loaded point of each triangle, shape (t, 3); None: its centre."""
    radius: float = 0.0
    """Radius of a circle with the same area [m]."""

    @property
    def weights(self) -> FloatArray:
        """Share of the force on each corner of each triangle [1], shape (t, 3)."""
        corners = np.full((len(self.share), 3), 1.0 / 3.0) if self.corners is None else self.corners
        return np.asarray(self.share[:, None] * corners)

    def points(self, positions: FloatArray) -> FloatArray:
        """Return the loaded points [m], shape (t, 3)."""
        if self.corners is None:
            return np.asarray(positions[self.triangles].mean(axis=1))
        return np.asarray(np.einsum("tk,tkc->tc", self.corners, positions[self.triangles]))

    def place(self, positions: FloatArray) -> FloatArray:
        """Return the centre of the contact patch [m], shape (3,)."""
        return np.asarray(self.share @ self.points(positions))

    def normal(self, positions: FloatArray) -> FloatArray:
        """Return the outward unit normal of the contact patch, shape (3,)."""
        area = self.share @ triangle_normals(positions, self.triangles)
        return np.asarray(area / np.linalg.norm(area))

    def spread(self, force: FloatArray, node_count: int) -> FloatArray:
        """Return the nodal forces of a force [N], shape (n, 3)."""
        forces = np.zeros((node_count, 3))
        for corner, carried in enumerate(self.weights.T):
            np.add.at(forces, self.triangles[:, corner], carried[:, None] * force)
        return forces

    def turned(self, rest: FloatArray, positions: FloatArray, direction: FloatArray) -> FloatArray:
        """Return a direction along the surface at rest, rotated with the deformed surface, unit, shape (3,)."""
        a, b, c = self.triangles[int(self.share.argmax())]
        edges = np.stack([rest[b] - rest[a], rest[c] - rest[a]], axis=1)
        along = np.linalg.lstsq(edges, direction, rcond=None)[0]
        moved = np.stack([positions[b] - positions[a], positions[c] - positions[a]], axis=1) @ along
        normal = self.normal(positions)
        moved = moved - (moved @ normal) * normal
        return np.asarray(moved / max(float(np.linalg.norm(moved)), 1e-15))


def contact_patch(mesh: TetMesh, point: Sequence[float] | FloatArray, radius: float) -> LoadPatch:
    """Return the surface triangles around a place at rest; the pressure falls to zero at the radius.

    Arguments:
        mesh: of the truth.
        point: on the surface at rest [m], shape (3,).
        radius: [m]; where no triangle's centre is so near, the nearest one carries all.
    """
    triangles = surface_triangles(mesh)
    distance = np.linalg.norm(mesh.nodes[triangles].mean(axis=1) - np.asarray(point), axis=1)
    area = np.linalg.norm(triangle_normals(mesh.nodes, triangles), axis=1)
    near = np.flatnonzero(distance < radius)
    if not len(near):
        near = np.array([int(distance.argmin())])
    normals = triangle_normals(mesh.nodes, triangles[near])
    near = near[normals @ normals[distance[near].argmin()] > 0]  # not the far side of a thin part
    share = area[near] * np.maximum(1.0 - (distance[near] / radius) ** 2, 1e-3)
    return LoadPatch(triangles[near], share / share.sum(), radius=radius)


@dataclass(frozen=True, eq=False, slots=True)
class Pressing:
    """Contact geometry of an object on the surface at rest."""

    place: FloatArray
    """Place of the first contact [m], shape (3,)."""
    normal: FloatArray
    """Outward normal there, shape (3,)."""
    along: FloatArray
    """Its x axis, unit, along the surface, shape (3,)."""
    reach: float
    """Radius of its lower side about the contact point [m]."""
    scale: float
    """Approximate smallest contact radius [m]."""
    height: Callable[[FloatArray], FloatArray]
    """Height of its lower side above its lowest point [m], shape (k,), at places (k, 2) along x and y; inf outside of it."""


def pressed_patch(mesh: TetMesh, how: Pressing, force: float, modulus: float) -> LoadPatch:
    """Return the patch of an object under a contact force, by an elastic foundation.

        p = 1.70 E*/a (δ − g)  where the gap g is below the approach δ;  a = √(area / π),  Σ p A = force.

    Arguments:
        mesh: the true mesh.
        how: the contact geometry.
        force: [N], > 0.
        modulus: E* = E / (1 − ν²) [Pa].
    """
    triangles, corners, area = _samples(mesh, how)
    points = np.einsum("tk,tkc->tc", corners, mesh.nodes[triangles]) - how.place
    across = np.cross(how.normal, how.along)
    gap = how.height(np.column_stack([points @ how.along, points @ across])) - points @ how.normal
    gap = gap - gap.min()
    approach = _approach(gap, area, force / (FOUNDATION * modulus))
    pressure = np.maximum(approach - gap, 0.0)
    keep = pressure > 0
    share = pressure[keep] * area[keep]
    return LoadPatch(triangles[keep], share / share.sum(), corners[keep], float(np.sqrt(area[keep].sum() / np.pi)))


def nearest_place(mesh: TetMesh, point: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the surface point at rest closest to a place, and its outward normal, shape (3,) each."""
    triangles = surface_triangles(mesh)
    middles = mesh.nodes[triangles].mean(axis=1)
    near = np.argsort(np.linalg.norm(middles - point, axis=1))[:40]
    weights = closest_in_triangle(mesh.nodes[triangles[near]], np.tile(point, (len(near), 1)))
    places = np.einsum("tk,tkc->tc", weights, mesh.nodes[triangles[near]])
    best = int(np.linalg.norm(places - point, axis=1).argmin())
    normals = triangle_normals(mesh.nodes, triangles[near])
    edge = np.linalg.norm(mesh.nodes[triangles[near[best], 0]] - mesh.nodes[triangles[near[best], 1]])
    beside = (np.linalg.norm(middles[near] - places[best], axis=1) < 1.5 * edge) & (normals @ normals[best] > 0)
    mean = normals[beside].sum(axis=0) if beside.any() else normals[best]
    return places[best], mean / np.linalg.norm(mean)


def _samples(mesh: TetMesh, how: Pressing) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the points that may carry pressure: triangles (s, 3), barycentric coordinates (s, 3) and areas [m²] (s,)."""
    triangles = surface_triangles(mesh)
    corners = mesh.nodes[triangles]
    sizes = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    vectors = triangle_normals(mesh.nodes, triangles)
    area = np.linalg.norm(vectors, axis=1)
    offset = corners.mean(axis=1) - how.place
    beside = np.linalg.norm(offset, axis=1) < how.reach + sizes
    near = np.flatnonzero(beside & (vectors @ how.normal > 0.2 * area) & (np.abs(offset @ how.normal) < how.reach + sizes))
    parts = int(np.clip(np.ceil(np.median(sizes[near]) / (SAMPLES * how.scale)), 1, FINEST))
    inner = _middles(parts)
    return (
        np.repeat(triangles[near], len(inner), axis=0),
        np.tile(inner, (len(near), 1)),
        np.repeat(area[near] / len(inner), len(inner)),
    )


def _middles(parts: int) -> FloatArray:
    """Return the barycentric centres of a triangle divided into parts² equal ones, shape (parts², 3)."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(parts) for j in range(parts - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(parts - 1) for j in range(parts - 1 - i)]
    b, c = np.array(up + down).T / parts
    return np.stack([1.0 - b - c, b, c], axis=1)


def _approach(gap: FloatArray, area: FloatArray, wanted: float) -> float:
    """Return δ at which Σ (δ − g) A / a = wanted [m²], by bisection."""

    def carried(delta: float) -> float:
        touched = gap < delta
        return float(((delta - gap[touched]) * area[touched]).sum() / max(np.sqrt(area[touched].sum() / np.pi), 1e-30))

    low, high = 0.0, 1e-7
    while carried(high) < wanted and high < 1.0:
        low, high = high, 2.0 * high
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if carried(middle) < wanted else (low, middle)
    return high
