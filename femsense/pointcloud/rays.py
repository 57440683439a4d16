"""Ray casting: the distance of a measured point from the face that its own ray hits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.pointcloud.casting import rays_through

GRAZING = 0.25
"""Minimum |cos| of incidence. Grazing rays carry little information and are wrong at silhouettes, where the next pixel misses the
surface."""


@dataclass(frozen=True, eq=False, slots=True)
class SurfaceHits:
    """Hits of rays on a surface, and the distances of the measured points."""

    index: IntArray
    """Indices of the measured points, ascending, shape (r,)."""
    nodes: IntArray
    """Nodes of the triangle that is hit, shape (r, 3)."""
    weights: FloatArray
    """Barycentric coordinates there, shape (r, 3)."""
    normal: FloatArray
    """Outward unit normal of the triangle, shape (r, 3)."""
    distance: FloatArray
    """Distance of the measured point from the plane of the triangle, > 0 outside [m], shape (r,)."""
    cosine: FloatArray
    """|cos| between ray and normal, shape (r,)."""

    def place(self, positions: FloatArray) -> FloatArray:
        """Return the hit points for node positions (n, 3) [m], shape (r, 3)."""
        return np.asarray(np.einsum("ri,ric->rc", self.weights, positions[self.nodes]))

    def pick(self, which: BoolArray) -> SurfaceHits:
        """Return the hits selected by a mask (r,)."""
        return SurfaceHits(
            self.index[which],
            self.nodes[which],
            self.weights[which],
            self.normal[which],
            self.distance[which],
            self.cosine[which],
        )


class Surface:
    """A triangulated surface, for ray casting and closest points."""

    def __init__(self, positions: FloatArray, triangles: IntArray) -> None:
        """positions: nodes [m], shape (n, 3); triangles: outward, shape (t, 3)."""
        self.positions, self.triangles = positions, triangles

    @cached_property
    def _scene(self):  # type: ignore[no-untyped-def]
        """Open3D's scene, whose bounding volumes take a millisecond to build."""
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(_tensor(self.positions), o3d.core.Tensor(np.ascontiguousarray(self.triangles, dtype=np.uint32)))
        return scene

    def cast(self, points: FloatArray, origins: FloatArray, *, reach: float) -> SurfaceHits:
        """Return the hits of the rays through measured points.

        Arguments:
            points: measured [m], shape (k, 3).
            origins: centre of the camera of each point [m], shape (k, 3).
            reach: maximum distance of a point from the hit face along its normal [m]. Points farther away, and grazing rays, are not hits.
        """
        rays = points - origins
        ray = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        answer = self._scene.cast_rays(_tensor(np.hstack([origins, ray])))
        hit = np.flatnonzero(np.isfinite(answer["t_hit"].numpy()))
        triangle, uv = answer["primitive_ids"].numpy()[hit], answer["primitive_uvs"].numpy()[hit].astype(np.float64)
        hits = self._hits(hit, triangle.astype(np.int64), uv, points, ray)
        return hits.pick((np.abs(hits.distance) <= reach) & (hits.cosine >= GRAZING))

    def beside_rays(self, points: FloatArray, origin: FloatArray, *, within: float) -> tuple[FloatArray, FloatArray]:
        """Return the distance at which the rays of a camera through points (k, 3) pass the surface [m], 0 for a hit, and the distance of
        that passage behind each point [m]; both of shape (k,), inf beyond an angle `within` [rad].

        Arguments:
            origin: centre of the camera [m], shape (3,).
        """
        if not len(points):
            return np.zeros(0), np.zeros(0)
        met, _, along = rays_through(points, origin).cast(self.positions, self.triangles)
        passes, missed = np.zeros(len(points)), np.flatnonzero(met < 0)
        if len(missed):
            rays = rays_through(points[missed], origin)
            passes[missed], along[missed] = rays.beside(self.positions, self.triangles, within=within)
        return passes, along - np.linalg.norm(points - origin, axis=1)

    def gap(self, points: FloatArray) -> FloatArray:
        """Return the unsigned distance of points (k, 3) from the surface [m], shape (k,)."""
        return np.asarray(self._scene.compute_distance(_tensor(points)).numpy(), dtype=np.float64)

    def signed_gap(self, points: FloatArray, *, within: float) -> FloatArray:
        """Return the signed distance of points (k, 3) from the surface [m], shape (k,): < 0 inside; beyond `within` always > 0."""
        gap = self.gap(points)
        near = np.flatnonzero(gap < within)
        inside = near[self._scene.compute_occupancy(_tensor(points[near])).numpy() > 0.5]
        gap[inside] *= -1.0
        return gap

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
        """Return the closest points (k, 3) [m], signed distances (k,) > 0 outside [m],
        their triangles (k,) and barycentric weights (k, 3)."""
        place, gap, triangle, weights = self.closest_points(points)
        inside = self._scene.compute_occupancy(_tensor(points)).numpy() > 0.5
        return place, np.where(inside, -gap, gap), triangle, weights

    def closest_points(self, points: FloatArray) -> tuple[FloatArray, FloatArray, IntArray, FloatArray]:
        """Return the closest points (k, 3) [m], distances (k,) [m], their triangles (k,) and barycentric weights (k, 3)."""
        answer = self._scene.compute_closest_points(_tensor(points))
        triangle, uv = answer["primitive_ids"].numpy().astype(np.int64), answer["primitive_uvs"].numpy().astype(np.float64)
        weights = np.column_stack([1.0 - uv.sum(axis=1), uv])
        place = np.einsum("ri,ric->rc", weights, self.positions[self.triangles[triangle]])
        return place, np.linalg.norm(points - place, axis=1), triangle, weights

    def _hits(self, index: IntArray, triangle: IntArray, uv: FloatArray, points: FloatArray, ray: FloatArray) -> SurfaceHits:
        nodes = self.triangles[triangle]
        a, b, c = (self.positions[nodes[:, i]] for i in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        distance = np.einsum("rc,rc->r", points[index] - a, normal)
        cosine = np.abs(np.einsum("rc,rc->r", ray[index], normal))
        weights = np.column_stack([1.0 - uv.sum(axis=1), uv])
        return SurfaceHits(index, nodes, weights, normal, distance, cosine)


def _tensor(values: FloatArray):  # type: ignore[no-untyped-def]
    import open3d as o3d

    return o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))
