"""The side of a body that a camera sees: points spread over the surface, and from where the body itself does not hide them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.pose import transform_points
from femsense.pointcloud.rays import Surface

EYES, HIDDEN = 100, 0.01
"""Directions from which the body is looked at beforehand, and what lies in front of a part that is hidden, as a share of the diagonal:
walls of chambers and folds of a bellows face a camera that does not see them."""


def size_of(surface: Surface) -> float:
    """Return the diagonal of the surface [m]."""
    return float(np.linalg.norm(np.ptp(surface.positions[np.unique(surface.triangles)], axis=0)))


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Points spread over a surface, and from where each is seen."""

    places: FloatArray
    """[m], shape (p, 3)."""
    normals: FloatArray
    """Outward, shape (p, 3)."""
    eyes: FloatArray
    """Directions to a camera far away, shape (e, 3)."""
    seen: BoolArray
    """What nothing of the body hides from each of them, shape (e, p)."""

    def looking(self, T_camera_robot: FloatArray, slant: float) -> tuple[FloatArray, BoolArray]:
        """Return the points in the camera's frame [m], and which of them it sees, by more than a cosine."""
        placed, facing = transform_points(T_camera_robot, self.places), self.normals @ T_camera_robot[:3, :3].T
        to_camera = -placed.mean(axis=0) @ T_camera_robot[:3, :3]
        bare = self.seen[int(np.argmax(self.eyes @ to_camera))]
        return placed, bare & (np.einsum("pc,pc->p", facing, placed) < -slant * np.linalg.norm(placed, axis=1))


def spread_samples(surface: Surface, count: int) -> Samples:
    """Return points spread over the surface by area."""
    a, b, c = (surface.positions[surface.triangles[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    w = rng.dirichlet(np.ones(3), size=len(chosen))[:, :, None]
    places = w[:, 0] * a[chosen] + w[:, 1] * b[chosen] + w[:, 2] * c[chosen]
    eyes = _directions()
    return Samples(
        places, cross[chosen] / area[chosen][:, None], eyes, np.stack([bare_from(surface, places, eye) for eye in eyes])
    )


def bare_from(surface: Surface, places: FloatArray, eye: FloatArray) -> BoolArray:
    """Return which places of a surface the body does not hide from a direction, shape (p,).

    Arguments:
        surface: surface of the body.
        places: on it [m], shape (p, 3).
        eye: unit vector to a camera far away, shape (3,).
    """
    size = size_of(surface)
    origins = places + 2.0 * size * eye
    met = surface.cast(places, origins, reach=np.inf)
    before = np.linalg.norm(met.place(surface.positions) - origins[met.index], axis=1)
    bare = np.ones(len(places), dtype=bool)
    bare[met.index] = before > (2.0 - HIDDEN) * size
    return bare


def _directions() -> FloatArray:
    """Return directions spread evenly over the sphere, shape (EYES, 3) (Fibonacci's spiral)."""
    k = np.arange(EYES) + 0.5
    up, around = 1.0 - 2.0 * k / EYES, np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.sqrt(1.0 - up**2) * np.cos(around), np.sqrt(1.0 - up**2) * np.sin(around), up], axis=1)
