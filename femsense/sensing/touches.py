"""Where a force may act: its contact patch, its normal, its friction cone, and the nodal forces it stands for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import vertex_normals
from femsense.model.contact_patch import ContactPatch, closest_surface_point, patch_at
from femsense.sensing.types import Sensor, Touch

PATCH = 0.455
"""Radius over which a point force is spread, in edges of elements. A linear element's shape functions are an edge wide themselves: a patch as wide
as the edge would press on the faces beside the one that is touched."""
DENT = 0.035
"""Markers do not show over what area a force acts at a given place: it is spread over so much of the body's diagonal, so that a marker beside it
does not feel a dent that is not there (the beam of the beam study: 1 mm at the marker on its upper edge)."""
ALIKE = 0.05
"""Patches whose radii differ by less than this share are alike: any other value changes forces by 0.1 % (docs/appendix/forces-before-0.2.md)."""


def make_touch(
    sensor: Sensor,
    place: FloatArray,
    *,
    source: str,
    std_m: float = 0.0,
    normal: FloatArray | None = None,
    radius: float = np.inf,
    spread: float = 0.0,
) -> Touch:
    """Return a touch at the point of the surface at rest that is closest to a place at rest [m], shape (3,)."""
    nodes = sensor.robot.body.mesh.nodes
    at = closest_surface_point(sensor.surface, nodes, place, facing=normal)
    patch = _patch(sensor, at, normal, spread)
    outward = patch.mean(vertex_normals(nodes, sensor.surface.triangles))
    outward = outward / max(float(np.linalg.norm(outward)), 1e-12) if normal is None else normal
    return Touch(at, outward, patch, at, std_m, source, radius, spread)


def _patch(sensor: Sensor, place: FloatArray, normal: FloatArray | None, spread: float) -> ContactPatch:
    body = sensor.robot.body
    return patch_at(sensor.surface, body.mesh.nodes, place, max(_radius(sensor), spread), body.clamped, facing=normal)


def _radius(sensor: Sensor) -> float:
    """Return the least radius of a patch [m]."""
    halved = sensor.robot.body.mesh.is_quadratic  # the surface halves edges of quadratic elements
    edge = sensor.surface.edge * (2.0 if halved else 1.0)
    return PATCH * edge if sensor.recording.has_clouds else max(PATCH * edge, DENT * sensor.size)


def pressed(sensor: Sensor, touch: Touch, force: FloatArray) -> Touch:
    """Return a touch with the patch that its object makes under a force [N], shape (3,), where that is wider than what the mesh can tell from a point."""
    if touch.source != "cloud" or not np.isfinite(touch.object_radius_m):
        return touch
    spread = contact_radius(sensor, touch.object_radius_m, float(np.linalg.norm(force)))
    least = _radius(sensor)
    if abs(max(spread, least) - max(touch.spread_m, least)) < ALIKE * least:
        return touch
    return replace(touch, patch=_patch(sensor, touch.place, None, spread), spread_m=spread)


def contact_radius(sensor: Sensor, radius: float, force: float) -> float:
    """Return the radius of the patch of a rigid ball [m] by Hertz: a³ = 3 F R (1 − ν²) / (4 E), half an edge where R is not known."""
    material = sensor.robot.body.material
    if not np.isfinite(radius):
        return 0.5 * sensor.surface.edge
    modulus, poisson = float(np.median(material.young_modulus)), float(np.median(material.poisson_ratio))
    return float(np.cbrt(0.75 * force * radius * (1.0 - poisson**2) / modulus))


def touch_normal(sensor: Sensor, touch: Touch, state: Equilibrium) -> FloatArray:
    """Return the outward unit normal of the deformed surface at a touch, shape (3,)."""
    mean = touch.patch.mean(vertex_normals(state.positions, sensor.surface.triangles))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def tangents_of(normal: FloatArray) -> FloatArray:
    """Return two unit vectors across a normal, shape (2, 3)."""
    return np.asarray(np.linalg.svd(normal[None])[2][1:])


def ways_of(touch: Touch) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors along the surface at rest, shape (2, 3), and how well the place is known along each [m], shape (2,)."""
    along = touch.line - touch.normal * (touch.line @ touch.normal)
    size = float(np.linalg.norm(along))
    if size < 0.1:  # no line, or one that goes into the body where the place has moved to
        return tangents_of(touch.normal), np.full(2, touch.std_m)
    stds = np.array([touch.std_m, touch.across_m]) if touch.std_m > 0 else np.zeros(2)
    return np.stack([along / size, np.cross(touch.normal, along / size)]), stds


def moved_to(sensor: Sensor, touch: Touch, place: FloatArray) -> Touch:
    """Return a touch at the point of the surface at rest closest to another place [m], shape (3,); what is expected of it stays."""
    there = make_touch(sensor, place, source=touch.source, spread=touch.spread_m)
    return replace(touch, place=there.place, normal=there.normal, patch=there.patch)


def nodal_forces(touches: Sequence[Touch], forces: FloatArray, nodes: int) -> FloatArray:
    """Return the forces on so many nodes that forces (m, 3) at some touches stand for [N], shape (nodes, 3)."""
    return np.asarray(sum((t.patch.spread(f, nodes) for t, f in zip(touches, forces)), np.zeros((nodes, 3))))


def nodal_forces_by_shift(sensor: Sensor, touch: Touch, tangent: FloatArray, force: FloatArray) -> FloatArray:
    """Return how nodal forces change when the place moves along a tangent, per metre [N/m], shape (n, 3)."""
    n, step = len(sensor.robot.body.mesh.nodes), 0.5 * sensor.surface.edge
    if touch.std_m == 0 or not force.any():
        return np.zeros((n, 3))
    ahead, behind = (_patch(sensor, touch.place + s * step * tangent, touch.normal, touch.spread_m) for s in (1.0, -1.0))
    return np.asarray((ahead.spread(force, n) - behind.spread(force, n)) / (2.0 * step))
