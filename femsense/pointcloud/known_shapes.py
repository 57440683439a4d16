"""Registration of objects of known shape to their visible points: point to surface, from many initial rotations, by Gauss–Newton.

The residual of a point is its distance from the surface along the normal there, over its noise along the ray (Chen and
Medioni 1992). Points are measured from outside, so poses in which the surface faces away from the camera are excluded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from femsense.core.arrays import FloatArray, IntArray
from femsense.pointcloud.primitives import FITS, MOST_POINTS, ROUGH_STD, Shape, least_squares, typical_square
from femsense.pointcloud.rays import Surface

FACETS = 48
"""Number of facets of a cylinder; the error of its surface is 0.2 % of the radius."""
COARSE = 60
"""Number of points for the coarse fits that select rotations."""
COARSE_STEPS, FULL_FITS = 8, 3
"""Steps of a coarse fit, and number of rotations that are fitted to all points."""
DEPTH = 0.35
"""Initial distance of the centre of an object behind its visible points, relative to its extent along the view."""
LOST = 5.0
"""Cap of the whitened residuals when poses are compared."""
SPREAD = 72
"""Number of random rotations in addition to those along the principal axes of the visible points."""


@dataclass(frozen=True, eq=False, slots=True)
class KnownShape:
    """The closed surface of an object in its own frame, with outward triangles."""

    points: FloatArray
    """[m], shape (n, 3)."""
    triangles: IntArray
    """Shape (t, 3)."""

    @property
    def middle(self) -> FloatArray:
        """Centre of its bounding box [m], shape (3,)."""
        return np.asarray(0.5 * (self.points.min(axis=0) + self.points.max(axis=0)))

    @property
    def reach(self) -> float:
        """Half the diagonal of its bounding box [m]."""
        return 0.5 * float(np.linalg.norm(np.ptp(self.points, axis=0)))


def cylinder_shape(radius_m: float, length_m: float) -> KnownShape:
    """Return a cylinder centred at the origin, with its axis along z."""
    angle = 2.0 * np.pi * np.arange(FACETS) / FACETS
    ring = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    ends = [np.column_stack([ring, np.full(FACETS, z)]) for z in (-0.5 * length_m, 0.5 * length_m)]
    points = np.vstack([*ends, [[0.0, 0.0, -0.5 * length_m], [0.0, 0.0, 0.5 * length_m]]])
    i = np.arange(FACETS)
    j = (i + 1) % FACETS
    low, high = np.full(FACETS, 2 * FACETS), np.full(FACETS, 2 * FACETS + 1)
    sides = [(i, j, FACETS + j), (i, FACETS + j, FACETS + i), (j, i, low), (FACETS + i, FACETS + j, high)]
    return KnownShape(points, np.vstack([np.column_stack(side) for side in sides]).astype(np.int64))


def register(known: KnownShape, points: FloatArray, std: FloatArray, origins: FloatArray) -> tuple[float, Shape | None]:
    """Return the robust mean square of the whitened residuals of the best pose (1: noise only) and the shape at that pose; None if no pose
    fits.

    Arguments:
        known: the shape.
        points: visible points of one object [m], shape (k, 3).
        std: noise of each point along its ray [m], shape (k,).
        origins: centre of the camera of each point [m], shape (k, 3).
    """
    ray = points - origins
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    if float(np.quantile(away, 0.95)) > 2.0 * known.reach:
        return np.inf, None  # larger than the object
    view = _View(known, *_thinned(points, std, ray, MOST_POINTS))
    few = _View(known, *_thinned(points, std, ray, COARSE))
    coarse = sorted((few.fit(few.start(turn), COARSE_STEPS) for turn in _turns(points)), key=lambda fit: fit.misfit)
    best = min((view.fit(view.fit(rough).pose) for rough in (fit.pose for fit in coarse[:FULL_FITS])), key=lambda fit: fit.misfit)
    score = typical_square(best.residual)
    return score, _shape(view, best) if score < FITS else None


Pose = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False, slots=True)
class _Fit:
    pose: Pose  # rotation (3, 3) and translation (3,) of the object
    curve: FloatArray  # curvature of the misfit by (rotation about the mean of the points, shift), (6, 6)
    residual: FloatArray  # whitened residuals, (k,)
    misfit: float


@dataclass(frozen=True, eq=False, slots=True)
class _View:
    """The visible points of an object."""

    known: KnownShape
    points: FloatArray
    std: FloatArray
    ray: FloatArray

    def start(self, turn: FloatArray) -> Pose:
        """Return the initial pose of a rotation, with the centre behind the visible points."""
        look = self.ray.mean(axis=0)
        depth = DEPTH * float(np.ptp(self.known.points @ turn.T @ look))
        return turn, self.points.mean(axis=0) + depth * look - turn @ self.known.middle

    def fit(self, start: Pose, steps: int | None = None) -> _Fit:
        """Return the best pose near a start, fitted to the faces that face the camera."""
        middle, seen = self.points.mean(axis=0), self._seen(start[0])
        scale = np.append(np.full(3, 1.0 / self.known.reach), np.ones(3))  # rotations as displacement at the object's end

        def pose(x: FloatArray) -> Pose:
            more = Rotation.from_rotvec(scale[:3] * x[:3]).as_matrix()
            return more @ start[0], more @ (start[1] - middle) + middle + x[3:]

        def evaluate(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            residual, J = self._residual(seen, pose(x))
            return residual, J * scale

        x, curve, residual = least_squares(evaluate, np.zeros(6), steps=steps)
        return _Fit(pose(x), curve / np.outer(scale, scale), residual, float(np.minimum(np.abs(residual), LOST).sum()))

    def _seen(self, turn: FloatArray) -> Surface:
        """Return the faces of the object that face the camera."""
        corners = self.known.points[self.known.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        looks = normal @ turn.T @ self.ray.mean(axis=0) < 0.0
        return Surface(self.known.points, self.known.triangles[looks])

    def _residual(self, seen: Surface, pose: Pose) -> tuple[FloatArray, FloatArray]:
        """Return the whitened residuals at a pose, and their derivatives by (rotation about the mean of the points, shift), shape (k,
        6)."""
        turn, shift = pose
        local = (self.points - shift) @ turn
        place, _, triangle, _ = seen.closest(local)
        own = local - place
        corners = seen.positions[seen.triangles[triangle]]
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-300)
        gap = np.linalg.norm(own, axis=1) * np.where(np.einsum("pc,pc->p", own, face) < 0, -1.0, 1.0)
        away = np.abs(gap) > 1e-7  # next to an edge, the gradient is the direction to the closest point
        normal = np.where(away[:, None], own / np.where(away, gap, 1.0)[:, None], face) @ turn.T
        scale = self.std * np.maximum(np.abs(np.einsum("pc,pc->p", normal, self.ray)), 0.2)
        arm = self.points - self.points.mean(axis=0)
        return gap / scale, np.hstack([-np.cross(arm, normal), -normal]) / scale[:, None]


def _shape(view: _View, fit: _Fit) -> Shape:
    """Return the object at its pose, with the standard deviation of its surface along the normals from that of the pose."""
    turn, shift = fit.pose
    vertices = view.known.points @ turn.T + shift
    corners = vertices[view.known.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal, middle = normal / np.maximum(area, 1e-300), corners.mean(axis=1)
    J = np.hstack([np.cross(middle - view.points.mean(axis=0), normal), normal])
    variance = np.einsum("ti,ij,tj->t", J, np.linalg.pinv(fit.curve), J)
    std = float(np.sqrt(np.average(np.maximum(variance, 0.0), weights=area.ravel())))
    half = 0.5 * np.ptp(view.known.points, axis=0)
    center = turn @ view.known.middle + shift
    return Shape(
        "known", center, turn.T, half, 0.0, min(std, ROUGH_STD), view.points, surface=Surface(vertices, view.known.triangles)
    )


def _turns(points: FloatArray) -> list[FloatArray]:
    """Return initial rotations: the 24 alignments of the axes of the object with the principal axes of the points, and random ones."""
    main = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2].T
    main[:, 2] *= np.sign(np.linalg.det(main))
    along = [main @ turn for turn in Rotation.create_group("O").as_matrix()]
    return along + list(Rotation.random(SPREAD, random_state=0).as_matrix())


def _thinned(points: FloatArray, std: FloatArray, ray: FloatArray, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    thin = slice(None, None, max(1, len(points) // most))
    return points[thin], std[thin], ray[thin]
