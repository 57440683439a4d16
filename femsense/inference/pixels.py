"""Pixels of depth cameras as residual rows on a deformed surface.

The ray from the camera through a measured point meets the surface; the residual is the distance of the point from the face that is met, along its normal, and
σ the noise along the ray times the cosine of incidence. A pixel whose ray misses or grazes the surface, or lies far in front of what its ray meets,
takes the closest point of the surface where that is nearer in standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from femsense.core.arrays import FloatArray, IntArray, freeze, read_only
from femsense.fem.closest_point import closest_on_surface
from femsense.inference.error_field import ErrorField
from femsense.inference.mixture import Others
from femsense.inference.rows import Rows
from femsense.pointcloud.casting import Rays, rays_through
from femsense.pointcloud.rays import Surface

GRAZING = 0.25
"""Minimum cosine of incidence of a hit: below it, cameras interpolate depth across the silhouette."""
FAR = 6.0
"""Pixels in front of the surface by more than this many σ are compared with its closest point."""
ANCHORED = 30.0
"""Pixels farther from the surface than this many σ keep their closest point from an earlier state: they do not belong to the robot."""
FEW = 400
"""Number of points up to which all triangles are compared; for more, bounding volumes are built."""
ON_SURFACE = 1e-5
"""Distance below which the normal of the face is used as direction to the closest point [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Anchors:
    """Closest points of a body in one state, which pixels far from it keep."""

    positions: FloatArray
    """Nodes of the state [m], shape (n, 3)."""
    triangle: IntArray
    """Triangle of the closest point of each pixel, shape (m,)."""
    weights: FloatArray
    """Barycentric coordinates of that point, shape (m, 3)."""
    gap: FloatArray
    """Its distance [m], shape (m,)."""


@dataclass(frozen=True, eq=False, slots=True)
class Pixels:
    """Measured points of one frame that may belong to the robot; the same for all hypotheses."""

    points: FloatArray
    """Points in the robot frame [m], shape (m, 3)."""
    origins: FloatArray
    """Centre of the camera of each [m], shape (m, 3)."""
    view: IntArray
    """Camera of each, shape (m,)."""
    ray_std: FloatArray
    """Noise along the ray [m], shape (m,)."""
    others: Others
    """Odds that a pixel shows another object."""
    share: float
    """1/T: how many independent measurements a pixel counts for."""
    coloured: bool
    """Whether colour separates the robot from the rest."""
    anchors: Anchors | None = None
    rays: tuple[tuple[IntArray, Rays], ...] = field(init=False)
    """For each camera, the indices of its points, and their rays."""
    ways: FloatArray = field(init=False)
    """Unit directions of the rays, shape (m, 3)."""

    def __post_init__(self) -> None:
        own = [np.flatnonzero(self.view == view) for view in np.unique(self.view)]
        rays = tuple((index, rays_through(self.points[index], self.origins[index[0]])) for index in own)
        ways = self.points - self.origins
        object.__setattr__(self, "rays", rays)
        object.__setattr__(self, "ways", freeze(ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)))

    def anchored(self, skin: Skin, positions: FloatArray) -> Pixels:
        """Return the pixels with fixed closest points for those far from the body in a state, nodes (n, 3) [m]. These change too little to
        be recomputed in each state."""
        return replace(self, anchors=Anchors(positions, *closest_points(positions, skin.triangles, self.points)))


@dataclass(frozen=True, eq=False, slots=True)
class Skin:
    """The surface of the body, to which pixels are compared."""

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
    m, positions, triangles = len(pixels.points), read_only(positions), read_only(skin.triangles)
    residual, std, direction, on = np.empty(m), np.empty(m), np.empty((m, 3)), np.empty(m, dtype=np.bool_)
    triangle, weights = np.empty(m, dtype=np.int64), np.empty((m, 3))
    for index, rays in pixels.rays:
        triangle[index], weights[index], _ = rays.cast(positions, triangles)
    points, noise = read_only(pixels.points), read_only(pixels.ray_std)
    _along_rays(positions, triangles, points, read_only(pixels.ways), noise, triangle, residual, std, direction, on)
    far = np.flatnonzero(~on | (residual > FAR * std))
    if len(far):
        found, at, gap = _closest_points(pixels, far, positions, triangles)
        _closest(positions, triangles, points, noise, far, found, at, gap, residual, std, weights, direction, triangle, on)
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


def closest_points(positions: FloatArray, triangles: IntArray, points: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the closest triangle of each point (k, 3), shape (k,), the barycentric weights there, shape (k, 3), and the distance [m],
    shape (k,)."""
    k = len(points)
    triangle, weights, gap = np.empty(k, dtype=np.int64), np.empty((k, 3)), np.empty(k)
    if k <= FEW:
        closest_on_surface(read_only(positions), read_only(triangles), read_only(points), triangle, weights, gap)
    else:
        _, gap, triangle, weights = Surface(positions, triangles).closest_points(points)
    return triangle, weights, gap


def _closest_points(pixels: Pixels, far: IntArray, x: FloatArray, triangles: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return triangle, barycentric weights and distance [m] of the surface points closest to some pixels (k,); for anchored pixels those of
    their anchors."""
    anchors = pixels.anchors
    if anchors is None:
        return closest_points(x, triangles, pixels.points[far])
    moved = float(np.linalg.norm(x - anchors.positions, axis=1).max())
    found, at, gap = anchors.triangle[far], anchors.weights[far], np.empty(len(far))
    near = np.flatnonzero(anchors.gap[far] - moved <= ANCHORED * pixels.ray_std[far])
    found[near], at[near], _ = closest_points(x, triangles, pixels.points[far[near]])
    _distances(x, triangles, read_only(pixels.points), far, found, at, gap)
    return found, at, gap


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
        triangle, weights: points of the surface, shapes (r,) and (r, 3).
        direction, residual, std, log_other, share: the attributes of `Rows` with these names, one value per row.
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
def _along_rays(x, triangles, points, ways, ray_std, triangle, residual, std, direction, on):  # type: ignore[no-untyped-def]
    normal = np.empty(3)
    for j in range(len(points)):
        residual[j], std[j], on[j] = np.inf, ray_std[j], False
        if triangle[j] < 0:
            triangle[j] = 0
            continue
        cosine = _normal_of(x, triangles[triangle[j]], ways[j], normal)
        if abs(cosine) < GRAZING:
            continue
        a = triangles[triangle[j], 0]
        gap = 0.0
        for c in range(3):
            gap += (points[j, c] - x[a, c]) * normal[c]
            direction[j, c] = normal[c]
        residual[j], std[j], on[j] = gap, ray_std[j] * abs(cosine), True


@njit(cache=True)
def _closest(x, triangles, points, ray_std, far, found, at, gap, residual, std, weights, direction, triangle, on):  # type: ignore[no-untyped-def]
    normal, off = np.empty(3), np.empty(3)
    for q in range(len(far)):
        j = far[q]
        if on[j] and gap[q] / ray_std[j] >= residual[j] / std[j]:
            continue
        corners = triangles[found[q]]
        for c in range(3):
            off[c] = points[j, c] - (at[q, 0] * x[corners[0], c] + at[q, 1] * x[corners[1], c] + at[q, 2] * x[corners[2], c])
        side = -1.0 if _normal_of(x, corners, off, normal) < 0.0 else 1.0
        for c in range(3):
            direction[j, c] = side * off[c] / gap[q] if gap[q] > ON_SURFACE else normal[c]
            weights[j, c] = at[q, c]
        residual[j], std[j], triangle[j], on[j] = side * gap[q], ray_std[j], found[q], False


@njit(cache=True)
def _distances(x, triangles, points, far, found, at, gap):  # type: ignore[no-untyped-def]
    for q in range(len(far)):
        corners, total = triangles[found[q]], 0.0
        for c in range(3):
            place = at[q, 0] * x[corners[0], c] + at[q, 1] * x[corners[1], c] + at[q, 2] * x[corners[2], c]
            total += (points[far[q], c] - place) ** 2
        gap[q] = np.sqrt(total)


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
