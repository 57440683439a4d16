# mypy: allow-untyped-decorators
"""Tetrahedral meshes: linear (4 nodes) and quadratic (10 nodes), their surface and points embedded in them.

Nodes of an element are ordered as in VTK: corners 0 1 2 3, then the middles of the edges 01 12 02 03 13 23.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import chain
from typing import Any

import numpy as np
import scipy.sparse as sp

from femsense.core.arrays import FloatArray, IntArray, as_points, freeze, read_only
from femsense.core.errors import InputError
from femsense.fem.closest_point import FACES, carry, drawn_to_faces, feet, keep_deepest, may_hold
from femsense.fem.normals import area_vectors, unit_sums

EDGES = np.array([[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]])
FACE_EDGES = np.array([[1, 5, 4], [3, 5, 2], [0, 4, 3], [2, 1, 0]])  # middle of each side of a face: (ab, bc, ca)


@dataclass(frozen=True, eq=False, slots=True)
class TetMesh:
    """A mesh of tetrahedra at rest, with n nodes and m elements."""

    nodes: FloatArray
    """Node positions [m], shape (n, 3): those of the linear mesh first, then the mid-edge nodes."""
    tets: IntArray
    """Node indices of each element, shape (m, 4) for linear or (m, 10) for quadratic elements."""
    reach: float = field(init=False)
    """Longest side of the bounding box of the mesh [m]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", freeze(as_points(self.nodes, "nodes")))
        object.__setattr__(self, "reach", float(np.ptp(self.nodes, axis=0).max()) if len(self.nodes) else 0.0)
        object.__setattr__(self, "tets", freeze(self.tets, np.int64))
        if self.tets.ndim != 2 or self.tets.shape[1] not in (4, 10):
            raise InputError("tets has the wrong shape", where="tets", found=self.tets.shape, expected="(m, 4) or (m, 10)")
        if self.tets.size and (self.tets.min() < 0 or self.tets.max() >= len(self.nodes)):
            raise InputError(
                "tets names a node that does not exist",
                where="tets",
                found=int(self.tets.max()),
                expected=f"0 … {len(self.nodes) - 1}",
            )

    @property
    def is_quadratic(self) -> bool:
        return bool(self.tets.shape[1] == 10)


@dataclass(frozen=True, eq=False, slots=True)
class Embedding:
    """Points carried by a mesh: point = Σ weights · nodes."""

    nodes: IntArray
    """Node indices, shape (p, k)."""
    weights: FloatArray
    """Weights, shape (p, k); each row sums to 1, or to the share by which a point follows."""
    element: IntArray
    """The element that carries each point, shape (p,)."""
    outside: FloatArray
    """How far outside of the mesh each point is at rest [m], shape (p,); 0 inside."""
    still: FloatArray | None = None
    """The fixed part of each point [m], shape (p, 3); None: points follow the mesh completely. See `following`."""

    def __len__(self) -> int:
        return len(self.nodes)

    def positions(self, node_positions: FloatArray) -> FloatArray:
        """Return the positions of the points [m], shape (p, 3), for node positions [m], shape (n, 3)."""
        moved = self.moves(node_positions)
        return moved if self.still is None else moved + self.still

    def moves(self, field: FloatArray) -> FloatArray:
        """Return the displacements of the points, shape (p, 3), for displacements of the nodes, shape (n, 3), in the same unit."""
        return np.asarray(np.einsum("pk,pkc->pc", self.weights, field[self.nodes]))

    def following(self, points: FloatArray, share: FloatArray) -> Embedding:
        """Return ties of points [m], shape (p, 3), that follow the mesh by a share only, shape (p,): 1 wholly, 0 not at all."""
        return replace(self, weights=freeze(share[:, None] * self.weights), still=freeze((1.0 - share[:, None]) * points))

    def matrix(self, node_count: int) -> sp.csr_matrix:
        """Return the interpolation as a sparse matrix, shape (p, n)."""
        p, k = self.nodes.shape
        rows = np.repeat(np.arange(p), k)
        return sp.csr_matrix((self.weights.ravel(), (rows, self.nodes.ravel())), shape=(p, node_count))

    def spread(self, forces: FloatArray, node_count: int) -> FloatArray:
        """Return nodal forces [N], shape (n, 3), that are equivalent to forces [N], shape (p, 3), at the points."""
        result = np.zeros((node_count, 3))
        np.add.at(result, self.nodes, self.weights[:, :, None] * forces[:, None, :])
        return result

    def __getitem__(self, index: Any) -> Embedding:
        still = None if self.still is None else np.atleast_2d(self.still[index])
        return Embedding(
            np.atleast_2d(self.nodes[index]),
            np.atleast_2d(self.weights[index]),
            np.atleast_1d(self.element[index]),
            np.atleast_1d(self.outside[index]),
            still,
        )


def element_volumes(mesh: TetMesh) -> FloatArray:
    """Return the signed volumes of the corner tetrahedra [m³], shape (m,)."""
    corners = mesh.nodes[mesh.tets[:, :4]]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0)


def to_quadratic(mesh: TetMesh) -> TetMesh:
    """Return the mesh with nodes in the middle of all edges (unchanged where it has them)."""
    if mesh.is_quadratic:
        return mesh
    edges = np.sort(mesh.tets[:, EDGES].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = mesh.nodes[unique].mean(axis=1)
    tets = np.hstack([mesh.tets, len(mesh.nodes) + inverse.reshape(-1, 6)])
    return TetMesh(np.vstack([mesh.nodes, middles]), tets)


def to_linear(mesh: TetMesh) -> TetMesh:
    """Return the mesh of the corner nodes, which keep their numbers if they come first."""
    if not mesh.is_quadratic:
        return mesh
    used = np.unique(mesh.tets[:, :4])
    number = np.full(len(mesh.nodes), -1)
    number[used] = np.arange(len(used))
    return TetMesh(mesh.nodes[used], number[mesh.tets[:, :4]])


def refined(mesh: TetMesh) -> TetMesh:
    """Return the mesh with every tetrahedron split into eight (Bey's rule, shortest inner diagonal)."""
    fine = to_quadratic(to_linear(mesh))
    a, b, c, d, ab, bc, ac, ad, bd, cd = fine.tets.T
    corner = [(a, ab, ac, ad), (ab, b, bc, bd), (ac, bc, c, cd), (ad, bd, cd, d)]
    x = fine.nodes
    diagonals = [((ab, cd), (ac, ad, bd, bc)), ((ac, bd), (ab, bc, cd, ad)), ((ad, bc), (ab, ac, cd, bd))]
    lengths = np.stack([np.linalg.norm(x[p] - x[q], axis=1) for (p, q), _ in diagonals])
    choice = lengths.argmin(axis=0)
    blocks = [np.stack(t, axis=1) for t in corner]
    for k, ((p, q), ring) in enumerate(diagonals):
        pick = choice == k
        blocks += [np.stack([p, q, ring[i], ring[(i + 1) % 4]], axis=1)[pick] for i in range(4)]
    return oriented(TetMesh(x, np.vstack(blocks)))


def oriented(mesh: TetMesh) -> TetMesh:
    """Return the mesh with the node order of inverted tetrahedra mended (all volumes positive)."""
    flip = element_volumes(mesh) < 0
    if not flip.any():
        return mesh
    tets = mesh.tets.copy()
    swap = [0, 2, 1, 3] if tets.shape[1] == 4 else [0, 2, 1, 3, 6, 5, 4, 7, 9, 8]
    # swapping corners 1 and 2 turns the edges 01 12 02 03 13 23 into 02 12 01 03 23 13
    tets[flip] = tets[flip][:, swap]
    return TetMesh(mesh.nodes, tets)


def body_parts(mesh: TetMesh) -> IntArray:
    """Return the number of the connected part that each node belongs to, shape (n,); −1 for unused nodes."""
    n = len(mesh.nodes)
    first = np.repeat(mesh.tets[:, 0], mesh.tets.shape[1] - 1)
    graph = sp.coo_matrix((np.ones(len(first)), (first, mesh.tets[:, 1:].ravel())), shape=(n, n))
    labels = np.asarray(sp.csgraph.connected_components(graph, directed=False)[1], dtype=np.int64)
    used = np.zeros(n, dtype=bool)
    used[mesh.tets] = True
    labels[~used] = -1
    _, labels[used] = np.unique(labels[used], return_inverse=True)
    return labels


def boundary_faces(mesh: TetMesh) -> IntArray:
    """Return the boundary faces, outward from the material, shape (t, 3) or (t, 6): corners, then the middles of ab, bc, ca."""
    faces = mesh.tets[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer = np.sort(first[count == 1])
    if not mesh.is_quadratic:
        return np.asarray(faces[outer])
    middles = mesh.tets[:, 4:][:, FACE_EDGES].reshape(-1, 3)
    return np.hstack([faces[outer], middles[outer]])


def surface_triangles(mesh: TetMesh) -> IntArray:
    """Return the triangles of the boundary, outward, shape (t, 3); a face of a quadratic element gives four."""
    faces = boundary_faces(mesh)
    if not mesh.is_quadratic:
        return faces
    a, b, c, ab, bc, ca = faces.T
    return np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)


def triangle_normals(positions: FloatArray, triangles: IntArray) -> FloatArray:
    """Return area vectors (normal × area) of triangles [m²], shape (t, 3)."""
    vectors = np.empty((len(triangles), 3))
    area_vectors(read_only(np.asarray(positions, np.float64)), read_only(np.asarray(triangles, np.int64)), vectors)
    return vectors


def vertex_normals(positions: FloatArray, triangles: IntArray) -> FloatArray:
    """Return unit normals at all nodes, area weighted, shape (n, 3); zero where a node is in no triangle."""
    normals = np.empty((len(positions), 3))
    unit_sums(read_only(np.asarray(triangles, np.int64)), triangle_normals(positions, triangles), normals)
    return normals


def barycentric(mesh: TetMesh, elements: IntArray, points: FloatArray) -> FloatArray:
    """Return barycentric coordinates of points in elements at rest, shape (p, 4). Raises InputError where one is flat."""
    try:
        return _coordinates(mesh.nodes[mesh.tets[elements, :4]], points)
    except np.linalg.LinAlgError:
        raise InputError("tetrahedra without volume", where="mesh", expected="positive volumes") from None


def _coordinates(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Return barycentric coordinates (p, 4) of points (p, 3) in tetrahedra (p, 4, 3)."""
    edge = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    inner = np.linalg.solve(edge, (points - corners[:, 0])[..., None])[..., 0]
    return np.concatenate([1.0 - inner.sum(axis=1, keepdims=True), inner], axis=1)


def shape_values(barycentric_coordinates: FloatArray, *, quadratic: bool) -> FloatArray:
    """Return the shape functions at barycentric coordinates (p, 4), shape (p, 4) or (p, 10)."""
    L = barycentric_coordinates
    if not quadratic:
        return L
    return np.concatenate([L * (2.0 * L - 1.0), 4.0 * L[:, EDGES[:, 0]] * L[:, EDGES[:, 1]]], axis=1)


def shape_slopes(barycentric_coordinates: FloatArray, *, quadratic: bool) -> FloatArray:
    """Return dN/dL at barycentric coordinates (p, 4), shape (p, 4 or 10, 4)."""
    L = barycentric_coordinates
    p = len(L)
    if not quadratic:
        return np.broadcast_to(np.eye(4), (p, 4, 4)).copy()
    slopes = np.zeros((p, 10, 4))
    corner, edge, (i, j) = np.arange(4), np.arange(4, 10), EDGES.T
    slopes[:, corner, corner] = 4.0 * L - 1.0
    slopes[:, edge, i] = 4.0 * L[:, j]
    slopes[:, edge, j] = 4.0 * L[:, i]
    return slopes


def closest_in_tet(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Return barycentric coordinates (p, 4) of the point of each tetrahedron (p, 4, 3) that is closest to points (p, 3)."""
    best = _coordinates(corners, points)
    if not (best >= 0).all():
        drawn_to_faces(freeze(corners), freeze(points), best)
    return best


def closest_in_triangle(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Return barycentric coordinates (p, 3) of the point of each triangle (p, 3, 3) that is closest to points (p, 3).

    The plane's foot where it is inside, else the best of the three sides (Ericson, Real-Time Collision Detection, 5.1).
    """
    best = np.empty((len(points), 3))
    feet(freeze(corners), freeze(points), best)
    return best


def embed_points(mesh: TetMesh, points: FloatArray, *, outside_rule: str = "nearest_element") -> Embedding:
    """Embed points in a mesh: find the element that contains each point at rest, and its shape functions there.

    An embedded point moves with the deformed mesh. A point outside of the mesh moves with one element, by the first-order expansion of its
    shape functions at the closest point of the element (for linear elements its affine map).

    Arguments:
        mesh: the mesh at rest.
        points: positions at rest [m], shape (p, 3).
        outside_rule: which element carries a point outside: "nearest_element" (by distance to the element; markers)
            or "nearest_centre" (by distance to its centre, SOFA's rule; cables).

    Returns:
        the embedding: element and shape functions of each point, and its distance outside of the mesh.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> body = fs.load_robot("finger").body
        >>> tip = fs.embed_points(body.mesh, np.array([[0.092, 0.0, 0.007]]))
        >>> pulled = fs.solve_equilibrium(body, tension={"flexor": 1.0})
        >>> tip.positions(pulled.positions)[0, [0, 2]].round(3)  # x and z of the deformed tip [m]
        array([0.088, 0.021])
    """
    points = as_points(points)
    elements = _by_centre(mesh)
    centre_distance, element = _nearest_centres(elements, points)
    outside = np.zeros(len(points))
    for first in range(0, len(points), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        free = first + _find_holders(mesh, elements, points[part], element[part])
        if len(free):
            carrier, outside[free] = _carriers_of_outsiders(elements, points[free], centre_distance[free] + elements.reach)
            element[free] = carrier if outside_rule == "nearest_element" else element[free]
    return _tied(mesh, element, points, outside)


def tie_to_elements(mesh: TetMesh, points: FloatArray, element: IntArray) -> Embedding:
    """Tie points [m], shape (p, 3), to given elements, shape (p,),
    by the rule of `embed_points` for points inside and outside of them."""
    corners = mesh.nodes[mesh.tets[element, :4]]
    nearest = np.einsum("pl,plc->pc", closest_in_tet(corners, points), corners)
    return _tied(mesh, element, points, np.linalg.norm(points - nearest, axis=1))


def _tied(mesh: TetMesh, element: IntArray, points: FloatArray, outside: FloatArray) -> Embedding:
    coordinates = barycentric(mesh, element, points)
    at = coordinates.copy()
    drawn_to_faces(freeze(mesh.nodes[mesh.tets[element, :4]]), freeze(points), at)
    weights = shape_values(at, quadratic=mesh.is_quadratic)
    if (at != coordinates).any():
        weights += np.einsum("pkl,pl->pk", shape_slopes(at, quadratic=mesh.is_quadratic), coordinates - at)
    weights[np.abs(weights) < ROUNDING] = 0.0
    return Embedding(mesh.tets[element], weights, element, outside)


def weight_slopes(mesh: TetMesh, ties: Embedding, points: FloatArray) -> FloatArray:
    """Return how the weights of tied points change with their places at rest [1/m], shape (p, k, 3),
    each in the element that carries it."""
    corners = mesh.nodes[mesh.tets[ties.element, :4]]
    slopes = shape_slopes(closest_in_tet(corners, points), quadratic=mesh.is_quadratic)
    by_place = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(
        0, 2, 1
    )  # of the last three barycentric coordinates, which add to one with the first
    by_place = np.concatenate([-by_place.sum(axis=1, keepdims=True), by_place], axis=1)
    return np.asarray(slopes @ by_place)


ROUNDING = 1e-12
"""Smaller weights are rounding errors and become 0. Products of such weights in the stiffness of cables would be denormal numbers, which
processors handle slowly: factors in single precision took twice the time."""
ONE_BY_ONE = 16
"""Number of points up to which a comparison with every centre of an element is faster than importing SciPy's tree."""
AT_ONCE = 4096
"""Number of points that are located together, which limits memory."""


@dataclass(frozen=True, eq=False)
class _Elements:
    """The elements of a mesh, to look up by their centres."""

    corners: FloatArray
    """[m], shape (m, 4, 3)."""
    centres: FloatArray
    """[m], shape (m, 3)."""
    reach: float
    """How far the farthest corner is from its element's centre [m]."""
    size: float
    """Length of the longest side of the box around the mesh [m]."""

    @cached_property
    def tree(self) -> Any:
        """The centres, to look up by place."""
        from scipy.spatial import cKDTree

        return cKDTree(self.centres)


@lru_cache(maxsize=4)
def _by_centre(mesh: TetMesh) -> _Elements:
    corners = mesh.nodes[mesh.tets[:, :4]]
    centres = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centres[:, None], axis=2).max()
    return _Elements(freeze(corners), freeze(centres), float(reach), float(np.ptp(corners, axis=(0, 1)).max()))


def _find_holders(mesh: TetMesh, elements: _Elements, points: FloatArray, element: IntArray) -> IntArray:
    """Write the element that holds each point; return the points that none holds."""
    point, candidate, _ = _pairs(_centres_within(elements, points, np.full(len(points), elements.reach * (1 + 1e-9))))
    may = np.empty(len(point), dtype=bool)
    may_hold(elements.corners, freeze(points), point, candidate, may)
    point, candidate = point[may], candidate[may]
    best = np.full(len(points), -np.inf)
    keep_deepest(point, candidate, barycentric(mesh, candidate, points[point]).min(axis=1), best, element)
    return np.flatnonzero(best == -np.inf)


def _carriers_of_outsiders(elements: _Elements, points: FloatArray, radius: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the element nearest to each point outside of the mesh, and its distance [m]; of equally near elements, the element with the
    nearest centre."""
    _, candidate, start = _pairs(_centres_within(elements, points, radius))
    carrier, outside = np.empty(len(points), dtype=np.int64), np.empty(len(points))
    carry(elements.corners, elements.centres, elements.reach, elements.size, freeze(points), candidate, start, carrier, outside)
    return carrier, outside


def _nearest_centres(elements: _Elements, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distance of the nearest centre of an element from each point [m], shape (p,), and that element, shape (p,)."""
    if len(points) <= ONE_BY_ONE:
        square = [((elements.centres - point) ** 2).sum(axis=1) for point in points]
        nearest = np.array([one.argmin() for one in square], dtype=np.int64)
        return np.sqrt(np.array([one[k] for one, k in zip(square, nearest)], dtype=np.float64)), nearest
    distance, nearest = elements.tree.query(points, k=1)
    return np.asarray(distance, dtype=np.float64), np.asarray(nearest, dtype=np.int64)


def _centres_within(elements: _Elements, points: FloatArray, radius: FloatArray) -> Any:
    """Return for each point the elements whose centres are within its radius [m], shape (p,)."""
    if len(points) <= ONE_BY_ONE:
        square = (((elements.centres - point) ** 2).sum(axis=1) for point in points)
        return [np.flatnonzero(one <= limit**2) for one, limit in zip(square, radius)]
    return elements.tree.query_ball_point(points, radius, return_sorted=False)


def _pairs(found: Any) -> tuple[IntArray, IntArray, IntArray]:
    """Return the pairs (point, candidate) of one list of candidates per point, and where the pairs of each point begin, with the end."""
    count = np.array([len(one) for one in found], dtype=np.int64)
    candidate = np.fromiter(chain.from_iterable(found), np.int64, count.sum())
    return np.repeat(np.arange(len(count)), count), candidate, np.concatenate([[0], np.cumsum(count)])
