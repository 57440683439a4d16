"""Drift of the camera pose and of the rest shape, measured in contact-free frames."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import TetMesh, surface_triangles
from femsense.pointcloud.rays import Surface

POINTS = 2000
DEGREE = np.pi / 180.0


@dataclass(frozen=True, slots=True)
class DriftLimits:
    """Thresholds for reporting drift."""

    share: float = 0.01
    """Smallest displacement of camera or surface, as a share of the body's diagonal; smaller changes are within the model error."""
    significance: float = 4.0
    """Smallest change, in standard errors of the mean over `frames`."""
    frames: int = 5
    """Number of measurements that are averaged, for the reference too."""
    every_s: float = 1.0
    reach: float = 0.05
    """Points farther from the surface than this share of the body's diagonal are not assigned to the robot."""
    patches: int = 24
    fewest: int = 20
    """Minimum number of points of a patch."""


@dataclass(frozen=True, slots=True)
class Drift:
    """The change since the reference."""

    position_m: float
    """Displacement of the camera relative to the robot [m]."""
    rotation_rad: float
    shape_m: float
    """Root mean square change of the distance between cloud and modelled surface that the pose does not fit [m]."""
    is_moved: bool
    """Whether displacement or rotation exceed their thresholds."""
    is_deformed: bool
    """Whether the change of shape exceeds its threshold."""

    @property
    def text(self) -> str:
        """The changes that exceed their thresholds, in words; empty if none does."""
        parts = []
        if self.is_moved:
            parts.append(
                f"the pose by {1e3 * self.position_m:.1f} mm and {self.rotation_rad / DEGREE:.1f}°: the camera or the base moved"
            )
        if self.is_deformed:
            parts.append(f"the rest shape by {1e3 * self.shape_m:.1f} mm: creep, temperature or a changed zero of the inputs")
        return "; ".join(parts) + ("; press t to use the present state as reference" if parts else "")


class DriftWatch:
    """Compares contact-free frames with the first ones.

    In each frame a pose step (rotation ω about the centre, displacement t) is fitted to the signed distances of the points, by robust least
    squares of n·(ω × p + t) = −distance; the mean residual of each surface patch is its change of shape.
    """

    def __init__(self, mesh: TetMesh, limits: DriftLimits | None = None) -> None:
        self.limits = limits or DriftLimits()
        self._triangles = surface_triangles(mesh)
        self._tets = mesh.tets
        middles = mesh.nodes[self._triangles].mean(axis=1)
        self._size = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))
        self._patch = _patches(middles, self.limits.patches)
        self._recent: deque[FloatArray] = deque(maxlen=self.limits.frames)
        self._reference: tuple[FloatArray, FloatArray] | None = None
        self._last_s = float("-inf")

    def is_due(self, time_s: float) -> bool:
        """Return whether a contact-free frame at this time [s] is due for a measurement."""
        return time_s - self._last_s >= self.limits.every_s

    def measure(self, time_s: float, points: FloatArray, nodes: FloatArray) -> Drift | None:
        """Process a contact-free frame; return the drift relative to the first ones, None while these are collected.

        Arguments:
            time_s: of the frame [s].
            points: measured, robot frame [m], shape (k, 3).
            nodes: of the estimated body state [m], shape (n, 3).
        """
        self._last_s = time_s
        found = self._fit(points[:: max(1, len(points) // POINTS)], nodes)
        if found is None:
            return None
        self._recent.append(found)
        if len(self._recent) < self.limits.frames:
            return None
        mean, error = self._mean()
        if self._reference is None:
            self._reference = mean, error
            self._recent.clear()
            return None
        change = mean - self._reference[0]
        error = np.hypot(error, self._reference[1])
        sizes, errors = (
            np.array([_rms(v[:3]) * np.sqrt(3.0), _rms(v[3:6]) * np.sqrt(3.0), _rms(v[6:])]) for v in (change, error)
        )
        limits = self.limits.share * np.array(
            [1.0, self._size, self._size]
        )  # a rotation is compared through the displacement at body size
        passed = (sizes > limits) & (sizes > self.limits.significance * errors)
        rotation, position, shape = (float(size) for size in sizes)
        return Drift(position, rotation, shape, bool(passed[:2].any()), bool(passed[2]))

    def _mean(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean of the recent measurements and its standard error; nan for patches that were not visible in all."""
        found = np.array(self._recent)
        return found.mean(axis=0), found.std(axis=0, ddof=1) / np.sqrt(len(found))

    def _fit(self, points: FloatArray, nodes: FloatArray) -> FloatArray | None:
        """Return pose step (6) and patch distances [m], shape (6 + patches,); nan for patches with too few points."""
        surface = Surface(nodes, self._triangles)
        place, gap, triangle, _ = surface.closest(points)
        near = np.abs(gap) < self.limits.reach * self._size
        if near.sum() < 10 * self.limits.patches:
            return None
        place, gap, triangle = place[near], gap[near], triangle[near]
        corners = nodes[self._triangles[triangle]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        turn = np.cross(place - nodes.mean(axis=0), normal) / self._size
        rows = np.hstack([turn, normal])
        weight: FloatArray = np.ones(len(gap))
        step: FloatArray = np.zeros(6)
        for _ in range(3):  # Huber weights: points of objects close to the robot are outliers
            step = np.asarray(np.linalg.lstsq(rows * weight[:, None], gap * weight, rcond=1e-6)[0], dtype=np.float64)
            left = gap - rows @ step
            scale = 1.483 * float(np.median(np.abs(left))) + 1e-9
            weight = np.asarray(np.sqrt(np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(left), 1e-12))))
        patch = self._patch[triangle]
        counts = np.bincount(patch, minlength=self.limits.patches)
        sums = np.bincount(patch, weights=left, minlength=self.limits.patches)
        shape = np.where(counts >= self.limits.fewest, sums / np.maximum(counts, 1), np.nan)
        return np.concatenate([step[:3] / self._size, step[3:], shape])


def _rms(values: FloatArray) -> float:
    """Return the root mean square of the finite values; 0 if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt((known**2).mean())) if len(known) else 0.0


def _patches(middles: FloatArray, count: int) -> FloatArray:
    """Return the patch of each triangle: the nearest of evenly spread points of the surface."""
    from scipy.spatial import cKDTree

    from femsense.xr.skeleton import farthest_points

    seeds = middles[farthest_points(middles, min(count, len(middles)))]
    return np.asarray(cKDTree(seeds).query(middles)[1])
