"""Completion of objects that are visible from one side: a sphere, a cylinder or a plate is fitted to their points.

The visible point of a touching object that is closest to the body is not the contact point: it lies towards the camera, 5 to 7 mm away for
a ball of 10 mm. The contact point is where the completed object comes closest to the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.pointcloud.objects import euclidean_clusters
from femsense.pointcloud.rays import Surface
from femsense.pointcloud.round_fits import BALL, CYLINDER, ROUND_END, SPHERE, fit_plane, fit_round

LONGER = {"cylinder": (True, False, False), "plate": (True, True, False)}
"""Axes along which a shape can extend beyond its visible points."""
OUTLIERS = 0.05
"""Maximum share of outliers among the points of an edge."""
Fit = Callable[[FloatArray, FloatArray, FloatArray], "Shape"]

FITS = 4.0
"""Maximum median of the squared whitened residuals of an accepted shape, relative to that of noise."""
SIMPLER = 2.0
"""A shape with more parameters must reduce the residual variance by this many standard deviations of that variance."""
LEAST_SCATTER = 0.1
"""Minimum variance of an object's points about its shape, relative to the stated noise."""
ROUGH_STD = 0.006
"""Standard deviation of the surface of an object without a fitting shape [m]."""
LARGEST = 0.1
"""Maximum radius of a sphere or cylinder; a larger one is a plate [m]."""
FIT_STEPS = 25
"""Maximum number of steps of a fit."""
NEAREST, END = 0.1, 0.5
"""A rod touches with its end if this share of its points, the ones nearest to the body, lies within so many radii of the end."""
ROD = 3.0
"""Factor on the extent of the points of a rod relative to other shapes, for the direction of its axis."""
MOST_POINTS = 400
"""Maximum number of points of a fit; more are thinned out."""
FEWEST = 12
"""Minimum number of points of a shape."""
FLAT = 0.01
"""A surface is flat if its depth below the tangent plane is less than this share of the distance."""


@dataclass(frozen=True, eq=False, slots=True)
class Shape:
    """A completed object."""

    kind: str
    """"sphere", "cylinder", "plate", "known" or "points"."""
    center: FloatArray
    """Centre of the sphere, a point of the axis, or the centre of the plate or of the bounding box of a known shape [m], shape (3,)."""
    axes: FloatArray
    """Rows: axis of the cylinder first; sides of the plate, then its normal, shape (3, 3)."""
    half: FloatArray
    """Half extents along the axes [m], shape (3,)."""
    radius: float
    """Radius of curvature of its surface [m]; inf: flat; 0: unknown."""
    std_m: float
    """Standard deviation of its surface [m]."""
    points: FloatArray
    """Its visible points [m], shape (k, 3)."""
    tree: cKDTree | None = field(default=None, repr=False)
    behind_m: float = 0.0
    """Possible distance of its surface behind the visible points: the unknown thickness of a plate that touches with its hidden side
    [m]."""
    surface: Surface | None = field(default=None, repr=False)
    """Surface of a known shape at its pose."""
    covariance: FloatArray | None = field(default=None, repr=False)
    """Covariance of (centre, radius) of a sphere or cylinder [m²], shape (4, 4)."""
    seen_by: FloatArray = field(default_factory=lambda: np.ones(1), repr=False)
    """Share of its points from each camera, shape (v,)."""

    @property
    def radius_std(self) -> float:
        """Standard deviation of the fitted radius [m]; inf without one."""
        return np.inf if self.covariance is None else float(np.sqrt(self.covariance[3, 3]))

    def tilt_std(self, offsets: FloatArray) -> FloatArray:
        """Return the standard deviation of the surface's height at offsets relative to that at their origin [m], shape (k, 3) → (k,).

        The slope of a line through points with the standard deviation σ of their mean, evenly spread over ± h, is known to √3 σ / h.
        """
        ways = {"plate": 2, "cylinder": 1}.get(self.kind, 0)
        share = offsets @ self.axes[:ways].T / np.maximum(self.half[:ways], 1e-9)
        return np.asarray(np.sqrt(3.0) * self.std_m * np.linalg.norm(share, axis=1))

    def moved(self, T: FloatArray) -> Shape:
        """Return the shape moved by a rigid motion, shape (4, 4)."""
        R, t = T[:3, :3], T[:3, 3]
        points = self.points @ R.T + t
        covariance = self.covariance
        if covariance is not None:
            turn = np.eye(4)
            turn[:3, :3] = R
            covariance = turn @ covariance @ turn.T
        return replace(
            self,
            center=R @ self.center + t,
            axes=self.axes @ R.T,
            points=points,
            tree=None if self.tree is None else cKDTree(points),
            surface=None if self.surface is None else Surface(self.surface.positions @ R.T + t, self.surface.triangles),
            covariance=covariance,
        )

    def towards(self, body: FloatArray) -> Shape:
        """Return the shape with the side that faces a body, and the standard deviation of that side; points of the body's surface [m],
            shape (k, 3).

        If a plate is pressed onto the body from the side of the camera, the camera sees its back; its thickness is at most its width. The standard
        deviation of the hidden side of a ball is that of the sum of centre and radius, which are correlated.
        """
        if self.covariance is not None:
            away = body[np.argmin(self.distance(body))] - self.center
            away = away - (away @ self.axes[0]) * self.axes[0] if self.kind == "cylinder" else away
            by = np.append(away / max(float(np.linalg.norm(away)), 1e-12), 1.0)
            return replace(self, std_m=min(float(np.sqrt(by @ self.covariance @ by)), ROUGH_STD))
        if self.kind != "plate":
            return self
        local = (body - self.center) @ self.axes.T
        aside = np.linalg.norm(np.maximum(np.abs(local[:, :2]) - self.half[:2], 0.0), axis=1)
        if local[aside <= aside.min() + self.half[:2].max(), 2].mean() >= 0.0:
            return self
        return replace(self, axes=self.axes * np.array([[1.0], [1.0], [-1.0]]), behind_m=2.0 * float(self.half[:2].min()))

    def distance(self, places: FloatArray, *, within: float = np.inf) -> FloatArray:
        """Return the signed distance of points (k, 3) from its surface [m], > 0 outside, shape (k,); distances above `within` [m] can be
        inf."""
        if self.kind == "points":
            assert self.tree is not None
            return np.asarray(self.tree.query(places, distance_upper_bound=within)[0])
        if self.surface is not None:
            return self.surface.closest(places)[1]
        local = (places - self.center) @ self.axes.T
        if self.kind == "sphere":
            return np.asarray(np.linalg.norm(local, axis=1) - self.radius)
        if self.kind == "cylinder":
            across = np.linalg.norm(local[:, 1:], axis=1) - self.radius
            beyond = np.abs(local[:, 0]) - self.half[0]
            return np.asarray(np.where(beyond > 0, np.hypot(np.maximum(across, 0.0), np.maximum(beyond, 0.0)), across))
        beyond = np.linalg.norm(np.maximum(np.abs(local[:, :2]) - self.half[:2], 0.0), axis=1)
        return np.asarray(np.where(beyond > 0.0, np.hypot(beyond, np.maximum(local[:, 2], 0.0)), local[:, 2]))

    def radius_at(self, place: FloatArray, reach: float) -> float:
        """Return the mean radius of curvature of the surface near a point (3,), over an extent [m]; inf: flat or unknown."""
        if self.surface is None:
            return self.radius if self.radius > 0 else np.inf
        foot, _, triangle, _ = self.surface.closest(place[None])
        a, b, c = self.surface.positions[self.surface.triangles[triangle[0]]]
        plane = np.linalg.svd(np.cross(b - a, c - a)[None])[2][1:]
        angle = np.arange(8) * np.pi / 4
        around = foot + reach * np.column_stack([np.cos(angle), np.sin(angle)]) @ plane
        drop = float(self.surface.closest(around)[1].mean())
        return (reach**2 - drop**2) / (2.0 * drop) if drop > FLAT * reach else np.inf

    def holds(self, points: FloatArray, std: FloatArray) -> bool:
        """Return whether points (k, 3) lie on its surface, or on the extension of a rod or plate beyond its visible points."""
        if self.kind not in ("cylinder", "plate"):
            return self.kind in ("sphere", "known") and bool((np.abs(self.distance(points)) < 3.0 * std).mean() > 0.8)
        longer = replace(self, half=np.where(LONGER[self.kind], np.inf, self.half))
        return bool((np.abs(longer.distance(points)) < 3.0 * std + self.std_m).mean() > 0.8)


def find_shapes(
    points: FloatArray,
    std: FloatArray,
    origins: FloatArray,
    near: FloatArray,
    *,
    local_m: float,
    fit: Fit | None = None,
    is_edge: Callable[[IntArray], bool] | None = None,
    halo: BoolArray | None = None,
    view: IntArray | None = None,
    ends: bool = True,
) -> list[Shape]:
    """Return the objects among points as shapes, each fitted to its part near a surface.

    Arguments:
        points: points of the surroundings [m], shape (o, 3).
        std: noise of each point along its ray [m], shape (o,).
        origins: centre of the camera of each point [m], shape (o, 3).
        near: distance of each point from the surface of the body [m], shape (o,).
        local_m: extent of the part of an object that is fitted, beyond its nearest point [m].
        fit: function that fits a shape to points, noise and origins; `fit_shape` by default.
        is_edge: function that returns whether points, given by indices, belong to the edge of that surface: these are not an object.
        halo: possible depth bleeding around the silhouette of the body, shape (o,): no shape is fitted to these points.
        view: camera of each point, shape (o,); by default the same for all.
        ends: whether rods can end in a hemisphere that is not among the known objects of `fit`.
    """
    fit = fit or fit_shape
    view = np.zeros(len(points), dtype=np.int64) if view is None else view
    cameras = int(view.max(initial=0)) + 1
    result: list[Shape] = []
    left = _groups(points, std)
    while left:
        group, left = left[0], left[1:]
        gap = near[group]
        close = group[gap <= gap.min() + local_m]
        if (
            len(close) < 3
            or (is_edge is not None and is_edge(group))
            or (halo is not None and halo[group].mean() > 1.0 - OUTLIERS)
        ):
            continue
        own = np.ones(len(close), dtype=np.bool_) if halo is None else ~halo[close]
        shape = _completed(fit, points[close], std[close], origins[close], own)
        # the other end of a rod that passes behind the body, or pieces of the table
        more = [g for g in left if shape.holds(points[g], std[g])]
        if more:
            left = [g for g in left if not any(g is m for m in more)]
            close = np.concatenate([close, *more])
            own = np.ones(len(close), dtype=np.bool_) if halo is None else ~halo[close]
            shape = _completed(fit, points[close], std[close], origins[close], own)
        if ends and shape.kind != "plate":
            whole = np.concatenate([group, *more])
            whole = whole if halo is None else whole[~halo[whole]]
            rod = _round_end(points[whole], std[whole], origins[whole], near[whole], ROD * local_m)
        else:
            rod = None
        if rod is not None:
            shape = replace(rod, points=shape.points)
        elif _ends(shape, points[close], near[close]):
            end = near[close] <= near[close].min() + 0.5 * local_m
            cap = _completed(fit, points[close[end]], std[close[end]], origins[close[end]], own[end])
            if cap.kind == "sphere":
                shape = replace(cap, points=shape.points)
        seen_by = np.bincount(view[close], minlength=cameras) / len(close)
        result.append(replace(shape, seen_by=seen_by))
    return result


def _completed(fit: Fit, points: FloatArray, std: FloatArray, origins: FloatArray, own: BoolArray) -> Shape:
    """Return the shape of an object, fitted without the depth bleeding around the silhouette of a body.

    Stereo matching widens a silhouette by one to three pixels with the colour of the background and an intermediate depth. Next to a touching
    finger, these points are connected with the finger's own.
    """
    if own.sum() < FEWEST:
        return _raw(points, std)
    shape = fit(points[own], std[own], origins[own])
    return shape if shape.kind != "points" else _raw(points, std)


def _ends(shape: Shape, points: FloatArray, near: FloatArray) -> bool:
    """Return whether the part of an object nearest to a body is an end of another form than the rest: a fingertip, the end of a rod, a ball
    on a stick. points, near: as for `find_shapes`."""
    if shape.kind == "points":
        return len(points) >= FEWEST
    if shape.kind != "cylinder":
        return False
    nearest = points[near <= np.quantile(near, NEAREST)].mean(axis=0)
    return bool(abs((nearest - shape.center) @ shape.axes[0]) > shape.half[0] - END * shape.radius)


def same_object(first: Shape, second: Shape) -> bool:
    """Return whether two shapes belong to the same object: their points coincide."""
    if first.points is second.points:
        return True
    apart = float(np.linalg.norm(first.points.mean(axis=0) - second.points.mean(axis=0)))
    extent = min(float(np.linalg.norm(np.ptp(one.points, axis=0))) for one in (first, second))
    return apart < 0.5 * extent


def fit_shape(points: FloatArray, std: FloatArray, origins: FloatArray) -> Shape:
    """Return the simplest shape that fits points within their noise; "points" if none does. Arguments as for `find_shapes`."""
    ray = points - origins
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    if len(points) < FEWEST:
        return _raw(points, std)
    thin = slice(None, None, max(1, len(points) // MOST_POINTS))
    share = len(points[thin]) / len(points)
    points, std, ray = points[thin], std[thin], ray[thin]
    tried = [_sphere(points, std, ray, None), _plate(points, std, ray), _cylinder(points, std, ray)]
    good = [(cost, shape) for cost, shape in tried if shape is not None and cost < FITS]
    if not good:
        return _raw(points, std)
    least = min(cost for cost, _ in good)
    order = ("plate", "sphere", "cylinder")
    allowed = least * (1.0 + SIMPLER * np.sqrt(2.0 / len(points))) + 0.02
    fitting = [(cost, shape) for cost, shape in good if cost <= allowed]
    return _as_well_as_it_fits(*min(fitting, key=lambda fit: order.index(fit[1].kind)), share)


def fit_ball(points: FloatArray, std: FloatArray, origins: FloatArray, radius_m: float) -> tuple[float, Shape | None]:
    """Return the robust mean square of the whitened residuals of a ball of known radius (1: noise only), and the ball; None if it does not
    fit.
    """
    ray = points - origins
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    thin = slice(None, None, max(1, len(points) // MOST_POINTS))
    cost, shape = _sphere(points[thin], std[thin], ray[thin], radius_m)
    return cost, _as_well_as_it_fits(cost, shape, len(points[thin]) / len(points)) if shape is not None and cost < FITS else None


def _as_well_as_it_fits(cost: float, shape: Shape, share: float) -> Shape:
    """Return a shape with the standard deviation of its surface from the scatter of its points, `cost` times the stated variance.

    share: share of its points that were fitted.
    """
    scatter = max(cost, LEAST_SCATTER)
    covariance = None if shape.covariance is None else share * scatter * shape.covariance
    return replace(shape, std_m=min(float(np.sqrt(scatter)) * shape.std_m, ROUGH_STD), covariance=covariance)


# --- fits -------------------------------------------------------------------------------------------------------------


def _groups(points: FloatArray, std: FloatArray) -> list[IntArray]:
    """Return connected points, the largest group first."""
    if len(points) < 3:
        return []
    some = points[:: max(1, len(points) // MOST_POINTS)]
    gaps = np.asarray(cKDTree(points, balanced_tree=False, compact_nodes=False).query(some, k=min(4, len(points)))[0])
    spacing = float(np.median(gaps[:, -1]))
    label = euclidean_clusters(points, max(2.5 * spacing, 3.0 * float(np.median(std))), 5)
    return [np.flatnonzero(label == i) for i in range(int(label.max(initial=-1)) + 1)]


def typical_square(residual: FloatArray) -> float:
    """Return the robust mean square of whitened residuals: 1 for noise only."""
    return float((1.483 * np.median(np.abs(residual))) ** 2)


def _sphere(points: FloatArray, std: FloatArray, ray: FloatArray, radius: float | None) -> tuple[float, Shape | None]:
    middle, look = points.mean(axis=0), ray.mean(axis=0)

    starts = [np.append(middle + 0.7 * r * look, np.log(r)) for r in ([radius] if radius is not None else (0.004, 0.01, 0.025))]
    kind, k, known = (SPHERE, 4, 0.0) if radius is None else (BALL, 3, radius)
    tried = [fit_round(kind, points, std, ray, start[:k], steps=FIT_STEPS, radius=known) for start in starts]
    x, curve, residual, _ = min(tried, key=lambda fit: fit[3])
    size = radius if radius is not None else float(np.exp(x[3]))
    seen_from_outside = float(np.mean(np.einsum("pc,pc->p", points - x[:3], ray) < 0))
    if size > LARGEST or seen_from_outside < 0.7:
        return np.inf, None
    by = np.eye(4)[:, :k] * np.append(np.ones(3), size)[:k]
    covariance = by @ np.linalg.pinv(curve) @ by.T
    shape = Shape("sphere", x[:3], np.eye(3), np.full(3, size), size, _spread(curve, 3), points, covariance=covariance)
    return typical_square(residual), shape


def _cylinder(points: FloatArray, std: FloatArray, ray: FloatArray) -> tuple[float, Shape | None]:
    middle, look = points.mean(axis=0), ray.mean(axis=0)
    main = np.linalg.svd(points - middle, full_matrices=False)[2]

    tried = []
    for frame in (main, main[[1, 2, 0]]):
        for r in (0.003, 0.01):
            start = np.array([0.7 * r * look @ frame[1], 0.7 * r * look @ frame[2], np.log(r), 0.0, 0.0])
            fit = fit_round(CYLINDER, points, std, ray, start, steps=FIT_STEPS, frame=frame, middle=middle)
            tried.append((*fit, frame))
    x, curve, residual, _, frame = min(tried, key=lambda fit: fit[3])
    axis = frame[0] + x[3] * frame[1] + x[4] * frame[2]
    axis = axis / np.linalg.norm(axis)
    center = middle + x[0] * frame[1] + x[1] * frame[2]
    away = (points - center) - np.outer((points - center) @ axis, axis)
    size = float(np.exp(x[2]))
    if size > LARGEST or np.mean(np.einsum("pc,pc->p", away, ray) < 0) < 0.7:
        return np.inf, None
    low, high = np.quantile((points - center) @ axis, [0.01, 0.99])
    axes = np.vstack([axis, np.linalg.svd(axis[None])[2][1:]])
    half = np.array([0.5 * (high - low), size, size])
    by = np.zeros((4, 5))
    by[:3, :2], by[3, 2] = frame[1:].T, size
    covariance = by @ np.linalg.pinv(curve) @ by.T
    middle = center + 0.5 * (low + high) * axis
    shape = Shape("cylinder", middle, axes, half, size, _spread(curve, 2), points, covariance=covariance)
    return typical_square(residual), shape


def _round_end(points: FloatArray, std: FloatArray, origins: FloatArray, near: FloatArray, reach_m: float) -> Shape | None:
    """Return the hemisphere at the touching end of a rod as a sphere: a fingertip, a rounded stick. None if the points do not belong to
    such a rod, or do not show its end.

    Of the hemisphere itself only a part is visible, next to the silhouette of the body; the side of the rod determines radius and axis.

    Arguments:
        points, std, origins, near: as for `find_shapes`, of one object.
        reach_m: extent of the fitted part beyond its nearest point [m].
    """
    if len(points) < 2 * FEWEST or not np.isfinite(reach_m):
        return None
    within = np.flatnonzero(near <= near.min() + reach_m)
    within = within[:: max(1, len(within) // MOST_POINTS)]
    points, std, near = points[within], std[within], near[within]
    ray = points - origins[within]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    middle, look = points.mean(axis=0), ray.mean(axis=0)
    frame = np.linalg.svd(points - middle, full_matrices=False)[2]
    nearest = points[near <= np.quantile(near, NEAREST)].mean(axis=0)
    frame = frame * np.array([[np.sign((nearest - middle) @ frame[0])], [1.0], [1.0]])
    last = float(((points - middle) @ frame[0]).max())
    tried = []
    for r in (0.003, 0.01):
        start = np.array([0.7 * r * look @ frame[1], 0.7 * r * look @ frame[2], np.log(r), 0.0, 0.0, last - r])
        tried.append(fit_round(ROUND_END, points, std, ray, start, steps=FIT_STEPS, frame=frame, middle=middle))
    x, curve, residual, _ = min(tried, key=lambda fit: fit[3])
    axis = frame[0] + x[3] * frame[1] + x[4] * frame[2]
    axis = axis / np.linalg.norm(axis)
    center, size = middle + x[0] * frame[1] + x[1] * frame[2] + x[5] * axis, float(np.exp(x[2]))
    along = (points - center) @ axis
    away = points - center - np.outer(np.minimum(along, 0.0), axis)
    covariance = np.linalg.pinv(curve)
    cost = typical_square(residual)
    if (
        size > LARGEST
        or cost > FITS
        or float(np.mean(np.einsum("pc,pc->p", away, ray) < 0)) < 0.7
        or (nearest - center) @ axis < -END * size
        or float(along.min()) > -size
        or covariance[5, 5] > (END * size) ** 2
    ):
        return None
    by = np.zeros((4, 6))
    by[:3, :2], by[3, 2] = frame[1:].T, size
    by[:3, 3], by[:3, 4], by[:3, 5] = x[5] * frame[1], x[5] * frame[2], axis
    shape = Shape(
        "sphere", center, np.eye(3), np.full(3, size), size, _spread(curve, 2), points, covariance=by @ covariance @ by.T
    )
    return _as_well_as_it_fits(cost, shape, 1.0)


def least_squares(
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray]], x: FloatArray, *, steps: int | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return parameters, curvature and whitened residual of a robust fit (Huber, Levenberg's damping)."""
    damping = 1e-3
    residual, J = evaluate(x)
    cost = _huber(residual)
    for _ in range(steps or FIT_STEPS):
        weight = np.minimum(1.0, 2.0 / np.maximum(np.abs(residual), 1e-12))
        curve = J.T @ (weight[:, None] * J)
        step = -np.linalg.solve(curve + damping * np.diag(np.diag(curve) + 1e-12), J.T @ (weight * residual))
        there, slope = evaluate(x + np.clip(step, -1.0, 1.0))
        new = _huber(there)
        if new < cost:
            done = cost - new < 1e-4 * cost
            x, residual, J, cost, damping = x + np.clip(step, -1.0, 1.0), there, slope, new, 0.2 * damping
            if done:
                break
        else:
            damping *= 10.0
    return x, np.asarray(J.T @ J), residual


def _huber(residual: FloatArray) -> float:
    size = np.abs(residual)
    return float(np.where(size <= 2.0, size**2, 2.0 * (2.0 * size - 2.0)).sum())


def _plate(points: FloatArray, std: FloatArray, ray: FloatArray) -> tuple[float, Shape | None]:
    middle, axes, residual, keep = fit_plane(points, std, ray)
    if keep.sum() < FEWEST:
        return np.inf, None
    low, high = np.quantile((points[keep] - middle) @ axes[:2].T, [0.01, 0.99], axis=0)
    center = middle + 0.5 * (low + high) @ axes[:2]
    half = np.append(0.5 * (high - low), 0.0)
    spread = float(np.median(std) / np.sqrt(keep.sum()))
    return typical_square(residual), Shape("plate", center, axes, half, np.inf, spread, points)


def _spread(curve: FloatArray, count: int) -> float:
    """Return the standard deviation of the first parameters from the curvature of the misfit [m]; ROUGH_STD if they are not determined."""
    variance = float(np.trace(np.linalg.pinv(curve)[:count, :count])) / count
    return min(float(np.sqrt(variance)), ROUGH_STD) if variance > 0 else ROUGH_STD


def _raw(points: FloatArray, std: FloatArray) -> Shape:
    return Shape("points", points.mean(axis=0), np.eye(3), np.zeros(3), 0.0, ROUGH_STD, points, cKDTree(points))
