"""A robot: its body, the points measured on it, and the transmission from commands to inputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.fem.body import BodyModel
from femsense.fem.mesh import Embedding, embed_points, surface_triangles
from femsense.model.marker_correction import Correction


@dataclass(frozen=True, eq=False, slots=True)
class Actuation:
    """From recorded inputs to true ones, one value a cable, in the order of the body's cables, and a chamber."""

    gain: FloatArray
    """true = gain × recorded [1], shape (a,)."""
    tension_offset: FloatArray
    """true = max(0, recorded + offset) [N], shape (a,); at rest too."""
    displacement_offset: FloatArray
    """true = recorded + offset [m], shape (a,)."""
    slack: FloatArray
    """Play that is taken up before a cable pulls [m], shape (a,)."""
    coupling: FloatArray | None = None
    """Share of the scaled input of each cable (column) that is added to each other one (row) [1], shape (a, a); None: none."""
    pressure_gain: FloatArray = field(default_factory=lambda: freeze(np.ones(())))
    """true = gain × recorded + offset [1], shape (c,) in the order of the body's chambers, or () for all."""
    pressure_offset: FloatArray = field(default_factory=lambda: freeze(np.zeros(())))
    """[Pa], of the same shape; at rest too."""

    def scaled(self, recorded: FloatArray) -> FloatArray:
        """Return recorded inputs of the cables, (F, a), after gain and coupling."""
        inputs = self.gain * recorded
        return np.asarray(inputs if self.coupling is None else inputs + inputs @ self.coupling.T)


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """The errors between body points and measured points."""

    depth_scale: float = 1.0
    """measured distance along the ray = scale × true distance + offset [1]."""
    depth_offset: float = 0.0
    """[m]."""
    corrections: tuple[Callable[[FloatArray], FloatArray], ...] = ()
    """Corrections by a user's effects, applied afterwards: measured points [m], (k, 3), camera frame → corrected points."""


@dataclass(frozen=True, eq=False, slots=True)
class MarkerLook:
    """How a marker looks in a colour image."""

    name: str
    aruco_id: int | None = None
    """Number of the ArUco tag whose centre it is; None if it is not a tag."""
    color_rgb: FloatArray | None = None
    """Colour of the dot whose centre it is, each in [0, 1], shape (3,); None if it is not a dot."""


@dataclass(frozen=True, eq=False, slots=True)
class Robot:
    """A robot: a finite-element body with cables and chambers, markers, candidate contact points, and the effects of its model."""

    name: str
    """Name of the robot."""
    body: BodyModel
    """Finite-element model of the body, with cables and chambers."""
    marker_names: tuple[str, ...]
    """Name of each marker."""
    marker_points: FloatArray
    """Positions of the k markers at rest [m], shape (k, 3)."""
    markers: Embedding
    """Embedding of the markers in the mesh: their elements and shape functions."""
    features: IntArray
    """Surface nodes that serve as feature points, spread evenly over the free surface, shape (e,)."""
    color_rgb: FloatArray | None
    """Colour of the body, used to segment images, sRGB from 0 to 1, shape (3,); None: unknown."""
    actuation: Actuation
    """Effects between recorded and true inputs: offsets, gains, friction."""
    observation: Observation
    """Effects between true and measured positions: scale of depths, marker offsets."""
    creep: tuple[tuple[float, float], ...] = ()
    """Terms (fraction [1], time [s]) of the creep compliance."""
    document: dict[str, Any] | None = None
    """The declared robot.toml (before effects), as plain tables; None where the robot was made in Python."""
    folder: Path | None = None
    """Folder of robot.toml and the mesh."""
    marker_share: FloatArray | None = None
    """Share by which each marker follows the body, shape (k,): 1 on the body, 0 on the clamp; None: all on the body."""
    softening: tuple[tuple[float, float], ...] = ()
    """Terms (share [1], energy [J/m³]) by which elements soften that have been loaded before (see `model/softening.py`)."""
    by_recording: tuple[Callable[[Robot, str], Robot], ...] = ()
    """Effects whose values differ between recordings: (robot, label of a recording) → the robot in that recording, applied in order."""
    marker_looks: tuple[MarkerLook, ...] = ()
    """Appearance of the markers that are detected in colour images."""
    aruco_dictionary: str = "4X4_50"
    """Dictionary of the ArUco tags, by its OpenCV name."""
    correction: Correction | None = None
    """Empirical correction of the markers beyond all effects; used on request."""
    surface_points: int = 0
    """Number of markers, at the end, that are surface points at which clouds are measured, not physical markers."""

    def __repr__(self) -> str:
        mesh, drives = self.body.mesh, [*self.body.cable_names, *self.body.chamber_names]
        return (
            f"Robot({self.name}: {len(mesh.tets)} tetrahedra; {', '.join(drives) or 'no input'}; {len(self.marker_names)} "
            f"markers)"
        )

    def require_correction(self) -> Correction:
        """Return the correction. Raises InputError where there is none."""
        if self.correction is None:
            raise InputError(
                "this robot has no correction",
                where=self.folder or self.name,
                expected="[correction] in robot.toml",
                hint="femsense improve --correct learns one, and hands it back where it helps on held-out data",
            )
        return self.correction

    def with_body(self, body: BodyModel) -> Robot:
        """Return the robot with another body on the same mesh."""
        return replace(self, body=body)

    def in_recording(self, label: str) -> Robot:
        """Return the robot as it is in a recording with this label (`Recording.label`)."""
        robot = replace(self, by_recording=()) if self.by_recording else self
        for change in self.by_recording:
            robot = change(robot, label)
        return robot

    @property
    def glued_names(self) -> tuple[str, ...]:
        """Names of the markers that are glued to the robot, without surface points."""
        return self.marker_names[: len(self.marker_names) - self.surface_points]

    def with_surface_points(self, points: FloatArray) -> Robot:
        """Return the robot with p points of its surface at rest [m], shape (p, 3), appended to its markers."""
        names = tuple(f"surface {i + 1}" for i in range(len(points)))
        share = None if self.marker_share is None else np.concatenate([self.marker_share, np.ones(len(points))])
        more = replace(
            self, marker_names=(*self.marker_names, *names), marker_share=share, surface_points=self.surface_points + len(points)
        )
        return more.with_marker_points(np.vstack([self.marker_points.reshape(-1, 3), points]))

    def without_surface_points(self) -> Robot:
        """Return the robot without the surface points that were appended to its markers."""
        k = len(self.glued_names)
        share = None if self.marker_share is None else self.marker_share[:k]
        return replace(
            self,
            marker_names=self.glued_names,
            marker_points=self.marker_points[:k],
            markers=self.markers[np.arange(k)],
            marker_share=share,
            surface_points=0,
        )

    def with_marker_points(self, points: FloatArray) -> Robot:
        """Return the robot with its k markers at other positions at rest [m], shape (k, 3)."""
        return replace(self, marker_points=freeze(points), markers=self.tie_markers(points))

    def tie_markers(self, places: FloatArray) -> Embedding:
        """Return the embedding of all k markers in the mesh, at given positions at rest [m], shape (k, 3)."""
        ties = embed_points(self.body.mesh, places)
        return ties if self.marker_share is None else ties.following(places, self.marker_share)


def plain_actuation(cable_count: int) -> Actuation:
    """Return the transmission of cables whose true inputs equal the recorded ones."""
    one, zero = np.ones(cable_count), np.zeros(cable_count)
    return Actuation(freeze(one), freeze(zero), freeze(zero), freeze(zero))


def spread_features(body: BodyModel, count: int, *, among: IntArray | None = None) -> IntArray:
    """Return surface nodes spread evenly over the free surface (farthest-point sampling), shape (≤ count,).

    Only nodes `among` the given ones are taken, if given. Nodes of the clamp do not count; the first is the free surface node
    that is farthest from the clamp, so that the result is the same whatever the numbering.
    """
    surface = np.unique(surface_triangles(body.mesh)) if among is None else among
    free = np.setdiff1d(surface, body.clamped)
    if not len(free) or count <= 0:
        return np.zeros(0, dtype=np.int64)
    x = body.mesh.nodes[free]
    anchor = body.mesh.nodes[body.clamped].mean(axis=0) if len(body.clamped) else x.mean(axis=0)
    first = int(np.argmax(np.linalg.norm(x - anchor, axis=1)))
    return freeze(free[spread_points(x, count, first=first)], np.int64)


def spread_points(points: FloatArray, count: int, *, first: int = 0, apart: float = -1.0) -> IntArray:
    """Return which of some points (p, q) are spread evenly among them (farthest-point sampling), farther than `apart` from each other, shape (≤ count,)."""
    if not len(points) or count <= 0:
        return np.zeros(0, dtype=np.int64)
    chosen = [first]
    distance = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < min(count, len(points)) and distance.max() > apart:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.int64)
