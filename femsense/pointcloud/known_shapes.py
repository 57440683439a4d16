"""Objects whose shape is known, registered to what is seen of them: point to surface, from many turns, by Gauss–Newton.

The residual of a point is its distance from the surface along the normal there, over its noise along the ray (Chen and
Medioni 1992). Points are seen from outside, so a pose where the surface looks away from the camera is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from femsense.core.arrays import FloatArray, IntArray
from femsense.pointcloud.primitives import FITS, MOST_POINTS, ROUGH_STD, Shape, least_squares, typical_square
from femsense.pointcloud.rays import Surface

FACETS = 48
"""Sides of a cylinder: its surface is off by 0.2 % of the radius."""
COARSE = 60
"""Points that tell which turns are worth a full fit."""
COARSE_STEPS, FULL_FITS = 8, 3
"""Steps of a fit to these, and how many of the best turns are fitted to all."""
DEPTH = 0.35
"""The middle of an object lies so much of its extent along the view behind what is seen of it."""
LOST = 5.0
"""Where poses are compared, a whitened residual counts as this at most."""
SPREAD = 72
"""Turns that are tried beside those along the main axes of what is seen."""


@dataclass(frozen=True, eq=False, slots=True)
class KnownShape:
    """The surface of an object in its own frame, closed and outward."""

    points: FloatArray
    """[m], shape (n, 3)."""
    triangles: IntArray
    """Shape (t, 3)."""

    @property
    def middle(self) -> FloatArray:
        """Middle of its box [m], shape (3,)."""
        return np.asarray(0.5 * (self.points.min(axis=0) + self.points.max(axis=0)))

    @property
    def reach(self) -> float:
        """Half the diagonal of its box [m]."""
        return 0.5 * float(np.linalg.norm(np.ptp(self.points, axis=0)))


def cylinder_shape(radius_m: float, length_m: float) -> KnownShape:
    """Return a cylinder about its centre with its axis along z."""
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
    """Return the robust mean square of whitened residuals of the best pose (1: noise alone) and the shape there.

    None where none fits.

    Arguments:
        known: the shape.
        points: what is seen of one object [m], shape (k, 3).
        std: noise of each along its ray [m], shape (k,).
        origins: where its ray begins [m], shape (k, 3).
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
    pose: Pose  # turn (3, 3) and shift (3,) of the object
    curve: FloatArray  # of the misfit, over (rotation about the points' middle, shift), (6, 6)
    residual: FloatArray  # whitened, (k,)
    misfit: float


@dataclass(frozen=True, eq=False, slots=True)
class _View:
    """What is seen of an object."""

    known: KnownShape
    points: FloatArray
    std: FloatArray
    ray: FloatArray

    def start(self, turn: FloatArray) -> Pose:
        """Return the pose of a turn whose middle lies behind what is seen."""
        look = self.ray.mean(axis=0)
        depth = DEPTH * float(np.ptp(self.known.points @ turn.T @ look))
        return turn, self.points.mean(axis=0) + depth * look - turn @ self.known.middle

    def fit(self, start: Pose, steps: int | None = None) -> _Fit:
        """Return the pose near a start that fits best, by the faces that look at the camera there."""
        middle, seen = self.points.mean(axis=0), self._seen(start[0])
        scale = np.append(np.full(3, 1.0 / self.known.reach), np.ones(3))  # turns as way at the object's end

        def pose(x: FloatArray) -> Pose:
            more = Rotation.from_rotvec(scale[:3] * x[:3]).as_matrix()
            return more @ start[0], more @ (start[1] - middle) + middle + x[3:]

        def evaluate(x: FloatArray) -> tuple[FloatArray, FloatArray]:
            residual, J = self._residual(seen, pose(x))
            return residual, J * scale

        x, curve, residual = least_squares(evaluate, np.zeros(6), steps=steps)
        return _Fit(pose(x), curve / np.outer(scale, scale), residual, float(np.minimum(np.abs(residual), LOST).sum()))

    def _seen(self, turn: FloatArray) -> Surface:
        """Return the faces of the object that look at the camera."""
        corners = self.known.points[self.known.triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        looks = normal @ turn.T @ self.ray.mean(axis=0) < 0.0
        return Surface(self.known.points, self.known.triangles[looks])

    def _residual(self, seen: Surface, pose: Pose) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals at a pose, and their slopes by (rotation about the points' middle, shift), shape (k, 6)."""
        turn, shift = pose
        local = (self.points - shift) @ turn
        place, _, triangle, _ = seen.closest(local)
        own = local - place
        corners = seen.positions[seen.triangles[triangle]]
        face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-300)
        gap = np.linalg.norm(own, axis=1) * np.where(np.einsum("pc,pc->p", own, face) < 0, -1.0, 1.0)
        away = np.abs(gap) > 1e-7  # beside an edge the direction to the closest point is the slope
        normal = np.where(away[:, None], own / np.where(away, gap, 1.0)[:, None], face) @ turn.T
        scale = self.std * np.maximum(np.abs(np.einsum("pc,pc->p", normal, self.ray)), 0.2)
        arm = self.points - self.points.mean(axis=0)
        return gap / scale, np.hstack([-np.cross(arm, normal), -normal]) / scale[:, None]


def _shape(view: _View, fit: _Fit) -> Shape:
    """Return the object at its pose; its surface is known as the pose moves it along its normals."""
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
    """Return rotations: the object's axes along the main axes of the points in each of 24 ways, and others spread at random."""
    main = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2].T
    main[:, 2] *= np.sign(np.linalg.det(main))
    along = [main @ turn for turn in Rotation.create_group("O").as_matrix()]
    return along + list(Rotation.random(SPREAD, random_state=0).as_matrix())


def _thinned(points: FloatArray, std: FloatArray, ray: FloatArray, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    thin = slice(None, None, max(1, len(points) // most))
    return points[thin], std[thin], ray[thin]
