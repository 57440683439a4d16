# mypy: allow-untyped-decorators
"""Patches of the measured surface: a quadratic height field around where it crosses a normal of the model.

In the frame (t₁, t₂, n) at a point o the measured surface is  h(u, v) = c₀ + c₁ u + c₂ v + c₃ u² + c₄ u v + c₅ v², fitted to the points
near by as in `match_along_normals`. A patch is made once and then stays: how far any point z near it lies from the measured surface,

    d(z) = (w − h(u, v)) / √(1 + |∇h(u, v)|²),    (u, v, w) the coordinates of z,

is a smooth function of z, so that whoever moves z has derivatives. Beyond the radius the field goes on as a plane.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from numba import njit

from femsense.arrays import BoolArray, FloatArray, IntArray, as_points
from femsense.pointcloud.grid import build_grid, key_of, positive, runs_around
from femsense.pointcloud.matching import _candidates, _heights, _layer, _least_squares, _nearest_to_line
from femsense.pointcloud.segmentation import surface_pair

FEWEST = 10
"""Points that a patch needs."""
STEEPEST = 0.8
"""Slope of the measured surface against the model's normal beyond which it is another side of the body."""
LEVERAGE = 0.6
"""Share of a single point's variance that the height on the line may have; more: the line lies beside the points."""


@dataclass(frozen=True, eq=False, slots=True)
class Patches:
    """Height fields, one row each, all in one frame of coordinates."""

    origin: FloatArray
    """[m], shape (k, 3)."""
    axes: FloatArray
    """Rows t₁, t₂, n, shape (k, 3, 3)."""
    heights: FloatArray
    """c₀ [m], c₁, c₂ [1], c₃, c₄, c₅ [1/m], shape (k, 6)."""
    radius: FloatArray
    """Extent of the points that a patch was fitted to [m], shape (k,)."""

    def __len__(self) -> int:
        return len(self.origin)

    def pick(self, rows: npt.NDArray[np.bool_] | IntArray) -> Patches:
        """Return some of the patches."""
        return Patches(*(getattr(self, f.name)[rows] for f in fields(self)))

    def put(self, rows: IntArray, others: Patches) -> Patches:
        """Return the patches with some of them, by index, replaced by others."""
        arrays = [getattr(self, f.name).copy() for f in fields(self)]
        for array, f in zip(arrays, fields(self)):
            array[rows] = getattr(others, f.name)
        return Patches(*arrays)

    @property
    def feet(self) -> FloatArray:
        """Where the measured surface crosses the normals [m], shape (k, 3)."""
        return np.asarray(self.origin + self.heights[:, :1] * self.axes[:, 2])

    @property
    def normals(self) -> FloatArray:
        """Outward unit normals of the measured surface there, shape (k, 3)."""
        n = self.axes[:, 2] - self.heights[:, 1:2] * self.axes[:, 0] - self.heights[:, 2:3] * self.axes[:, 1]
        return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))

    def distance(self, points: FloatArray) -> FloatArray:
        """Return how far points (k, 3) [m], one a patch, lie outside of the measured surface [m], shape (k,)."""
        u, v, w = np.einsum("kij,kj->ik", self.axes, points - self.origin)
        share = np.minimum(1.0, self.radius / np.maximum(np.hypot(u, v), 1e-300))
        a, b = share * u, share * v
        c = self.heights.T
        along_u, along_v = c[1] + 2.0 * c[3] * a + c[4] * b, c[2] + c[4] * a + 2.0 * c[5] * b
        height = c[0] + c[1] * a + c[2] * b + c[3] * a**2 + c[4] * a * b + c[5] * b**2
        height = height + along_u * (u - a) + along_v * (v - b)
        return np.asarray((w - height) / np.sqrt(1.0 + along_u**2 + along_v**2))


def fit_patches(
    features: npt.ArrayLike,
    normals: npt.ArrayLike,
    robot_points: npt.ArrayLike,
    *,
    radius: float,
    reach: float,
    min_facing: float,
) -> tuple[Patches, IntArray, FloatArray]:
    """Return the patches of the measured surface that the normals of some points cross, in the frame of the camera.

    Arguments:
        features: points of the modelled surface [m], shape (e, 3), camera frame (the camera stands at the origin).
        normals: their outward normals, shape (e, 3).
        robot_points: measured points of the robot [m], shape (r, 3), camera frame.
        radius: of the points around a normal that count [m].
        reach: largest distance along the normal [m].
        min_facing: smallest cosine between a normal and the ray to the camera.

    Returns:
        the patches (k), which features they belong to (k,), and their standard deviation for the scatter that all share [m], (k,).

    Raises:
        InputError: wrong shapes, thresholds that are not positive.
    """
    places, directions = surface_pair(features, normals, "features", "normals")
    cloud = as_points(robot_points, "robot_points")
    across, along = positive(radius, "radius"), positive(reach, "reach")
    rays = -places / np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1e-300)
    faces = np.asarray(np.einsum("ec,ec->e", rays, directions) >= min_facing)
    if not len(cloud):
        faces = np.zeros(len(places), dtype=np.bool_)
    grid = build_grid(cloud, float(np.hypot(across, along)))
    numbers, axes = _fit_all(
        grid.points, grid.keys, grid.origin, grid.dims, grid.cell, np.array(places), directions, faces, across, along
    )
    good = _good(numbers)
    own = np.flatnonzero(good)
    kept = numbers[own]
    scatter = float(np.median(np.sqrt(kept[:, 7] / np.maximum(kept[:, 8] - 6.0, 1.0)))) if len(kept) else 0.0
    patches = Patches(places[own], axes[own], kept[:, :6], np.full(len(own), across))
    return patches, own, scatter * np.sqrt(kept[:, 6])


def _good(numbers: FloatArray) -> BoolArray:
    enough = numbers[:, 8] >= FEWEST
    steep = np.hypot(numbers[:, 1], numbers[:, 2]) > STEEPEST
    return np.asarray(enough & ~steep & (numbers[:, 6] < LEVERAGE))


@njit(cache=True)
def _fit_all(
    points: FloatArray, keys: IntArray, origin: FloatArray, dims: IntArray, cell: float, places: FloatArray, directions: FloatArray,
    faces: BoolArray, across: float, along: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return per feature: six coefficients, leverage of the height on the line, sum of residual squares, points; and its axes."""
    numbers, axes = np.zeros((len(places), 9)), np.zeros((len(places), 3, 3))
    facing = np.zeros((0, 3))
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    for e in range(len(places)):
        key = key_of(places[e], origin, dims, cell) if faces[e] else -1
        if key < 0:
            continue
        runs_around(keys, key, dims[1] * dims[2], dims[2], starts, ends)
        local, index = _candidates(points, facing, starts, ends, places[e], directions[e], across, along)
        if len(index) < FEWEST:
            continue
        layer = _front(local)
        _axes(directions[e], axes[e])
        _height_field(layer, across, numbers[e])
    return numbers, axes


@njit(cache=True)
def _front(local: FloatArray) -> FloatArray:
    """Return the rows that lie in one sheet with the one nearest to the line."""
    nearest = _nearest_to_line(local, np.zeros(len(local), dtype=np.int64))
    across = np.sqrt((local[:, 0] ** 2 + local[:, 1] ** 2).max())
    front: FloatArray = _layer(local, nearest, across)
    return front


@njit(cache=True)
def _axes(normal: FloatArray, out: FloatArray) -> None:
    """Write the tangents that `_candidates` measures u and v along, and the normal."""
    first = np.zeros(3)
    first[np.argmin(np.abs(normal))] = 1.0
    first -= (first * normal).sum() * normal
    first /= np.sqrt((first**2).sum())
    out[0], out[1], out[2] = first, np.cross(normal, first), normal


@njit(cache=True)
def _height_field(layer: FloatArray, across: float, out: FloatArray) -> None:
    """Write coefficients, leverage, residual squares and count of a quadratic height field; count 0 where there is none.

    Rows beyond four scatters of a first fit (by the median) are left out of a second one.
    """
    if len(layer) < FEWEST:
        return
    done, coefficients, leverage = _least_squares(layer, across, 6)
    if not done:
        return
    residual = np.abs(layer[:, 2] - _heights(layer, across, coefficients))
    keep = residual <= 4.0 * 1.4826 * np.median(residual) + 1e-12
    if keep.sum() < len(layer) and keep.sum() >= FEWEST:
        kept = layer[keep]
        again, better, weight = _least_squares(kept, across, 6)
        if again:
            layer, coefficients, leverage = kept, better, weight
    rest = layer[:, 2] - _heights(layer, across, coefficients)
    out[:6] = coefficients
    out[1:3] /= across
    out[3:6] /= across**2
    out[6], out[7], out[8] = leverage, (rest**2).sum(), len(layer)


__all__ = ["Patches", "fit_patches"]
