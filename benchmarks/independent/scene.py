"""The deformed surface, the touching objects and the camera's rays (Open3D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from .solid import Array, Solid

ROBOT, OBJECT, TABLE = 0, 1, 2


class Skin:
    """Triangles on the boundary of a `Solid`, two to a side of a facet, carried by the shape functions."""

    def __init__(self, solid: Solid) -> None:
        mesh = solid.mesh
        facets = mesh.boundary_facets()
        cells = mesh.f2t[0, facets]
        corners = np.moveaxis(mesh.p[:, mesh.facets[:, facets]], 0, -1)
        lattice, triangles = _triangle() if corners.shape[0] == 3 else _square(corners)
        places = np.einsum("lc,cfi->fli", lattice, corners)
        count = len(lattice)
        self.solid = solid
        self.rest: Array = places.reshape(-1, 3)
        self.cell = np.repeat(cells, count)
        self.rows = solid.rows_in(self.rest, self.cell)
        tri = (count * np.arange(len(facets))[:, None, None] + triangles).reshape(-1, 3)
        middle = mesh.p[:, mesh.t].mean(axis=1).T[np.repeat(cells, len(triangles))]
        a, b, c = (self.rest[tri[:, k]] for k in range(3))
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - middle) < 0
        tri[inward] = tri[inward][:, [0, 2, 1]]
        self.tri = tri
        self.still = RayScene([(self.rest, tri)])

    def project(self, points: Array) -> tuple[Array, Array, sp.csr_matrix]:
        """Closest points at rest, their outward normals, and their interpolation from the nodes."""
        spot, normal, triangle = self.still.closest(points)
        return spot, normal, self.solid.rows_in(spot, self.cell[self.tri[triangle, 0]])

    def at(self, triangle: Array, uv: Array) -> sp.csr_matrix:
        """Interpolation from the nodes of places on triangles."""
        weight = np.column_stack([1 - uv.sum(axis=1), uv]).ravel()
        where = (np.repeat(np.arange(len(triangle)), 3), self.tri[triangle].ravel())
        return sp.csr_matrix((weight, where), shape=(len(triangle), len(self.rest))) @ self.rows


def _triangle() -> tuple[Array, Array]:
    lattice = np.array([[2, 0, 0], [0, 2, 0], [0, 0, 2], [1, 1, 0], [0, 1, 1], [1, 0, 1]]) / 2
    return lattice, np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])


def _square(corners: Array) -> tuple[Array, Array]:
    """A lattice on four corners, whichever way round they are numbered."""
    opposite = np.argmax([np.linalg.norm(corners[0, 0] - corners[k, 0]) for k in range(4)])
    first, second = (k for k in range(1, 4) if k != opposite)
    lattice = []
    for u in (0, 0.5, 1):
        for v in (0, 0.5, 1):
            weight = np.zeros(4)
            weight[[0, first, second, opposite]] = (1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v
            lattice.append(weight)
    quads = [(3 * i + j, 3 * i + 3 + j, 3 * i + 4 + j, 3 * i + 1 + j) for i in range(2) for j in range(2)]
    return np.array(lattice), np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


class RayScene:
    """Open3D's ray casting over a few meshes."""

    def __init__(self, meshes: list[tuple[Array, Array]]) -> None:
        import open3d as o3d

        self._scene = o3d.t.geometry.RaycastingScene()
        for points, triangles in meshes:
            self._scene.add_triangles(points.astype(np.float32), triangles.astype(np.uint32))

    def cast(self, origin: Array, directions: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Distances (in units of the directions), mesh, triangle, barycentric coordinates and normals of the first hits."""
        rays = np.hstack([np.broadcast_to(origin, directions.shape), directions]).astype(np.float32)
        hit = self._scene.cast_rays(rays)
        names = ("t_hit", "geometry_ids", "primitive_ids", "primitive_uvs", "primitive_normals")
        far, mesh, triangle, uv, normal = (hit[name].numpy() for name in names)
        return far.astype(float), mesh.astype(np.int64), triangle.astype(np.int64), uv.astype(float), normal.astype(float)

    def closest(self, points: Array) -> tuple[Array, Array, Array]:
        """Closest points, normals of their triangles, and the triangles."""
        answer = self._scene.compute_closest_points(np.ascontiguousarray(points, np.float32))
        normal = answer["primitive_normals"].numpy().astype(float)
        return answer["points"].numpy().astype(float), normal, answer["primitive_ids"].numpy().astype(np.int64)


@dataclass(frozen=True, eq=False)
class Shape:
    """A touching object about the origin: it touches there, its body lies along +z, its length along x."""

    kind: str
    radius: float
    """[m] of ball, rod or disc."""
    parts: tuple[tuple[Array, Array], ...]


def shape(kind: str, radius: float) -> Shape:
    """A ball on a stick, a rod that lies across, or a disc on a stick."""
    import open3d as o3d

    make = o3d.geometry.TriangleMesh
    if kind == "ball":
        body = make.create_sphere(radius, 40).translate((0, 0, radius))
        stick = make.create_cylinder(0.002, 0.09, 24).translate((0, 0, 1.8 * radius + 0.045))
        meshes = [body, stick]
    elif kind == "rod":
        rod = make.create_cylinder(radius, 0.15, 48)
        rod.rotate(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), center=(0, 0, 0))
        meshes = [rod.translate((0, 0, radius))]
    else:
        disc = make.create_cylinder(radius, 0.003, 48).translate((0, 0, 0.0015))
        stick = make.create_cylinder(0.002, 0.09, 24).translate((0, 0, 0.047))
        meshes = [disc, stick]
    parts = tuple((np.asarray(m.vertices).copy(), np.asarray(m.triangles).copy()) for m in meshes)
    return Shape(kind, radius, parts)


def posed(item: Shape, place: Array, normal: Array, along: Array) -> list[tuple[Array, Array]]:
    """The object where it touches a place from the side of a normal, its length along a tangent."""
    x = along - normal * (along @ normal)
    x = x / np.linalg.norm(x)
    turn = np.column_stack([x, np.cross(normal, x), normal])
    return [(points @ turn.T + place, triangles) for points, triangles in item.parts]


def table(height: float) -> tuple[Array, Array]:
    """A square metre of table."""
    points = np.array([[-0.5, -0.5, height], [0.5, -0.5, height], [0.5, 0.5, height], [-0.5, 0.5, height]])
    return points, np.array([[0, 1, 2], [0, 2, 3]])
