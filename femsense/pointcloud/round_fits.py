# mypy: allow-untyped-decorators
"""Spheres, cylinders, round ends of rods and planes fitted to noisy points: compiled.

A robust fit (Huber's function, Levenberg's damping) of the distances of points from the surface, over their noise along the ray; for planes
trimmed least squares.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, read_only
from femsense.core.kernels import njit

SPHERE, BALL, CYLINDER, ROUND_END = 0, 1, 2, 3
"""A sphere: centre, log radius. A ball of known radius: centre. A cylinder: two shifts across the first axis of its frame, log radius, two
tilts. A rod with a round end: those of a cylinder, and the position of the centre of the hemisphere along the first axis."""
CUT = 2.0
"""Whitened residuals beyond this count linearly."""
TRIMMED, FARTHER = 4, 3.0
"""Rounds of a fit of a plane, and the whitened residual, relative to their typical size or 1, beyond which a point is excluded from the
next round."""
GRAZING = 0.2
"""Minimum cosine of incidence: the noise of a point normal to the surface is that along its ray times this cosine."""


def fit_round(
    kind: int,
    points: FloatArray,
    std: FloatArray,
    ray: FloatArray,
    start: FloatArray,
    *,
    steps: int,
    radius: float = 0.0,
    frame: FloatArray | None = None,
    middle: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return parameters, their curvature, the whitened residual (k,), and its Huber function summed.

    Arguments:
        kind: SPHERE, BALL, CYLINDER or ROUND_END.
        points: measured [m], shape (k, 3).
        std: noise of each along its ray [m], shape (k,).
        ray: unit directions of the rays, shape (k, 3).
        start: initial parameters.
        steps: maximum number of steps.
        radius: radius of a BALL [m].
        frame, middle: axes and a point near the axis of a CYLINDER or ROUND_END, shapes (3, 3) and (3,) [m].
    """
    x, n, k = np.array(start, dtype=np.float64), len(points), len(start)
    residual, slopes, curve = np.empty(n), np.empty((n, k)), np.empty((k, k))
    given = (read_only(points), read_only(std), read_only(ray))
    axes, origin = (np.eye(3) if frame is None else frame), (np.zeros(3) if middle is None else middle)
    cost = _fit(kind, *given, read_only(axes), read_only(origin), radius, x, residual, slopes, curve, steps)
    return x, curve, residual, float(cost)


def fit_plane(points: FloatArray, std: FloatArray, ray: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return a point of the plane [m]; two directions in it and the normal towards the camera as rows, (3, 3); the whitened residuals (k,);
    and the points used in the last round, (k,). Arguments as for `fit_round`."""
    residual, keep = np.empty(len(points)), np.ones(len(points), dtype=np.bool_)
    middle, axes = np.empty(3), np.empty((3, 3))
    _fit_plane(read_only(points), read_only(std), read_only(ray), middle, axes, residual, keep)
    return middle, axes, residual, keep


@njit(cache=True, nogil=True)
def _fit_plane(
    points: FloatArray,
    std: FloatArray,
    ray: FloatArray,
    middle: FloatArray,
    axes: FloatArray,
    residual: FloatArray,
    keep: BoolArray,
) -> None:
    """Write the results of `fit_plane`."""
    look = np.zeros(3)
    for i in range(len(points)):
        look += ray[i]
    for _ in range(TRIMMED):
        middle[:], count, spread = 0.0, 0, np.zeros((3, 3))
        for i in range(len(points)):
            if keep[i]:
                middle += points[i]
                count += 1
        if count < 3:
            return
        middle /= count
        for i in range(len(points)):
            if keep[i]:
                off = points[i] - middle
                for r in range(3):
                    for c in range(3):
                        spread[r, c] += off[r] * off[c]
        axes[:] = np.linalg.eigh(spread)[1].T[::-1]
        if (axes[2] * look).sum() > 0.0:
            axes[2] *= -1.0
        for i in range(len(points)):
            slant = abs((ray[i] * axes[2]).sum())
            residual[i] = ((points[i] - middle) * axes[2]).sum() / (std[i] * max(slant, GRAZING))
        limit = FARTHER * max(1.483 * np.median(np.abs(residual)), 1.0)
        for i in range(len(points)):
            keep[i] = abs(residual[i]) < limit


@njit(cache=True, nogil=True)
def _fit(
    kind: int,
    points: FloatArray,
    std: FloatArray,
    ray: FloatArray,
    frame: FloatArray,
    middle: FloatArray,
    radius: float,
    x: FloatArray,
    residual: FloatArray,
    slopes: FloatArray,
    curve: FloatArray,
    steps: int,
) -> float:
    """Move parameters to the fit, and write its residual, slopes and curvature."""
    n, k = slopes.shape
    there, left, other = np.empty(k), np.empty(n), np.empty((n, k))
    matrix, step = np.empty((k, k)), np.empty(k)
    damping = 1e-3
    cost = _evaluate(kind, points, std, ray, frame, middle, radius, x, residual, slopes)
    for _ in range(steps):
        _normal(residual, slopes, True, curve, step)
        for i in range(k):
            matrix[i] = curve[i]
            matrix[i, i] += damping * (curve[i, i] + 1e-12)
        _solve(matrix, step)
        for i in range(k):
            there[i] = x[i] - min(max(step[i], -1.0), 1.0)
        new = _evaluate(kind, points, std, ray, frame, middle, radius, there, left, other)
        if new < cost:
            done = cost - new < 1e-4 * cost
            x[:], residual[:], slopes[:], cost = there, left, other, new
            damping *= 0.2
            if done:
                break
        else:
            damping *= 10.0
    _normal(residual, slopes, False, curve, step)
    return float(cost)


@njit(cache=True, nogil=True)
def _evaluate(
    kind: int,
    points: FloatArray,
    std: FloatArray,
    ray: FloatArray,
    frame: FloatArray,
    middle: FloatArray,
    radius: float,
    x: FloatArray,
    residual: FloatArray,
    slopes: FloatArray,
) -> float:
    """Write the whitened residual (n,) and its slopes (n, k); return Huber's function of it, summed."""
    k, total = len(x), 0.0
    axis, unit, base = np.zeros(3), np.empty(3), np.empty(3)
    size, shortened, end = radius, 1.0, np.inf
    rod = kind in (CYLINDER, ROUND_END)
    if kind == SPHERE:
        size = np.exp(x[3])
    if kind == ROUND_END:
        end = x[5]
    if rod:
        size = np.exp(x[2])
        shortened = 1.0 / np.sqrt(1.0 + x[3] * x[3] + x[4] * x[4])
        for c in range(3):
            axis[c] = (frame[0, c] + x[3] * frame[1, c] + x[4] * frame[2, c]) * shortened
            base[c] = middle[c] + x[0] * frame[1, c] + x[1] * frame[2, c]
    else:
        base[:] = x[:3]
    for i in range(len(points)):
        along = 0.0
        for c in range(3):
            unit[c] = points[i, c] - base[c]
            along += unit[c] * axis[c]
        ends = along > end
        along = min(along, end)
        length = 0.0
        for c in range(3):
            unit[c] -= along * axis[c]
            length += unit[c] * unit[c]
        length = max(np.sqrt(length), 1e-9)
        facing = 0.0
        for c in range(3):
            unit[c] /= length
            facing += unit[c] * ray[i, c]
        scale = std[i] * max(abs(facing), GRAZING)
        residual[i] = (length - size) / scale
        if rod:
            first, second = 0.0, 0.0
            for c in range(3):
                first += unit[c] * frame[1, c]
                second += unit[c] * frame[2, c]
            slopes[i, 0], slopes[i, 1], slopes[i, 2] = -first / scale, -second / scale, -size / scale
            slopes[i, 3], slopes[i, 4] = -along * first * shortened / scale, -along * second * shortened / scale
            if kind == ROUND_END:
                slopes[i, 5] = 0.0
                if ends:
                    for c in range(3):
                        slopes[i, 5] -= unit[c] * axis[c] / scale
        else:
            for c in range(3):
                slopes[i, c] = -unit[c] / scale
            if k == 4:
                slopes[i, 3] = -size / scale
        z = abs(residual[i])
        total += z * z if z <= CUT else CUT * (2.0 * z - CUT)
    return float(total)


@njit(cache=True, nogil=True)
def _normal(residual: FloatArray, slopes: FloatArray, robust: bool, curve: FloatArray, right: FloatArray) -> None:
    """Write the curvature (k, k) and the gradient (k,), with less weight of outliers if requested."""
    n, k = slopes.shape
    curve[:], right[:] = 0.0, 0.0
    for i in range(n):
        z = abs(residual[i])
        weight = CUT / z if robust and z > CUT else 1.0
        for a in range(k):
            right[a] += weight * slopes[i, a] * residual[i]
            for b in range(a + 1):
                curve[a, b] += weight * slopes[i, a] * slopes[i, b]
    for a in range(k):
        for b in range(a):
            curve[b, a] = curve[a, b]


@njit(cache=True, nogil=True)
def _solve(matrix: FloatArray, right: FloatArray) -> None:
    """Write the solution of a small positive definite system in place of its right-hand side (k,); zeros if it is singular."""
    k = len(right)
    for j in range(k):
        if not matrix[j, j] > 0.0:
            right[:] = 0.0
            return
        for i in range(j + 1, k):
            factor = matrix[i, j] / matrix[j, j]
            for c in range(j, k):
                matrix[i, c] -= factor * matrix[j, c]
            right[i] -= factor * right[j]
    for j in range(k - 1, -1, -1):
        for c in range(j + 1, k):
            right[j] -= matrix[j, c] * right[c]
        right[j] /= matrix[j, j]
