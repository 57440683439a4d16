# mypy: allow-untyped-decorators
"""Ray casting onto a deforming surface: triangles are projected onto the image plane, where the rays are sorted into cells.

A bounding volume hierarchy (Embree) would have to be rebuilt for each state of the body, and would be queried only once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, read_only
from femsense.core.kernels import njit

PER_CELL = 2.0
"""Average number of rays per cell of the image plane."""


@dataclass(frozen=True, eq=False, slots=True)
class Rays:
    """Rays from one centre through points, sorted by cells of a plane normal to their mean direction."""

    origin: FloatArray
    """Centre of the camera [m], shape (3,)."""
    basis: FloatArray
    """Rows: two directions of the plane, then the mean direction, shape (3, 3)."""
    uv: FloatArray
    """Intersection of each ray with the plane at distance 1, shape (k, 2)."""
    order: IntArray
    """Rays by cell, shape (k,)."""
    starts: IntArray
    """Start of each cell in `order`, row by row, and the length of `order`, shape (rows · columns + 1,)."""
    corner: FloatArray
    """Corner of the first cell, shape (2,)."""
    cell: float
    """Side of a cell [1]."""
    columns: int
    """Number of cells in a row."""

    def cast(self, positions: FloatArray, triangles: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the first triangle that each ray hits, shape (k,), −1 for a miss; the barycentric weights of the hit, shape (k, 3); and
        its distance from the centre [m], shape (k,), inf for a miss.

        Arguments:
            positions: nodes [m], shape (n, 3).
            triangles: (t, 3).
        """
        k = len(self.uv)
        met, weights, depth = np.full(k, -1, dtype=np.int64), np.zeros((k, 3)), np.full(k, np.inf)
        _cast(self._seen(positions), read_only(triangles), *self._cells(), met, weights, depth)
        return met, weights, depth * np.sqrt(1.0 + (self.uv**2).sum(axis=1))

    def beside(self, positions: FloatArray, triangles: IntArray, *, within: float) -> tuple[FloatArray, FloatArray]:
        """Return the distance at which rays pass a surface that they miss [m], inf beyond an angle `within` [rad], and the distance of that
        point from the centre [m], both of shape (k,). Triangles that are partly behind the camera are ignored.
        """
        k = len(self.uv)
        passes, depth = np.full(k, np.inf), np.full(k, np.inf)
        _beside(self._seen(positions), read_only(triangles), *self._cells(), within, passes, depth)
        return passes, depth * np.sqrt(1.0 + (self.uv**2).sum(axis=1))

    def _seen(self, positions: FloatArray) -> FloatArray:
        """Return nodes in the axes of the plane and its normal [m], shape (n, 3)."""
        return np.asarray((positions - self.origin) @ self.basis.T)

    def _cells(self) -> tuple[FloatArray, IntArray, IntArray, FloatArray, float, int]:
        return self.uv, self.order, self.starts, self.corner, self.cell, self.columns


def rays_through(points: FloatArray, origin: FloatArray) -> Rays:
    """Return the rays from a centre (3,) through points (k, 3) [m], k > 0."""
    ways = points - origin
    mean = ways.sum(axis=0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-300)
    across = np.cross(mean, np.eye(3)[np.argmin(np.abs(mean))])
    across = across / np.linalg.norm(across)
    basis = np.stack([across, np.cross(mean, across), mean])
    seen = ways @ basis.T
    uv = seen[:, :2] / np.maximum(seen[:, 2:], 1e-12)
    corner, extent = uv.min(axis=0), np.ptp(uv, axis=0)
    cell = max(float(np.sqrt(extent.prod() * PER_CELL / len(uv))), float(extent.max()) / len(uv), 1e-9)
    columns, rows = (int(side / cell) + 1 for side in extent)
    at = np.minimum(((uv - corner) / cell).astype(np.int64), [columns - 1, rows - 1])
    key = at[:, 1] * columns + at[:, 0]
    starts = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=rows * columns))])
    return Rays(np.array(origin), basis, uv, np.argsort(key, kind="stable"), starts, corner, cell, columns)


@njit(cache=True)
def _span(low, high, corner, cell, count):  # type: ignore[no-untyped-def]
    """Return the first and the last cell along an axis that an interval intersects; without one, the last is smaller than the first."""
    first, last = np.floor((low - corner) / cell), np.floor((high - corner) / cell)
    return int(min(max(first, 0.0), count)), int(max(min(last, count - 1.0), -1.0))


@njit(cache=True)
def _cast(seen, triangles, uv, order, starts, corner, cell, columns, met, weights, depth):  # type: ignore[no-untyped-def]
    rows = (len(starts) - 1) // columns
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        if min(seen[i, 2], seen[j, 2], seen[k, 2]) <= 0.0:
            if max(seen[i, 2], seen[j, 2], seen[k, 2]) > 0.0:
                _cast_in_space(seen[i], seen[j], seen[k], t, uv, met, weights, depth)
            continue
        au, av, bu, bv = seen[i, 0] / seen[i, 2], seen[i, 1] / seen[i, 2], seen[j, 0] / seen[j, 2], seen[j, 1] / seen[j, 2]
        cu, cv = seen[k, 0] / seen[k, 2], seen[k, 1] / seen[k, 2]
        area = (bu - au) * (cv - av) - (bv - av) * (cu - au)
        if area == 0.0:
            continue
        left, right = _span(min(au, bu, cu), max(au, bu, cu), corner[0], cell, columns)
        low, high = _span(min(av, bv, cv), max(av, bv, cv), corner[1], cell, rows)
        if left > right:
            continue
        for row in range(low, high + 1):
            for s in range(starts[row * columns + left], starts[row * columns + right + 1]):
                r = order[s]
                u, v = uv[r, 0], uv[r, 1]
                a = ((bu - u) * (cv - v) - (bv - v) * (cu - u)) / area
                b = ((cu - u) * (av - v) - (cv - v) * (au - u)) / area
                if a < -1e-9 or b < -1e-9 or a + b > 1.0 + 1e-9:
                    continue
                a, b, c = a / seen[i, 2], b / seen[j, 2], (1.0 - a - b) / seen[k, 2]  # 1/depth is linear in the image
                here = 1.0 / (a + b + c)
                if here < depth[r]:
                    depth[r], met[r] = here, t
                    weights[r, 0], weights[r, 1], weights[r, 2] = a * here, b * here, c * here


@njit(cache=True)
def _cast_in_space(a, b, c, t, uv, met, weights, depth):  # type: ignore[no-untyped-def]
    """Cast all rays on a triangle that is partly behind the camera (Möller and Trumbore 1997)."""
    p, q = b - a, c - a
    for r in range(len(uv)):
        u, v = uv[r, 0], uv[r, 1]
        hx, hy, hz = v * q[2] - q[1], q[0] - u * q[2], u * q[1] - v * q[0]
        det = p[0] * hx + p[1] * hy + p[2] * hz
        if det == 0.0:
            continue
        second = -(a[0] * hx + a[1] * hy + a[2] * hz) / det
        gx, gy, gz = a[2] * p[1] - a[1] * p[2], a[0] * p[2] - a[2] * p[0], a[1] * p[0] - a[0] * p[1]
        third = (u * gx + v * gy + gz) / det
        here = (q[0] * gx + q[1] * gy + q[2] * gz) / det
        if second >= -1e-9 and third >= -1e-9 and second + third <= 1.0 + 1e-9 and 0.0 < here < depth[r]:
            depth[r], met[r] = here, t
            weights[r, 0], weights[r, 1], weights[r, 2] = 1.0 - second - third, second, third


@njit(cache=True)
def _beside(seen, triangles, uv, order, starts, corner, cell, columns, reach, passes, depth):  # type: ignore[no-untyped-def]
    rows = (len(starts) - 1) // columns
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        if min(seen[i, 2], seen[j, 2], seen[k, 2]) <= 0.0:
            continue
        us = seen[i, 0] / seen[i, 2], seen[j, 0] / seen[j, 2], seen[k, 0] / seen[k, 2]
        vs = seen[i, 1] / seen[i, 2], seen[j, 1] / seen[j, 2], seen[k, 1] / seen[k, 2]
        left, right = _span(min(us) - reach, max(us) + reach, corner[0], cell, columns)
        low, high = _span(min(vs) - reach, max(vs) + reach, corner[1], cell, rows)
        if left > right:
            continue
        for row in range(low, high + 1):
            for s in range(starts[row * columns + left], starts[row * columns + right + 1]):
                r = order[s]
                for side in range(3):
                    p, q = side, (side + 1) % 3
                    du, dv, ru, rv = us[q] - us[p], vs[q] - vs[p], uv[r, 0] - us[p], uv[r, 1] - vs[p]
                    square = du * du + dv * dv
                    along = min(max((ru * du + rv * dv) / square, 0.0), 1.0) if square > 0.0 else 0.0
                    off = np.sqrt((ru - along * du) ** 2 + (rv - along * dv) ** 2)
                    here = 1.0 / ((1.0 - along) / seen[triangles[t, p], 2] + along / seen[triangles[t, q], 2])
                    if off < reach and off * here < passes[r]:  # the smallest distance is that in space, not in the image
                        passes[r], depth[r] = off * here, here
