"""Pixels of depth cameras as residual rows on a deformed surface.

The ray from the camera through a measured point meets the surface; the residual is the distance of the point from the face that is met, along its normal, and
σ the noise along the ray times the cosine of incidence. A pixel whose ray misses or grazes the surface, or lies far in front of what its ray meets,
takes the closest point of the surface where that is nearer in standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from femsense.core.arrays import FloatArray, IntArray, read_only
from femsense.inference.error_field import ErrorField
from femsense.inference.mixture import Others
from femsense.inference.rows import Rows

GRAZING = 0.25
"""Rays with a smaller cosine of incidence pass for misses: there depth is interpolated across the silhouette."""
FAR = 6.0
"""Pixels in front of the surface by more than this many σ are compared with its closest point."""
ON_SURFACE = 1e-5
"""Nearer than this the direction to the closest point is the face's normal [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Pixels:
    """Measured points of one frame that may show the robot, the same for all hypotheses."""

    points: FloatArray
    """Robot frame [m], shape (m, 3)."""
    origins: FloatArray
    """Centre of the camera of each [m], shape (m, 3)."""
    view: IntArray
    """Camera of each, shape (m,)."""
    ray_std: FloatArray
    """Noise along the ray [m], shape (m,)."""
    others: Others
    """Odds that it shows something else."""
    share: float
    """1/T: how many independent measurements a pixel counts for."""
    coloured: bool
    """Whether colour separates the robot from the rest."""


@dataclass(frozen=True, eq=False, slots=True)
class Skin:
    """What of the body pixels are compared with."""

    triangles: IntArray
    """Outward, shape (t, 3)."""
    rest: FloatArray
    """Nodes at rest [m], shape (n, 3)."""
    facing: FloatArray
    """Unit normals of the triangles at rest, shape (t, 3)."""
    field: ErrorField
    pivot: FloatArray
    """Point about which pose steps turn [m], shape (3,)."""
    size: float
    """Diagonal of the body [m]."""


def pixel_rows(pixels: Pixels, skin: Skin, positions: FloatArray, views: int) -> Rows:
    """Return the rows of a frame at a state, node positions (n, 3) [m]."""
    import open3d as o3d

    def tensor(values: FloatArray):  # type: ignore[no-untyped-def]
        return o3d.core.Tensor(np.ascontiguousarray(values, dtype=np.float32))

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(tensor(positions), o3d.core.Tensor(np.ascontiguousarray(skin.triangles, dtype=np.uint32)))
    rays = pixels.points - pixels.origins
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    answer = scene.cast_rays(tensor(np.hstack([pixels.origins, rays])))
    m = len(rays)
    residual, std, weights, direction = np.empty(m), np.empty(m), np.empty((m, 3)), np.empty((m, 3))
    triangle, on = answer["primitive_ids"].numpy().astype(np.int64), np.empty(m, dtype=np.bool_)
    positions = read_only(positions)
    _along_rays(
        positions,
        read_only(skin.triangles),
        pixels.points,
        rays,
        pixels.ray_std,
        triangle,
        answer["primitive_uvs"].numpy(),
        residual,
        std,
        weights,
        direction,
        on,
    )
    far = np.flatnonzero(~on | (residual > FAR * std))
    if len(far):
        close = scene.compute_closest_points(tensor(pixels.points[far]))
        _closest(
            positions,
            read_only(skin.triangles),
            pixels.points,
            pixels.ray_std,
            far,
            close["primitive_ids"].numpy().astype(np.int64),
            close["primitive_uvs"].numpy(),
            residual,
            std,
            weights,
            direction,
            triangle,
            on,
        )
    other = pixels.others.log_odds(pixels.ray_std, skin.size, on & (residual < 0.0))
    return rows_on(
        skin,
        positions,
        triangle,
        weights,
        direction,
        residual,
        std,
        other,
        np.full(m, pixels.share),
        pixels.points,
        pixels.view,
        views,
        pixel=True,
    )


def rows_on(
    skin: Skin,
    positions: FloatArray,
    triangle: IntArray,
    weights: FloatArray,
    direction: FloatArray,
    residual: FloatArray,
    std: FloatArray,
    log_other: FloatArray,
    share: FloatArray,
    points: FloatArray,
    view: IntArray,
    views: int,
    *,
    pixel: bool,
) -> Rows:
    """Return rows at points of the surface, with the derivatives by pose and field.

    Arguments:
        triangle, weights: where on the surface, shapes (r,) and (r, 3).
        direction, residual, std, log_other, share: as in `Rows`.
        points: measured [m], shape (r, 3); view: their cameras, shape (r,).
    """
    nodes = skin.triangles[triangle]
    rest = np.einsum("ri,ric->rc", weights, skin.rest[nodes])
    way = np.linalg.norm(np.einsum("ri,ric->rc", weights, positions[nodes]) - rest, axis=1)
    by_pose = np.zeros((len(residual), views, 6))
    by_pose[np.arange(len(residual)), view] = np.hstack([np.cross(points - skin.pivot, direction), direction])
    field = skin.field.weights(rest, skin.facing[triangle])
    return Rows(
        residual,
        std,
        log_other,
        share,
        nodes,
        weights,
        direction,
        by_pose.reshape(len(residual), -1),
        field,
        np.eye(views)[view],
        way,
        rest,
        np.full(len(residual), pixel),
    )


@njit(cache=True)
def _along_rays(x, triangles, points, rays, ray_std, triangle, uv, residual, std, weights, direction, on):  # type: ignore[no-untyped-def]
    normal = np.empty(3)
    for j in range(len(points)):
        residual[j], std[j], on[j] = np.inf, ray_std[j], False
        if triangle[j] >= len(triangles):  # Open3D's mark of a miss
            triangle[j] = 0
            continue
        cosine = _normal_of(x, triangles[triangle[j]], rays[j], normal)
        weights[j, 0], weights[j, 1], weights[j, 2] = 1.0 - uv[j, 0] - uv[j, 1], uv[j, 0], uv[j, 1]
        if abs(cosine) < GRAZING:
            continue
        a = triangles[triangle[j], 0]
        gap = 0.0
        for c in range(3):
            gap += (points[j, c] - x[a, c]) * normal[c]
            direction[j, c] = normal[c]
        residual[j], std[j], on[j] = gap, ray_std[j] * abs(cosine), True


@njit(cache=True)
def _closest(x, triangles, points, ray_std, far, found, uv, residual, std, weights, direction, triangle, on):  # type: ignore[no-untyped-def]
    normal, off = np.empty(3), np.empty(3)
    for q in range(len(far)):
        j = far[q]
        u, v = np.float64(uv[q, 0]), np.float64(uv[q, 1])
        w = (1.0 - u - v, u, v)
        corners = triangles[found[q]]
        gap = 0.0
        for c in range(3):
            off[c] = points[j, c] - (w[0] * x[corners[0], c] + w[1] * x[corners[1], c] + w[2] * x[corners[2], c])
            gap += off[c] ** 2
        gap = np.sqrt(gap)
        if on[j] and gap / ray_std[j] >= residual[j] / std[j]:
            continue
        side = -1.0 if _normal_of(x, corners, off, normal) < 0.0 else 1.0
        for c in range(3):
            direction[j, c] = side * off[c] / gap if gap > ON_SURFACE else normal[c]
            weights[j, c] = w[c]
        residual[j], std[j], triangle[j], on[j] = side * gap, ray_std[j], found[q], False


@njit(cache=True)
def _normal_of(x, corners, along, normal):  # type: ignore[no-untyped-def]
    """Write the unit normal of a triangle and return its product with a vector."""
    a, b, c = corners[0], corners[1], corners[2]
    u0, u1, u2 = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    v0, v1, v2 = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
    normal[0], normal[1], normal[2] = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    length = max(np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2), 1e-300)
    total = 0.0
    for k in range(3):
        normal[k] /= length
        total += normal[k] * along[k]
    return total
