"""The pose of a camera from unnamed points: congruent triangles, then alternating assignment and rigid registration.

Triangles of measured points are aligned with the triangles of the model that have the most similar sides. The poses that bring most
points near the model are refined in all frames at once. A pose is judged by a likelihood in which every
point is a marker or an outlier. Sources: Fischler and Bolles, "Random sample consensus" (1981); Kuhn (1955) for the assignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from femsense.calib.rigid import fit_rigid_robust, rotation_between
from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.core.pose import transform_points

TRIANGLES = 30
"""Number of measured triangles that are tried. With a third of outliers, 30 % of the triangles contain none; that none of 30 is clean
happens once in 2e5 times."""
ALIKE = 300
"""Number of model triangles that each is aligned with, those with the most similar sides: 5 markers have 60, 12 have 1320."""
REFINED = 40
"""Poses that are refined in all frames."""
FINEST = 1e-5
"""No camera measures better than this [m]; an exact fit of three points must not count as certainty."""
ROUNDS = 12
"""Assignments and rigid fits in turn, at most."""
FAR = 1e3
"""A distance that no pair of points has [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class PosedNames:
    """A candidate pose of a camera, and the marker names of its points."""

    T_robot_camera: FloatArray
    """shape (4, 4)."""
    marker: tuple[IntArray, ...]
    """Index of the marker assigned to each point of each frame, −1 for an outlier, each (n,)."""
    error_m: float
    """See `typical_error` [m]."""


def search_poses(
    model: Sequence[FloatArray],
    seen: Sequence[FloatArray],
    *,
    allowed: Sequence[BoolArray] | None = None,
    repeats: float = 1.0,
    rng: np.random.Generator,
) -> list[PosedNames]:
    """Return poses of a camera under which the points are the model's, each with other names, best first.

    Arguments:
        model: where the model has the markers in each frame [m], robot frame, each (m, 3).
        seen: points in each frame [m], camera frame, each (n, 3); n differs from frame to frame.
        allowed: which marker each point may be, each (n, m); by default any.
        repeats: frames a state: such frames repeat the same error of the model.
        rng: picks triangles where there are many.

    Raises:
        DataError: no frame has three points.
    """
    may = [np.ones((len(s), len(p)), dtype=bool) for s, p in zip(seen, model)] if allowed is None else list(allowed)
    starts = []
    for f in sorted(range(len(seen)), key=lambda f: -len(seen[f]))[:3]:
        if len(seen[f]) >= 3:
            starts += _from_triangles(model[f], seen[f], may[f], rng)
    if not starts:
        most = max((len(s) for s in seen), default=0)
        raise DataError(f"a pose needs a frame with three markers; the most in one frame is {most}")
    found: dict[bytes, PosedNames] = {}
    for _, T in sorted(starts, key=lambda start: start[0])[:REFINED]:
        one = refine_names(model, seen, T, allowed=may, repeats=repeats)
        key = np.concatenate(one.marker).tobytes()
        if key not in found or one.error_m < found[key].error_m:
            found[key] = one
    return sorted(found.values(), key=lambda one: one.error_m)


def refine_names(
    model: Sequence[FloatArray],
    seen: Sequence[FloatArray],
    T_robot_camera: FloatArray,
    *,
    allowed: Sequence[BoolArray],
    fixed: bool = False,
    repeats: float = 1.0,
) -> PosedNames:
    """Return the pose and the assignment to which alternating assignment and rigid registration converge from a pose.

    A point is an outlier if that is more likely than a measurement error of its marker, by the likelihood of `typical_error`:  d² > 6 σ² log(room / σ).

    Arguments:
        model, seen, allowed: the arguments of `search_poses` with these names.
        T_robot_camera: the start, shape (4, 4).
        fixed: keep the pose.
        repeats: frames a state.
    """
    T, room = T_robot_camera, room_of(model[0])
    nearest = [np.where(may, squared(transform_points(T, s), p), FAR**2).min(axis=1) for p, s, may in zip(model, seen, allowed)]
    left, marker = np.concatenate(nearest), None
    for _ in range(ROUNDS):
        noise = float(_likeliest(left, room, repeats)[0])
        reach = noise * float(np.sqrt(6.0 * np.log(max(room / noise, 2.0))))
        before, marker = marker, _names_under(model, seen, T, allowed, reach)
        if before is not None and all(np.array_equal(x, y) for x, y in zip(before, marker)):
            break
        T = T if fixed else _fitted_pose(model, seen, marker, T)
        left = _squares(model, seen, T, marker, room)
    assert marker is not None
    return PosedNames(T, marker, float(typical_error(_squares(model, seen, T, marker, room), room, repeats=repeats)))


def _fitted_pose(
    model: Sequence[FloatArray], seen: Sequence[FloatArray], marker: Sequence[IntArray], T: FloatArray
) -> FloatArray:
    a = np.vstack([p[m[m >= 0]] for p, m in zip(model, marker)])
    b = np.vstack([s[m >= 0] for s, m in zip(seen, marker)])
    try:
        return fit_rigid_robust(a, b, rounds=4)[0]
    except DataError:  # too few, or on a line
        return T


def _names_under(
    model: Sequence[FloatArray], seen: Sequence[FloatArray], T: FloatArray, allowed: Sequence[BoolArray], reach: float
) -> tuple[IntArray, ...]:
    return tuple(assigned(p, transform_points(T, s), may, reach=reach) for p, s, may in zip(model, seen, allowed))


def assigned(model: FloatArray, points: FloatArray, allowed: BoolArray, *, reach: float = np.inf) -> IntArray:
    """Return which marker each point is, shape (n,), −1 where it is none: the least sum of squared distances (Kuhn 1955).

    Arguments:
        model: markers [m], shape (m, 3).
        points: in the same frame [m], shape (n, 3).
        allowed: which marker each point may be, shape (n, m).
        reach: a point farther from its marker is an outlier, and costs that much [m].
    """
    from scipy.optimize import linear_sum_assignment

    names = np.full(len(points), -1, dtype=np.int64)
    if len(points):
        squares = np.where(allowed, squared(points, model), FAR**2)
        limit = min(reach, FAR) ** 2
        rows, columns = linear_sum_assignment(np.minimum(squares, limit))
        names[rows] = np.where(squares[rows, columns] < limit, columns, -1)
    return names


def squared(points: FloatArray, model: FloatArray) -> FloatArray:
    """Return the squared distances [m²] of points (…, n, 3) and markers (m, 3), shape (…, n, m)."""
    return np.asarray(((points[..., :, None, :] - model) ** 2).sum(axis=-1))


def typical_error(squares: FloatArray, room: float, *, repeats: float = 1.0) -> FloatArray:
    """Return the equivalent error of the points [m], shape (…,), including the cost of outliers.

    The nearest h points are markers, with one noise σ_h; the others are uniform in the room. The most likely h is used. The result is the
    noise under which N markers without outliers would be equally likely:  log e = min_h (h log σ_h + (N − h) log room) / N,  σ_h² = Σ_h d² / (3 h − 6 r).

    Arguments:
        squares: squared distances of the points from their markers [m²], shape (…, N).
        room: side of the cube in which an outlier may lie [m].
        repeats: r, frames per state: they share the same model error.
    """
    return _likeliest(squares, room, repeats)[1]


def _likeliest(squares: FloatArray, room: float, repeats: float) -> tuple[FloatArray, FloatArray]:
    """Return σ_h of the likeliest h and e of `typical_error`, each (…,)."""
    N = squares.shape[-1]
    sums = np.cumsum(np.sort(np.minimum(squares, room**2), axis=-1), axis=-1)
    h = np.arange(1, N + 1)
    noise = np.sqrt(sums / np.maximum(3.0 * h - 6.0 * repeats, 1.0) + FINEST**2)
    logs = ((h * np.log(noise) + (N - h) * np.log(room)) / N)[..., min(max(3, N // 2), N) - 1 :]
    best = logs.argmin(axis=-1)[..., None]
    likeliest = np.take_along_axis(noise[..., min(max(3, N // 2), N) - 1 :], best, axis=-1)[..., 0]
    return likeliest, np.exp(np.take_along_axis(logs, best, axis=-1)[..., 0])


def room_of(model: FloatArray) -> float:
    """Return the side [m] of the cube that makes an outlier and a marker error equally likely.

    Outliers are uniform in a cube twice as wide as the markers (m, 3). One point in ten is an outlier; the cube root of the odds 9
    accounts for that.
    """
    return 4.16 * float(np.ptp(model, axis=0).max())


def _squares(
    model: Sequence[FloatArray], seen: Sequence[FloatArray], T: FloatArray, marker: Sequence[IntArray], room: float
) -> FloatArray:
    """Return the squared distances of all points from their markers [m²], shape (N,); those of outliers are the room's."""
    each = [np.where(m >= 0, ((transform_points(T, s) - p[m]) ** 2).sum(axis=1), room**2) for p, s, m in zip(model, seen, marker)]
    return np.concatenate(each)


def _from_triangles(
    model: FloatArray, seen: FloatArray, allowed: BoolArray, rng: np.random.Generator
) -> list[tuple[float, FloatArray]]:
    """Return poses that align triangles of a frame with similar ones of the model, each with the residual of that frame [m]."""
    corners = np.array(list(permutations(range(len(model)), 3)))
    sides = _sides(model[corners])
    result: list[tuple[float, FloatArray]] = []
    for triangle in _triangles(seen, rng):
        fits = allowed[triangle[0], corners[:, 0]] & allowed[triangle[1], corners[:, 1]] & allowed[triangle[2], corners[:, 2]]
        off = np.where(fits, np.abs(sides - _sides(seen[triangle])).max(axis=1), FAR)
        best = np.argpartition(off, ALIKE)[:ALIKE] if len(off) > ALIKE else np.arange(len(off))
        best = best[off[best] < FAR]
        R, t = _laid(model[corners[best]], seen[triangle])
        placed = np.einsum("hij,nj->hni", R, seen) + t[:, None]
        nearest = np.where(allowed, squared(placed, model), FAR**2).min(axis=2)
        score = typical_error(nearest, room_of(model))
        for i in np.argsort(score)[:REFINED]:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = R[i], t[i]
            result.append((float(score[i]), T))
    return result


def _triangles(points: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return triangles of points (n, 3), shape (≤ TRIANGLES, 3): the widest half of those that are drawn."""
    every = np.array(list(combinations(range(len(points)), 3)))
    drawn = every if len(every) <= 2 * TRIANGLES else every[rng.choice(len(every), 2 * TRIANGLES, replace=False)]
    corner = points[drawn]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return np.asarray(drawn[np.argsort(-area)[:TRIANGLES]])


def _sides(corner: FloatArray) -> FloatArray:
    """Return the sides [m] of triangles (…, 3, 3), shape (…, 3)."""
    return np.asarray(np.linalg.norm(corner - np.roll(corner, 1, axis=-2), axis=-1))


def _laid(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations (h, 3, 3) and shifts (h, 3) that take a triangle b (3, 3) best onto triangles a (h, 3, 3)."""
    mean_a, mean_b = a.mean(axis=1), b.mean(axis=0)
    R = rotation_between(a - mean_a[:, None], b - mean_b)
    return R, mean_a - np.einsum("hij,j->hi", R, mean_b)
