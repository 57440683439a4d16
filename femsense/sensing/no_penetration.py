"""Rigid objects and the body do not overlap: the gap g between them as residual rows.

g(x) is the smallest signed distance between the surface of the body and a completed or declared object. The row measures the object's
surface as a pixel measures the body's, so pose and error field of the camera enter it in the same way.

An object that does not touch is anywhere within ℓ of the body: density 1/ℓ for g > 0, a Gaussian tail for g < 0. One that touches has g = 0 ± σ_g, or is
not where it seems with probability ε. Relative to the first, a contact costs

    −2 log[(1 − ε) ℓ/(√2π σ_g) exp(−z²/2) + ε],   z = g/σ_g

which is negative if the object lies at the surface: such a contact is likely even without a force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.inference.pixels import rows_on
from femsense.inference.rows import Rows
from femsense.pointcloud.primitives import Shape, same_object
from femsense.sensing.model import Frame, Model
from femsense.sensing.places import NEAR
from femsense.sensing.types import Touch

MISPLACED = 0.1
"""ε: probability that the observed position of a touching object is wrong, because its depth has another error than the body's or its shape
was not recognised."""
OVERLAPPING = 0.01
"""Probability that an object apparently overlaps the body although it does not touch."""
GAP_STD = 1e-4
"""Standard deviation of a gap in addition to that of the object's surface: facets, and the position of the pressure on them [m]."""
LATTICE = np.array([[i, j, 4 - i - j] for i in range(5) for j in range(5 - i)]) / 4.0
"""Barycentric points of a triangle at which the gap is evaluated, shape (15, 3)."""
SLOPE = 1e-5
"""Step of the central difference of a distance [m]."""
TOUCHING = 2.0
"""An object touches if its gap is below this many standard deviations."""
ZONE = 3.0
"""If an object has several contacts, surface points within this many edges of a contact point belong to that contact."""
COMPLETED = ("sphere", "cylinder", "plate", "known")
"""Kinds of objects with a known surface."""


def gap_rows(model: Model, frame: Frame, contacts: Sequence[Touch], positions: FloatArray) -> list[Rows]:
    """Return one row for each contact with an object of known surface, and one for each object that overlaps the body elsewhere."""
    rows = []
    for contact in contacts:
        if is_rigid(model, contact):
            assert contact.shape is not None
            shape = contact.shape.towards(positions[model.sensor.surface.nodes])
            shared = sum(is_with(other, contact.shape) for other in contacts) > 1
            at = _closest(model, shape, positions, contact.place if shared else None)
            if at is not None:
                rows.append(_row(model, shape, *at, positions, odds=_density(model, contact)[1]))
    for own in frame.objects:
        stands = any(same_object(own, one) for one in model.sensor.overlapping)
        if _is_known(model, own) and not stands and not any(is_with(contact, own) for contact in contacts):
            shape = own.towards(positions[model.sensor.surface.nodes])
            at = _closest(model, shape, positions, None)
            if at is not None and at[2] < 0.0 and shape.behind_m == 0.0:
                rows.append(_row(model, shape, *at, positions, odds=float(np.log(OVERLAPPING))))
    return rows


def is_with(contact: Touch, shape: Shape | None) -> bool:
    """Return whether a contact is with this object, whichever side touches."""
    return contact.shape is not None and shape is not None and same_object(contact.shape, shape)


def is_rigid(model: Model, contact: Touch) -> bool:
    """Return whether a contact is with an object whose surface is known at the contact. Of a plate, this is the visible side."""
    return contact.shape is not None and _is_known(model, contact.shape) and contact.shape.behind_m == 0.0


def _is_known(model: Model, shape: Shape) -> bool:
    """Return whether the uncertainty of an object's surface is below the resolution of the mesh."""
    return shape.kind in COMPLETED and gap_std(model, shape) < model.sensor.surface.edge


def in_touch(model: Model, contact: Touch, positions: FloatArray) -> bool:
    """Return whether the gap of an object with a known surface is at most two standard deviations."""
    if not is_rigid(model, contact):
        return False
    assert contact.shape is not None
    at = _closest(model, contact.shape.towards(positions[model.sensor.surface.nodes]), positions, None)
    return at is not None and at[2] < TOUCHING * gap_std(model, contact.shape)


def gap_odds(model: Model, contact: Touch) -> float:
    """Return −2 log of the density of a gap of 0 of a touching object, relative to an object anywhere near the body; 0 if its surface is
    unknown."""
    return -2.0 * _density(model, contact)[0] if is_rigid(model, contact) else 0.0


def _density(model: Model, contact: Touch) -> tuple[float, float]:
    """Return log[(1 − ε) ℓ/(√2π σ)] and the log odds ε √2π σ / ((1 − ε) ℓ) that the object is not where it seems."""
    assert contact.shape is not None
    top = float(np.log((1.0 - MISPLACED) * NEAR * model.sensor.size / (np.sqrt(2.0 * np.pi) * gap_std(model, contact.shape))))
    return top, float(np.log(MISPLACED)) - top


def gap_std(model: Model, shape: Shape) -> float:
    """Return σ_g of an object [m]: from the correlated noise of its pixels, and from facets."""
    return float(np.hypot(np.sqrt(model.overdispersion) * shape.std_m, GAP_STD))


def _closest(model: Model, shape: Shape, positions: FloatArray, near: FloatArray | None) -> tuple[int, FloatArray, float] | None:
    """Return triangle, barycentric weights and gap [m] of the surface point closest to an object; None if none is near.

    Arguments:
        near: restrict the search to a zone about this point at rest [m], shape (3,).
    """
    sensor, surface = model.sensor, model.sensor.surface
    considered = sensor.touchable
    if near is not None:
        middle = model.skin.rest[surface.triangles[considered]].mean(axis=1)
        considered = considered[np.linalg.norm(middle - near, axis=1) < ZONE * surface.edge]
    if not len(considered):
        return None
    by_node = np.full(len(positions), np.inf)
    by_node[surface.nodes] = shape.distance(positions[surface.nodes], within=2.0 * surface.edge + 0.02 * sensor.size)
    by_corner = by_node[surface.triangles[considered]].min(axis=1)
    least = float(by_corner.min())
    if not np.isfinite(least):
        return None
    close = considered[by_corner <= least + surface.edge]
    places = np.einsum("wi,tic->twc", LATTICE, positions[surface.triangles[close]])
    gap = shape.distance(places.reshape(-1, 3)).reshape(len(close), -1)
    t, w = np.unravel_index(int(np.argmin(gap)), gap.shape)
    return int(close[t]), LATTICE[w], float(gap[t, w])


def _row(
    model: Model,
    shape: Shape,
    triangle: int,
    weights: FloatArray,
    gap: float,
    positions: FloatArray,
    *,
    odds: float,
) -> Rows:
    """Return the row of a gap [m] at a surface point."""
    place = weights @ positions[model.skin.triangles[triangle]]
    step = SLOPE * np.eye(3)
    slope = shape.distance(place + step) - shape.distance(place - step)
    direction = slope / max(float(np.linalg.norm(slope)), 1e-12)
    rows = rows_on(
        model.skin,
        positions,
        np.array([triangle]),
        weights[None],
        direction[None],
        np.array([-gap]),
        np.array([gap_std(model, shape)]),
        np.array([odds]),
        np.ones(1),
        (place - gap * direction)[None],
        np.zeros(1, dtype=np.int64),
        1,
        pixel=False,
    )
    seen_by = np.pad(shape.seen_by, (0, model.views - len(shape.seen_by)))
    corners = positions[model.skin.triangles[triangle]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    # The error field is defined along the outward normal of the body; this row points approximately the other way.
    facing = float(direction @ normal) / max(float(np.linalg.norm(normal)), 1e-12)
    by_pose = (seen_by[:, None] * rows.by_pose).reshape(1, -1)
    return replace(rows, field=rows.field * facing, camera=seen_by[None], by_pose=by_pose)
