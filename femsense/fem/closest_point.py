# mypy: allow-untyped-decorators
"""Points of tetrahedra and triangles that are closest to points, and which element holds or carries each point: compiled."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.kernels import njit

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # outward where the volume is positive
ALIKE, ALIKE_CENTRES = 1e-9, 1e-4
"""Two elements (two centres of elements) are equally near to a point if their distances differ by less than this share of the mesh's size.
The first element then carries the point, so that neither rounding nor a step of a derivative by the body's size decides."""
NEARLY = 1e-6
"""Rounding of barycentric coordinates: a point is outside of an element if one of its coordinates is below minus this."""
Vector = tuple[float, float, float]


@njit(cache=True, nogil=True)
def _vector(points: FloatArray, row: int) -> Vector:
    return points[row, 0], points[row, 1], points[row, 2]


@njit(cache=True, nogil=True)
def _minus(u: Vector, v: Vector) -> Vector:
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@njit(cache=True, nogil=True)
def _dot(u: Vector, v: Vector) -> float:
    return u[0] * v[0] + u[2] * v[2] + u[1] * v[1]


@njit(cache=True, nogil=True)
def _triple(u: Vector, v: Vector, w: Vector) -> float:
    return u[0] * (v[1] * w[2] - v[2] * w[1]) + u[1] * (v[2] * w[0] - v[0] * w[2]) + u[2] * (v[0] * w[1] - v[1] * w[0])


@njit(cache=True, nogil=True)
def _length(u: Vector) -> float:
    return float(np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]))


@njit(cache=True, nogil=True)
def _along(a: Vector, b: Vector, point: Vector) -> tuple[float, float]:
    """Return where between a (0) and b (1) a point comes nearest, and how near."""
    side = _minus(b, a)
    square, t = _dot(side, side), 0.0
    if square > 0:
        t = min(max(_dot(_minus(point, a), side) / square, 0.0), 1.0)
    return t, _length(_minus((a[0] + t * side[0], a[1] + t * side[1], a[2] + t * side[2]), point))


@njit(cache=True, nogil=True)
def _foot(a: Vector, b: Vector, c: Vector, point: Vector) -> Vector:
    """Return the barycentric coordinates of the point of a triangle that is closest to a point."""
    ab, ac, ap = _minus(b, a), _minus(c, a), _minus(point, a)
    d00, d01, d11, d20, d21 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac), _dot(ap, ab), _dot(ap, ac)
    det = d00 * d11 - d01 * d01
    if det > 0:
        v, w = (d11 * d20 - d01 * d21) / det, (d00 * d21 - d01 * d20) / det
        u = 1.0 - v - w
        if u >= 0 and v >= 0 and w >= 0:
            return u, v, w
    t, least = _along(a, b, point)
    best = 1.0 - t, t, 0.0
    t, distance = _along(b, c, point)
    if distance < least:
        best, least = (0.0, 1.0 - t, t), distance
    t, distance = _along(c, a, point)
    return (t, 0.0, 1.0 - t) if distance < least else best


@njit(cache=True, nogil=True)
def feet(corners: FloatArray, points: FloatArray, best: FloatArray) -> None:
    """Write `closest_in_triangle`."""
    for i in range(len(points)):
        T = corners[i]
        best[i, 0], best[i, 1], best[i, 2] = _foot(_vector(T, 0), _vector(T, 1), _vector(T, 2), _vector(points, i))


@njit(cache=True, nogil=True)
def closest_on_surface(
    positions: FloatArray, triangles: IntArray, points: FloatArray, triangle: IntArray, weights: FloatArray, gap: FloatArray
) -> None:
    """Write for each point (k, 3) the triangle of a surface that is closest, the barycentric weights there (k, 3), and how far that is (k,).

    A triangle farther away than the sphere about another one cannot be closest.
    """
    count = len(triangles)
    centre, radius, near = np.empty((count, 3)), np.empty(count), np.empty(count)
    for t in range(count):
        a, b, c = _vector(positions, triangles[t, 0]), _vector(positions, triangles[t, 1]), _vector(positions, triangles[t, 2])
        m = (a[0] + b[0] + c[0]) / 3.0, (a[1] + b[1] + c[1]) / 3.0, (a[2] + b[2] + c[2]) / 3.0
        centre[t, 0], centre[t, 1], centre[t, 2] = m
        radius[t] = max(_length(_minus(a, m)), _length(_minus(b, m)), _length(_minus(c, m)))
    for i in range(len(points)):
        point, bound, best = _vector(points, i), np.inf, np.inf
        for t in range(count):
            dx, dy, dz = centre[t, 0] - point[0], centre[t, 1] - point[1], centre[t, 2] - point[2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            near[t] = distance - radius[t]
            bound = min(bound, distance + radius[t])
        for t in range(count):
            if near[t] > bound:
                continue
            a, b, c = (
                _vector(positions, triangles[t, 0]),
                _vector(positions, triangles[t, 1]),
                _vector(positions, triangles[t, 2]),
            )
            u, v, w = _foot(a, b, c, point)
            x, y, z = u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2]
            distance = _length(_minus((x, y, z), point))
            if distance < best:
                best, triangle[i], gap[i] = distance, t, distance
                bound = min(bound, distance)
                weights[i, 0], weights[i, 1], weights[i, 2] = u, v, w


@njit(cache=True, nogil=True)
def _drawn_to_face(corners: FloatArray, point: Vector, best: FloatArray) -> None:
    """Write the barycentric coordinates (4,) of the point on the faces of a tetrahedron (4, 3) that is closest to a point."""
    least = np.inf
    for face in range(4):
        i, j, k = FACES[face, 0], FACES[face, 1], FACES[face, 2]
        a, b, c = _vector(corners, i), _vector(corners, j), _vector(corners, k)
        u, v, w = _foot(a, b, c, point)
        x, y, z = u * a[0] + v * b[0] + w * c[0], u * a[1] + v * b[1] + w * c[1], u * a[2] + v * b[2] + w * c[2]
        distance = _length(_minus((x, y, z), point))
        if distance < least:
            least = distance
            best[:] = 0.0
            best[i], best[j], best[k] = u, v, w


@njit(cache=True, nogil=True)
def drawn_to_faces(corners: FloatArray, points: FloatArray, best: FloatArray) -> None:
    """Put the closest points on the faces in the place of barycentric coordinates (p,
    4) of points outside of their tetrahedra."""
    for i in range(len(points)):
        if not min(best[i, 0], best[i, 1], best[i, 2], best[i, 3]) >= 0:
            _drawn_to_face(corners[i], _vector(points, i), best[i])


@njit(cache=True, nogil=True)
def may_hold(corners: FloatArray, points: FloatArray, point: IntArray, candidate: IntArray, may: BoolArray) -> None:
    """Write which elements are flat or hold a point, or nearly so, for pairs of points and candidates."""
    for i in range(len(point)):
        T, p = corners[candidate[i]], _vector(points, point[i])
        o = _vector(T, 0)
        d, a, b, c = _minus(p, o), _minus(_vector(T, 1), o), _minus(_vector(T, 2), o), _minus(_vector(T, 3), o)
        volume, u, v, w = _triple(a, b, c), _triple(d, b, c), _triple(a, d, c), _triple(a, b, d)
        if volume < 0:
            volume, u, v, w = -volume, -u, -v, -w
        may[i] = volume == 0 or min(u, v, w, volume - u - v - w) >= -NEARLY * volume


@njit(cache=True, nogil=True)
def keep_deepest(point: IntArray, candidate: IntArray, depth: FloatArray, best: FloatArray, element: IntArray) -> None:
    """Write the element in which each point lies deepest, and that depth."""
    for i in range(len(point)):
        if depth[i] >= -1e-9 and depth[i] > best[point[i]]:
            best[point[i]], element[point[i]] = depth[i], candidate[i]


@njit(cache=True, nogil=True)
def carry(
    corners: FloatArray,
    centres: FloatArray,
    reach: float,
    size: float,
    points: FloatArray,
    candidate: IntArray,
    start: IntArray,
    carrier: IntArray,
    outside: FloatArray,
) -> None:
    """Write the result of `_carriers_of_outsiders`. The candidates of point i are candidate[start[i] : start[i + 1]]."""
    off, distance = np.empty(len(candidate)), np.empty(len(candidate))
    for i in range(len(points)):
        p = _vector(points, i)
        for k in range(start[i], start[i + 1]):
            off[k] = _length(_minus(_vector(centres, candidate[k]), p))
        first = start[i]
        for k in range(start[i], start[i + 1]):
            if off[k] < off[first]:
                first = k
        least = _distance(corners[candidate[first]], p)
        for k in range(start[i], start[i + 1]):
            distance[k] = np.inf
            if off[k] <= least + reach + ALIKE * size:
                distance[k] = _distance(corners[candidate[k]], p)
                least = min(least, distance[k])
        nearest = np.inf
        for k in range(start[i], start[i + 1]):
            if distance[k] <= least + ALIKE * size:
                nearest = min(nearest, off[k])
        carrier[i], outside[i] = len(corners), least
        for k in range(start[i], start[i + 1]):
            if distance[k] <= least + ALIKE * size and off[k] <= nearest + ALIKE_CENTRES * size:
                carrier[i] = min(carrier[i], candidate[k])


@njit(cache=True, nogil=True)
def _distance(corners: FloatArray, point: Vector) -> float:
    """Return how far a point is from the faces of a tetrahedron (4, 3)."""
    w = np.empty(4)
    _drawn_to_face(corners, point, w)
    a, b, c, d = _vector(corners, 0), _vector(corners, 1), _vector(corners, 2), _vector(corners, 3)
    x = w[0] * a[0] + w[1] * b[0] + w[2] * c[0] + w[3] * d[0]
    y = w[0] * a[1] + w[1] * b[1] + w[2] * c[1] + w[3] * d[1]
    z = w[0] * a[2] + w[1] * b[2] + w[2] * c[2] + w[3] * d[2]
    return float(_length(_minus((x, y, z), point)))
