# mypy: allow-untyped-decorators
"""Measured surfaces as smooth functions: the signed distance of any nearby point.

A surface is covered with quadratic height fields. In the frame (t₁, t₂, n) at a centre o, n the normal of the points around it,

    h(u, v) = c₀ + c₁ u + c₂ v + c₃ u² + c₄ u v + c₅ v²

is fitted to these points with weights (1 − (u² + v²) / r²)², which vanish at the radius r. A point z = (u, v, w) lies

    dᵢ(z) = (w − h(u, v)) / √(1 + |∇h(u, v)|²)

outside of field i, which is continued as a plane beyond its radius, and d = Σ wᵢ dᵢ / Σ wᵢ outside of the surface, with wᵢ decreasing with
the distance of z from the centre of the field. d is smooth and independent of the model, so that it can be differentiated by z and two
models are compared on the same function.

Source: blended height fields of Ohtake et al., "Multi-level partition of unity implicits" (2003).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_points
from femsense.core.kernels import njit
from femsense.pointcloud.grid import build_grid, key_of, positive, runs_around
from femsense.pointcloud.segmentation import surface_pair

FEWEST = 8
"""Minimum number of points of a height field."""
ACROSS = 0.5
"""Standard deviation of the weights that fields are blended with, in radii."""
ALONG = 0.5
"""Weight of a distance along the normal relative to a tangential one."""
SAME_SIDE = 0.3
"""Minimum cosine between the normal of a field and that of the side in question; below it the field belongs to another side of the body."""
FARTHEST = 9.0
"""Maximum difference between the exponent of a field's weight and that of the nearest field. The weight at that difference is subtracted from
all, so that weights are continuous."""


@dataclass(frozen=True, eq=False, slots=True)
class Sheets:
    """Measured surfaces, concatenated."""

    centres: FloatArray
    """Centres of the height fields [m], shape (f, 3)."""
    axes: FloatArray
    """Axes t₁, t₂, n as rows, shape (f, 3, 3)."""
    heights: FloatArray
    """c₀ [m], c₁, c₂ [1], c₃, c₄, c₅ [1/m], shape (f, 6)."""
    weights: FloatArray
    """Sum of the weights of the points of each field, shape (f,)."""
    starts: IntArray
    """First field of each surface, and the number of fields, shape (s + 1,)."""
    radius: float
    """Radius of a height field [m]."""

    def fields_of(self, sheet: int) -> tuple[FloatArray, FloatArray]:
        """Return centres [m] and normals of the height fields of one surface, shape (c, 3) each."""
        own = slice(self.starts[sheet], self.starts[sheet + 1])
        return self.centres[own], self.axes[own, 2]

    def distance(self, points: FloatArray, sheet: IntArray, sides: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the signed distances of points from surfaces, and the surface normals there.

        Arguments:
            points: [m], shape (k, 3).
            sheet: the surface of each, shape (k,).
            sides: unit normals of the side of the body that each point belongs to, shape (k, 3).

        Returns:
            distances [m], shape (k,), NaN if the surface has no field on that side; outward unit normals, shape (k, 3).
        """
        distances, normals = np.full(len(points), np.nan), np.zeros((len(points), 3))
        _blend(
            np.array(points),
            np.array(sheet),
            np.array(sides),
            self.centres,
            self.axes,
            self.heights,
            self.weights,
            self.starts,
            self.radius,
            distances,
            normals,
        )
        return distances, normals


def fit_sheet(points: npt.ArrayLike, centres: npt.ArrayLike, normals: npt.ArrayLike, radius: float) -> Sheets:
    """Return one measured surface: height fields at some centres, except those with too few points around.

    Arguments:
        points: of the surface [m], shape (n, 3).
        centres: [m], shape (c, 3).
        normals: of the surface there, about, outward, shape (c, 3).
        radius: radius of the height fields [m].

    Raises:
        InputError: wrong shapes, a radius that is not positive.
    """
    cloud, reach = as_points(points, "points"), positive(radius, "radius")
    places, directions = surface_pair(centres, normals, "centres", "normals")
    grid = build_grid(cloud, np.sqrt(2.0) * reach)
    numbers, axes = _fit_all(grid.points, grid.keys, grid.origin, grid.dims, grid.cell, np.array(places), directions, reach)
    own = np.flatnonzero(numbers[:, 6] > 0.0)
    return Sheets(places[own], axes[own], numbers[own, :6], numbers[own, 6], np.array([0, len(own)]), reach)


def joined(sheets: Sequence[Sheets]) -> Sheets:
    """Return surfaces of one radius, one after the other."""
    ends = np.cumsum([len(s.centres) for s in sheets])
    centres, axes, heights, weights = (
        np.concatenate([getattr(s, n) for s in sheets]) for n in ("centres", "axes", "heights", "weights")
    )
    return Sheets(centres, axes, heights, weights, np.concatenate([[0], ends]), sheets[0].radius)


@dataclass(frozen=True, eq=False, slots=True)
class Crossings:
    """Intersections of model normals with measured surfaces, one per row."""

    sheets: Sheets
    sheet: IntArray
    """The surface of each row, shape (k,)."""
    sides: FloatArray
    """Normals of the model there, shape (k, 3)."""
    rounded: FloatArray
    """Distance of the model from its own surface as it would be measured: the error of the height fields [m], shape (k,)."""
    feet: FloatArray
    """Intersection points [m], shape (k, 3)."""
    normals: FloatArray
    """Outward unit normals of the measured surfaces there, shape (k, 3)."""

    def __len__(self) -> int:
        return len(self.sheet)

    def pick(self, rows: npt.NDArray[np.bool_] | IntArray) -> Crossings:
        """Return a selection of the rows."""
        return Crossings(self.sheets, *(getattr(self, f.name)[rows] for f in fields(self)[1:]))

    def distance(self, points: FloatArray) -> FloatArray:
        """Return the signed distances of points (k, 3) [m], one per row, from the measured surface [m], shape (k,)."""
        return self.sheets.distance(points, self.sheet, self.sides)[0] - self.rounded


@njit(cache=True)
def _blend(
    points: FloatArray,
    sheet: IntArray,
    sides: FloatArray,
    centres: FloatArray,
    axes: FloatArray,
    heights: FloatArray,
    weights: FloatArray,
    starts: IntArray,
    radius: float,
    distances: FloatArray,
    normals: FloatArray,
) -> None:
    """Write distances and normals of points."""
    scale, least = 0.5 / (ACROSS * radius) ** 2, np.exp(-FARTHEST)
    local, away = np.zeros(3), np.zeros(starts[-1])
    for k in range(len(points)):
        first, last, nearest = starts[sheet[k]], starts[sheet[k] + 1], np.inf
        for i in range(first, last):
            away[i] = np.inf
            if _alike(axes[i, 2], sides[k]) <= SAME_SIDE:
                continue
            square, along = 0.0, 0.0
            for c in range(3):
                apart = points[k, c] - centres[i, c]
                square += apart * apart
                along += apart * sides[k, c]
            away[i] = scale * (square - (1.0 - ALONG**2) * along * along)
            nearest = min(nearest, away[i])
        total, sum_d = 0.0, 0.0
        for i in range(first, last):
            if away[i] >= nearest + FARTHEST:
                continue
            share = (np.exp(nearest - away[i]) - least) * (_alike(axes[i, 2], sides[k]) - SAME_SIDE) * weights[i]
            for a in range(3):
                local[a] = 0.0
                for c in range(3):
                    local[a] += axes[i, a, c] * (points[k, c] - centres[i, c])
            d, by_u, by_v = _outside(local, heights[i], radius)
            total += share
            sum_d += share * d
            length = share / np.sqrt(1.0 + by_u**2 + by_v**2)
            for c in range(3):
                normals[k, c] += length * (axes[i, 2, c] - by_u * axes[i, 0, c] - by_v * axes[i, 1, c])
        if total > 0.0:
            distances[k] = sum_d / total
            normals[k] /= np.sqrt((normals[k] ** 2).sum())


@njit(cache=True)
def _alike(a: FloatArray, b: FloatArray) -> float:
    """Return the product of two vectors, shape (3,)."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


@njit(cache=True)
def _outside(local: FloatArray, c: FloatArray, radius: float) -> tuple[float, float, float]:
    """Return the signed distance of a point (u, v, w) from a height field, and the slopes of the field there."""
    across = np.sqrt(local[0] ** 2 + local[1] ** 2)
    share = min(1.0, radius / across) if across > 0.0 else 1.0
    a, b = share * local[0], share * local[1]
    by_u, by_v = c[1] + 2.0 * c[3] * a + c[4] * b, c[2] + c[4] * a + 2.0 * c[5] * b
    height = c[0] + c[1] * a + c[2] * b + c[3] * a * a + c[4] * a * b + c[5] * b * b
    height += by_u * (local[0] - a) + by_v * (local[1] - b)
    return (local[2] - height) / np.sqrt(1.0 + by_u**2 + by_v**2), by_u, by_v


@njit(cache=True)
def _fit_all(
    points: FloatArray,
    keys: IntArray,
    origin: FloatArray,
    dims: IntArray,
    cell: float,
    places: FloatArray,
    directions: FloatArray,
    radius: float,
) -> tuple[FloatArray, FloatArray]:
    """Return for each centre six coefficients, the sum of weights (0: no field), and the axes."""
    numbers, axes = np.zeros((len(places), 7)), np.zeros((len(places), 3, 3))
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    for e in range(len(places)):
        _axes(directions[e], axes[e])
        key = key_of(places[e], origin, dims, cell)
        if key < 0:
            continue
        runs_around(keys, key, dims[1] * dims[2], dims[2], starts, ends)
        local = np.zeros(((ends - starts).sum(), 3))
        count = 0
        for j in range(9):
            for i in range(starts[j], ends[j]):
                for a in range(3):
                    local[count, a] = 0.0
                    for c in range(3):
                        local[count, a] += axes[e, a, c] * (points[i, c] - places[e, c])
                if local[count, 0] ** 2 + local[count, 1] ** 2 < radius**2 and abs(local[count, 2]) < radius:
                    count += 1
        if count >= FEWEST:
            _height_field(local[:count], radius, numbers[e])
    return numbers, axes


@njit(cache=True)
def _axes(normal: FloatArray, out: FloatArray) -> None:
    """Write two tangents and the normal."""
    first = np.zeros(3)
    first[np.argmin(np.abs(normal))] = 1.0
    first -= (first * normal).sum() * normal
    first /= np.sqrt((first**2).sum())
    out[0], out[1], out[2] = first, np.cross(normal, first), normal


@njit(cache=True)
def _height_field(local: FloatArray, radius: float, out: FloatArray) -> None:
    """Write coefficients and sum of weights of a quadratic height field; a second fit downweights points far from the first one."""
    u, v, w = local[:, 0] / radius, local[:, 1] / radius, local[:, 2].copy()
    rows = np.ones((len(local), 6))
    rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4], rows[:, 5] = u, v, u * u, u * v, v * v
    near = (1.0 - u * u - v * v) ** 2
    least: FloatArray = near
    coefficients: FloatArray = np.zeros(6)
    for _ in range(2):
        weighted = rows * least.reshape(-1, 1)
        normal = rows.T @ weighted
        values = np.linalg.eigvalsh(normal)
        if values[0] < 1e-3 * values[-1] / 6.0:
            return
        coefficients = np.linalg.inv(normal) @ (weighted.T @ w)
        rest = w - rows @ coefficients
        usual = 4.0 * 1.4826 * np.median(np.abs(rest)) + 1e-12
        least = near / (1.0 + (rest / usual) ** 2) ** 2
    out[:6] = coefficients
    out[1:3] /= radius
    out[3:6] /= radius**2
    out[6] = near.sum()
