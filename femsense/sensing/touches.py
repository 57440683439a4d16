"""A possible contact: its patch, its normal, its friction cone, and the nodal forces of its force."""

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
"""Radius over which a point force is spread, in edges of elements. The shape functions of a linear element are an edge wide themselves:
with a patch as wide as an edge, the force would also act on the neighbouring faces."""
DENT = 0.035
"""Radius of the patch of a given contact with markers only, relative to the body's diagonal. Markers do not show the area of a contact, and
a small patch would move a neighbouring marker by a dent that does not exist (1 mm at the upper marker of the beam of the beam study)."""
ALIKE = 0.05
"""Patches with radii that differ by less than this share are equal. Other values change forces by 0.1 %
(docs/appendix/forces-before-0.2.md)."""


def make_touch(
    sensor: Sensor,
    place: FloatArray,
    *,
    source: str,
    std_m: float = 0.0,
    normal: FloatArray | None = None,
    radius: float = np.inf,
    spread: float = 0.0,
    along: FloatArray | None = None,
) -> Touch:
    """Return a contact at the surface point closest to a given point, both at rest [m], shape (3,)."""
    nodes = sensor.robot.body.mesh.nodes
    at = closest_surface_point(sensor.surface, nodes, place, facing=normal)
    patch = _patch(sensor, at, normal, spread, along)
    outward = patch.mean(vertex_normals(nodes, sensor.surface.triangles))
    outward = outward / max(float(np.linalg.norm(outward)), 1e-12) if normal is None else normal
    return Touch(at, outward, patch, at, std_m, source, radius, spread, along)


def _patch(sensor: Sensor, place: FloatArray, normal: FloatArray | None, spread: float, along: FloatArray | None) -> ContactPatch:
    body = sensor.robot.body
    radius = max(_radius(sensor), spread)
    return patch_at(sensor.surface, body.mesh.nodes, place, radius, body.clamped, facing=normal, along=along)


def _radius(sensor: Sensor) -> float:
    """Return the minimum radius of a patch [m]."""
    halved = sensor.robot.body.mesh.is_quadratic  # the edges of the surface are half those of quadratic elements
    edge = sensor.surface.edge * (2.0 if halved else 1.0)
    return PATCH * edge if sensor.recording.has_clouds else max(PATCH * edge, DENT * sensor.size)


def pressed(sensor: Sensor, touch: Touch, force: FloatArray) -> Touch:
    """Return a contact with the patch of its object under a force [N], shape (3,), if that is larger than the resolution of the mesh."""
    if touch.source != "cloud" or not np.isfinite(touch.object_radius_m):
        return touch
    spread = contact_radius(sensor, touch.object_radius_m, float(np.linalg.norm(force)))
    least = _radius(sensor)
    if abs(max(spread, least) - max(touch.spread_m, least)) < ALIKE * least:
        return touch
    return replace(touch, patch=_patch(sensor, touch.place, None, spread, touch.along), spread_m=spread)


def without_object(sensor: Sensor, touch: Touch) -> Touch:
    """Return an inferred contact at the place of a visible one, which may be anywhere on the surface and of which no zone is known."""
    std = float(np.sqrt(sensor.surface.area.sum() / (2.0 * np.pi)))
    return replace(touch, source="shape", std_m=std, line=np.zeros(3), along=None, expected=touch.place, shape=None, pulls=False)


def longer_patch(sensor: Sensor, touch: Touch, times: float) -> ContactPatch:
    """Return the patch of a line or face contact whose zone has half axes of so many times the length."""
    assert touch.along is not None
    return _patch(sensor, touch.place, None, times * touch.spread_m, times * touch.along)


def contact_radius(sensor: Sensor, radius: float, force: float) -> float:
    """Return the radius of the patch of a rigid ball [m] by Hertz: a³ = 3 F R (1 − ν²) / (4 E), half an edge if R is unknown."""
    material = sensor.robot.body.material
    if not np.isfinite(radius):
        return 0.5 * sensor.surface.edge
    modulus, poisson = float(np.median(material.young_modulus)), float(np.median(material.poisson_ratio))
    return float(np.cbrt(0.75 * force * radius * (1.0 - poisson**2) / modulus))


def touch_normal(sensor: Sensor, touch: Touch, state: Equilibrium) -> FloatArray:
    """Return the outward unit normal of the deformed surface at a contact, shape (3,)."""
    mean = touch.patch.mean(vertex_normals(state.positions, sensor.surface.triangles))
    return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def tangents_of(normal: FloatArray) -> FloatArray:
    """Return two orthonormal tangents, shape (2, 3)."""
    return np.asarray(np.linalg.svd(normal[None])[2][1:])


def ways_of(touch: Touch) -> tuple[FloatArray, FloatArray]:
    """Return two tangents of the surface at rest, shape (2, 3), and the prior σ of the contact point along each [m], shape (2,)."""
    along = touch.line - touch.normal * (touch.line @ touch.normal)
    size = float(np.linalg.norm(along))
    if size < 0.1:  # no line, or one that points into the body at the new contact point
        return tangents_of(touch.normal), np.full(2, touch.std_m)
    stds = np.array([touch.std_m, touch.across_m]) if touch.std_m > 0 else np.zeros(2)
    return np.stack([along / size, np.cross(touch.normal, along / size)]), stds


def moved_to(sensor: Sensor, touch: Touch, place: FloatArray) -> Touch:
    """Return the contact moved to the surface point closest to another point at rest [m], shape (3,); its prior is kept."""
    there = make_touch(sensor, place, source=touch.source, spread=touch.spread_m, along=touch.along)
    return replace(touch, place=there.place, normal=there.normal, patch=there.patch)


def nodal_forces(touches: Sequence[Touch], forces: FloatArray, nodes: int) -> FloatArray:
    """Return the nodal forces of contact forces (m, 3) [N], shape (nodes, 3)."""
    return np.asarray(sum((t.patch.spread(f, nodes) for t, f in zip(touches, forces)), np.zeros((nodes, 3))))


def nodal_forces_by_shift(sensor: Sensor, touch: Touch, tangent: FloatArray, force: FloatArray) -> FloatArray:
    """Return the derivative of the nodal forces by the contact point along a tangent [N/m], shape (n, 3)."""
    n, step = len(sensor.robot.body.mesh.nodes), 0.5 * sensor.surface.edge
    if touch.std_m == 0 or not force.any():
        return np.zeros((n, 3))
    there = (touch.place + s * step * tangent for s in (1.0, -1.0))
    ahead, behind = (_patch(sensor, place, touch.normal, touch.spread_m, touch.along) for place in there)
    return np.asarray((ahead.spread(force, n) - behind.spread(force, n)) / (2.0 * step))
