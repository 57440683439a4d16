# mypy: allow-untyped-decorators
"""Matching of feature points to the observed surface along their normals.

Source: "Calibration and force sensing with an RGB-D camera", section V.A.5, Algorithm 3. In addition to it, points farther than d_l along
the normal are excluded before the nearest one is chosen, features that face away from the camera are excluded, and a local fit averages the
noise of the camera and gives its standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import BoolArray, FloatArray, IntArray, as_points, freeze
from femsense.core.errors import InputError
from femsense.core.kernels import njit
from femsense.pointcloud.grid import VoxelGrid, build_grid, key_of, positive, runs_around
from femsense.pointcloud.segmentation import surface_pair

_PRIOR_DOF = 4.0  # weight of the scatter that all features share, in degrees of freedom


@dataclass(frozen=True, eq=False, slots=True)
class Matches:
    """One row per feature point. Unmatched rows are NaN (line_distance: inf), with point −1."""

    found: BoolArray
    """Whether the observed surface crosses the feature's normal, shape [e]."""
    distance: FloatArray
    """Signed distance of that crossing from the feature along the normal, outwards > 0 [m], shape [e]."""
    std: FloatArray
    """Standard deviation of distance [m], shape [e]; inf if there were too few points to estimate it."""
    line_distance: FloatArray
    """Distance of the nearest point from the normal line [m], shape [e]."""
    point: IntArray
    """Index of that nearest point, shape [e]."""
    count: IntArray
    """Number of points used for the distance, shape [e]."""
    hidden: BoolArray
    """Features that face away from every camera, shape [e]."""

    def positions(self, features: FloatArray, normals: FloatArray) -> FloatArray:
        """Return the crossings [m], shape (e, 3), for features [m] and unit normals (e, 3)."""
        return np.asarray(features + self.distance[:, None] * normals)


@dataclass(frozen=True, slots=True)
class MatchingOptions:
    """How a match is computed from its candidates."""

    average: bool = False
    """Use the local fit instead of the nearest point."""
    order: int = 2
    """Of the fit: 2 follows the curvature of the body; 1 has less variance and a bias of about d_m²/(4 · radius of curvature).
    Fewer than 10 (order 2) or 5 (order 1) candidates lower it."""
    min_facing: float = 0.15
    """Smallest cosine between a normal and the direction to a camera [1]; below it the feature is hidden."""
    std_floor_m: float = 0.0
    """Error that averaging does not reduce (correlated noise, calibration) [m]; added to each std in quadrature."""


def match_along_normals(
    features: npt.ArrayLike,
    normals: npt.ArrayLike,
    robot_points: npt.ArrayLike,
    *,
    d_m: float,
    d_l: float,
    camera_position: npt.ArrayLike | None = None,
    view_direction: npt.ArrayLike | None = None,
    robot_normals: npt.ArrayLike | None = None,
    options: MatchingOptions | None = None,
) -> Matches:
    """Return where the observed robot crosses the normal line of each feature point (Algorithm 3).

    Candidates are points within d_l along the normal and d_m across it, on the side that the camera sees. The nearest to
    the line is the paper's match. Over the candidates a height field along the normal is fitted,

        offset(u, v) = c₀ + c₁ u + c₂ v + c₃ u² + c₄ u v + c₅ v²        (order 2; the first 3 terms for order 1, c₀ for 0)

    after points far from the nearest layer are excluded. With `average` the distance is c₀, the value on the line, with
    std² = s² (AᵀA)⁻¹₀₀; without, it is the offset of the nearest point, with std² = s² + (slope · line_distance)².
    The scatter s is that of the feature's residuals, shrunk towards the median of all features with the weight of four points.

    Arguments:
        features: predicted positions of the feature points [m], shape (e, 3).
        normals: their outward normals, shape (e, 3); need not be unit vectors.
        robot_points: observed points of the robot [m], shape (r, 3).
        d_m: maximum distance from the normal line [m]; a feature without points within it is hidden.
        d_l: maximum distance along the normal [m]; points farther away belong to another object.
        camera_position: of one camera [m], shape (3,), or of several, shape (c, 3).
        view_direction: instead of camera_position, for a distant camera: its viewing direction, shape (3,) or (c, 3).
        robot_normals: normals of the robot points, shape (r, 3); points that face away from the feature's normal are excluded. Required for
            thin bodies in clouds of several cameras.
        options: local fit, hidden features.
    Returns:
        the matches.
    Raises:
        InputError: wrong shapes, thresholds that are not positive, both camera_position and view_direction.
    """
    places, directions = surface_pair(features, normals, "features", "normals")
    cloud = as_points(robot_points, "robot_points")
    across, along = positive(d_m, "d_m"), positive(d_l, "d_l")
    how = options or MatchingOptions()
    if how.order not in (0, 1, 2):
        raise InputError("no such order", where="order", found=how.order, expected="0, 1 or 2")
    facing = _facing(cloud, robot_normals)
    visible = _visible(places, directions, camera_position, view_direction, float(how.min_facing))
    grid = build_grid(cloud, float(np.hypot(across, along)))
    raw = _match(*_sorted(grid, facing), np.array(places), directions, visible, across, along, how.order)
    return _matches(raw, grid, visible, how.average, float(how.std_floor_m))


# --- helpers ----------------------------------------------------------------------------------------------------------


def _facing(cloud: FloatArray, normals: npt.ArrayLike | None) -> FloatArray:
    """Return the normals of the points, shape (0, 3) if there are none."""
    return np.zeros((0, 3)) if normals is None else surface_pair(cloud, normals, "robot_points", "robot_normals")[1]


def _visible(
    places: FloatArray,
    directions: FloatArray,
    camera_position: npt.ArrayLike | None,
    view_direction: npt.ArrayLike | None,
    min_facing: float,
) -> BoolArray:
    """Return which features face at least one camera, shape (e,)."""
    if camera_position is not None and view_direction is not None:
        raise InputError(
            "two statements of the view", where="camera_position", found="view_direction as well", expected="one of them"
        )
    if camera_position is None and view_direction is None:
        return np.ones(len(places), dtype=np.bool_)
    if camera_position is not None:
        to_camera = as_points(camera_position, "camera_position")[None, :, :] - places[:, None, :]
    else:
        looks = as_points(np.asarray(view_direction, dtype=np.float64), "view_direction")
        to_camera = np.repeat(-looks[None, :, :], len(places), axis=0)
    lengths = np.maximum(np.linalg.norm(to_camera, axis=2), 1e-300)
    cosine = np.einsum("eci,ei->ec", to_camera, directions) / lengths
    return np.asarray((cosine >= min_facing).any(axis=1))


def _sorted(grid: VoxelGrid, facing: FloatArray) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, IntArray, float]:
    return grid.points, facing[grid.order] if len(facing) else np.zeros((0, 3)), grid.keys, grid.origin, grid.dims, grid.cell


def _matches(raw: tuple[FloatArray, IntArray], grid: VoxelGrid, visible: BoolArray, average: bool, floor: float) -> Matches:
    """Return the result with standard deviations computed from the columns of the kernel."""
    numbers, whole = raw
    nearest, count, fitted, terms = whole.T
    line, offset, value, slope, squares, leverage = numbers.T
    found = nearest >= 0
    dof = fitted - terms
    variance = _pooled_variance(squares, dof)
    used = np.full(len(found), average)
    std = np.sqrt(np.where(used, variance * np.where(found, leverage, 1.0), variance + (slope * line) ** 2) + floor**2)
    return Matches(
        found=freeze(found, np.bool_),
        distance=freeze(np.where(found, np.where(used, value, offset), np.nan)),
        std=freeze(np.where(found, std, np.nan)),
        line_distance=freeze(np.where(found, line, np.inf)),
        point=freeze(np.where(found, grid.order[nearest] if len(grid.order) else -1, -1), np.int64),
        count=freeze(np.where(found & used, fitted, np.minimum(count, 1)), np.int64),
        hidden=freeze(~visible, np.bool_),
    )


def _pooled_variance(squares: FloatArray, dof: IntArray) -> FloatArray:
    """Return the scatter² of each feature (e,) [m²] from its sum of squares, shrunk towards the median; inf if there are no residuals."""
    own = dof >= 1
    if not own.any():
        return np.full(len(squares), np.inf)
    shared = float(np.sum(squares[own]) / np.sum(dof[own]))
    reliable = dof >= 4
    if reliable.any():
        shared = float(np.median(squares[reliable] / dof[reliable]))
    degrees = np.maximum(dof, 0)
    return np.asarray((np.where(own, squares, 0.0) + _PRIOR_DOF * shared) / (degrees + _PRIOR_DOF))


@njit(cache=True)
def _match(
    points: FloatArray,
    facing: FloatArray,
    keys: IntArray,
    origin: FloatArray,
    dims: IntArray,
    cell: float,
    places: FloatArray,
    directions: FloatArray,
    visible: BoolArray,
    across: float,
    along: float,
    order: int,
) -> tuple[FloatArray, IntArray]:
    """Return per feature: line distance, offset, fitted value, slope, residual squares, leverage; and nearest,
    candidates, fitted, terms."""
    numbers, whole = np.zeros((len(places), 6)), np.zeros((len(places), 4), dtype=np.int64)
    starts, ends = np.zeros(9, dtype=np.int64), np.zeros(9, dtype=np.int64)
    for e in range(len(places)):
        whole[e, 0] = -1
        key = key_of(places[e], origin, dims, cell) if visible[e] and len(points) > 0 else -1
        if key < 0:
            continue
        runs_around(keys, key, dims[1] * dims[2], dims[2], starts, ends)
        local, index = _candidates(points, facing, starts, ends, places[e], directions[e], across, along)
        if len(index) == 0:
            continue
        nearest = _nearest_to_line(local, index)
        whole[e, 0], whole[e, 1] = index[nearest], len(index)
        numbers[e, 0] = np.sqrt(local[nearest, 0] ** 2 + local[nearest, 1] ** 2)
        numbers[e, 1] = local[nearest, 2]
        layer = _layer(local, nearest, across)
        whole[e, 2], whole[e, 3] = len(layer), _fit(layer, across, order, numbers[e, 2:])
    return numbers, whole


@njit(cache=True)
def _candidates(
    points: FloatArray,
    facing: FloatArray,
    starts: IntArray,
    ends: IntArray,
    place: FloatArray,
    normal: FloatArray,
    across: float,
    along: float,
) -> tuple[FloatArray, IntArray]:
    """Return (u, v, offset) of the points inside the cylinder, shape (c, 3), and their indices (c,)."""
    total = (ends - starts).sum()
    local, index, count = np.zeros((total, 3)), np.zeros(total, dtype=np.int64), 0
    first = np.zeros(3)
    first[np.argmin(np.abs(normal))] = 1.0
    first -= (first * normal).sum() * normal
    first /= np.sqrt((first**2).sum())
    second = np.cross(normal, first)
    for j in range(9):
        for i in range(starts[j], ends[j]):
            x, y, z = points[i, 0] - place[0], points[i, 1] - place[1], points[i, 2] - place[2]
            offset = x * normal[0] + y * normal[1] + z * normal[2]
            u = x * first[0] + y * first[1] + z * first[2]
            v = x * second[0] + y * second[1] + z * second[2]
            if abs(offset) > along or u * u + v * v > across * across:
                continue
            if len(facing) > 0 and (facing[i] * normal).sum() <= 0.0:
                continue
            local[count, 0], local[count, 1], local[count, 2] = u, v, offset
            index[count] = i
            count += 1
    return local[:count], index[:count]


@njit(cache=True)
def _nearest_to_line(local: FloatArray, index: IntArray) -> int:
    """Return the row nearest to the line; ties (to 1e-12) go to the smaller |offset|."""
    best = 0
    for i in range(1, len(index)):
        gain = (local[best, 0] ** 2 + local[best, 1] ** 2) - (local[i, 0] ** 2 + local[i, 1] ** 2)
        if gain > 1e-24 or (gain >= -1e-24 and abs(local[i, 2]) < abs(local[best, 2])):
            best = i
    return best


@njit(cache=True)
def _layer(local: FloatArray, nearest: int, across: float) -> FloatArray:
    """Return the rows in the same layer as the nearest point: their offsets differ by less than 2 · d_m (a slope of 60°)."""
    same = np.abs(local[:, 2] - local[nearest, 2]) <= 2.0 * across
    sheet: FloatArray = local[same]
    return sheet


@njit(cache=True)
def _fit(layer: FloatArray, across: float, order: int, out: FloatArray) -> int:
    """Write value on the line, slope, sum of residual squares and leverage; return the number of terms.

    Rows beyond four scatters of a first fit (by the median) are excluded from a second one;
    the sum of squares is scaled to all rows.
    """
    terms = 6 if order == 2 and len(layer) >= 10 else 3 if order >= 1 and len(layer) >= 5 else 1
    while True:
        done, coefficients, leverage = _least_squares(layer, across, terms)
        if done:
            break
        terms = 3 if terms == 6 else 1
    if terms > 1:
        residual = np.abs(layer[:, 2] - _heights(layer, across, coefficients))
        keep = residual <= 4.0 * 1.4826 * _median(residual) + 1e-12
        if keep.sum() < len(layer) and keep.sum() > terms + 3:
            kept = layer[keep]
            again, better, weight = _least_squares(kept, across, terms)
            if again:
                layer, coefficients, leverage = kept, better, weight
    rest = layer[:, 2] - _heights(layer, across, coefficients)
    out[0] = coefficients[0]
    out[1] = np.sqrt(coefficients[1] ** 2 + coefficients[2] ** 2) / across if terms > 1 else 0.0
    out[2] = (rest**2).sum()
    out[3] = leverage
    return terms


@njit(cache=True)
def _median(values: FloatArray) -> float:
    """Return the median (shell sort: np.median would dominate the compile time of this module)."""
    ordered, gap = values.copy(), len(values) // 2
    while gap > 0:
        for i in range(gap, len(ordered)):
            value, j = ordered[i], i
            while j >= gap and ordered[j - gap] > value:
                ordered[j] = ordered[j - gap]
                j -= gap
            ordered[j] = value
        gap //= 2
    middle = len(ordered) // 2
    return float(ordered[middle] if len(ordered) % 2 else 0.5 * (ordered[middle - 1] + ordered[middle]))


@njit(cache=True)
def _row(u: float, v: float, row: FloatArray) -> None:
    row[0] = 1.0
    if len(row) >= 3:
        row[1], row[2] = u, v
    if len(row) == 6:
        row[3], row[4], row[5] = u * u, u * v, v * v


@njit(cache=True)
def _heights(layer: FloatArray, across: float, coefficients: FloatArray) -> FloatArray:
    heights, row = np.zeros(len(layer)), np.zeros(len(coefficients))
    for i in range(len(layer)):
        _row(layer[i, 0] / across, layer[i, 1] / across, row)
        heights[i] = (row * coefficients).sum()
    return heights


@njit(cache=True)
def _least_squares(layer: FloatArray, across: float, terms: int) -> tuple[bool, FloatArray, float]:
    """Return whether the fit is well posed, its coefficients, and (AᵀA)⁻¹₀₀."""
    normal, right, row = np.zeros((terms, terms)), np.zeros(terms), np.zeros(terms)
    for i in range(len(layer)):
        _row(layer[i, 0] / across, layer[i, 1] / across, row)
        right += row * layer[i, 2]
        for k in range(terms):
            normal[k] += row[k] * row
    values = np.linalg.eigvalsh(normal)
    if terms > 1 and values[0] < 1e-4 * values[-1] / len(layer) ** 0.5:
        return False, np.zeros(terms), 0.0
    inverse = np.linalg.inv(normal)
    return True, inverse @ right, inverse[0, 0]
