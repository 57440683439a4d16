"""Queries on triangle surfaces: winding numbers, intersections, distances, wall thickness."""

from __future__ import annotations

from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.fem.mesh import closest_in_triangle

SIDES_AT_ONCE = 200_000
"""Number of triangle edges tested together for intersections (limits memory)."""


def winding_number(corners: FloatArray, places: FloatArray) -> FloatArray:
    """Return how often triangles (t, 3, 3) wind around places (p, 3): 1 inside an outward surface, 0 outside, shape (p,).

    Sum of solid angles over 4π (van Oosterom and Strackee 1983).
    """
    result = np.empty(len(places))
    for i, place in enumerate(places):
        a, b, c = np.moveaxis(corners - place, 1, 0)
        la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        ab, bc, ca = (np.einsum("tc,tc->t", u, v) for u, v in ((a, b), (b, c), (c, a)))
        result[i] = np.arctan2(np.einsum("tc,tc->t", a, np.cross(b, c)), la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (
            2.0 * np.pi
        )
    return result


def crossing_triangles(points: FloatArray, triangles: IntArray) -> IntArray:
    """Return pairs of triangles of which an edge of the first intersects the second, shape (p, 2).

    Edges are cast as rays (Embree, single precision); mere contact does not count.
    """
    import open3d as o3d

    scaled, scene = _scene(points, triangles)
    edges = directed_edges(triangles)
    rays = np.hstack([scaled[edges[:, 0]], scaled[edges[:, 1]] - scaled[edges[:, 0]]]).astype(np.float32)
    met = np.flatnonzero(scene.test_occlusions(o3d.core.Tensor(rays), tnear=1e-3, tfar=1.0 - 1e-3).numpy())
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for some in (met[i : i + SIDES_AT_ONCE] for i in range(0, len(met), SIDES_AT_ONCE)):
        hits = scene.list_intersections(o3d.core.Tensor(rays[some]))
        ray, other, t = (hits[key].numpy() for key in ("ray_ids", "primitive_ids", "t_hit"))
        ray, other = some[ray.astype(np.int64)], other.astype(np.int64)
        shares = (triangles[other][:, :, None] == edges[ray][:, None, :]).any(axis=(1, 2))
        real = ~shares & (t > 1e-3) & (t < 1 - 1e-3)
        pairs.append(np.stack([ray[real] // 3, other[real]], axis=1))
    return np.asarray(np.unique(np.vstack(pairs), axis=0).reshape(-1, 2))


def distance_to(points: FloatArray, triangles: IntArray, places: FloatArray) -> FloatArray:
    """Return the distance of places (p, 3) from a surface, in its unit, shape (p,)."""
    return np.asarray(np.linalg.norm(places - nearest_on(points, triangles, places), axis=1))


def nearest_on(points: FloatArray, triangles: IntArray, places: FloatArray) -> FloatArray:
    """Return the points of a surface that are nearest to places (p, 3), shape (p, 3).

    The nearest triangle is found in single precision, the point in it in double.
    """
    import open3d as o3d

    centre, size = points.mean(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-300)
    _, scene = _scene(points, triangles)
    nearest = scene.compute_closest_points(o3d.core.Tensor(((places - centre) / size).astype(np.float32)))["primitive_ids"]
    corners = points[triangles[nearest.numpy().astype(np.int64)]]
    return np.asarray(np.einsum("pi,pic->pc", closest_in_triangle(corners, places), corners))


def wall_thickness(points: FloatArray, triangles: IntArray, places: FloatArray, inward: FloatArray) -> FloatArray:
    """Return the distance from points just inside of the surface along unit vectors to the next wall, shape (p,); inf without one."""
    import open3d as o3d

    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    _, scene = _scene(points, triangles)
    start = (places - centre) / size + 1e-4 * inward
    hit = scene.cast_rays(o3d.core.Tensor(np.hstack([start, inward]).astype(np.float32)))["t_hit"].numpy()
    return np.asarray((hit.astype(np.float64) + 1e-4) * size)


def _scene(points: FloatArray, triangles: IntArray) -> tuple[FloatArray, Any]:
    """Return the points scaled to about one around zero, and the triangles as Open3D casts rays into them."""
    import open3d as o3d

    scaled = (points - points.mean(axis=0)) / max(float(np.ptp(points, axis=0).max()), 1e-300)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(scaled.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
    return scaled, scene


def directed_edges(triangles: IntArray) -> IntArray:
    """Return the sides of triangles as they go round, shape (3 t, 2), triangle by triangle."""
    return np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)


def sides(triangles: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Return the sides of triangles (3 t, 2), the number of the edge of each (3 t,), and how many sides each edge has (e,)."""
    ends = directed_edges(triangles)
    _, edge, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    return ends, edge.reshape(-1), count


def open_edges(triangles: IntArray) -> IntArray:
    """Return the sides that only one triangle has, as they go round there, shape (e, 2)."""
    ends, edge, count = sides(triangles)
    return np.asarray(ends[count[edge] == 1])


def neighbours(triangles: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Return pairs of triangles with a side that no third one has, and whether they go round the same way, shapes (p,)."""
    ends, edge, count = sides(triangles)
    order = np.argsort(edge, kind="stable")
    pair = order[count[edge[order]] == 2].reshape(-1, 2)
    alike = ends[pair[:, 0], 0] == ends[pair[:, 1], 1]
    return pair[:, 0] // 3, pair[:, 1] // 3, alike


def place_text(points: FloatArray, place: FloatArray) -> str:
    """Return a place in words, to a millionth of the size of the surface."""
    step = 1e-6 * float(np.ptp(points, axis=0).max())
    return "[" + ", ".join(f"{round(value / step) * step + 0.0:.4g}" for value in place.tolist()) + "]"
