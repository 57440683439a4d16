"""Contacts of a frame, who they were in the frame before, and their forces averaged over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.fem.equilibrium import Equilibrium
from femsense.model.drive import has_history
from femsense.sensing.judge import unspoken
from femsense.sensing.law import law_std, response_std
from femsense.sensing.touches import contact_radius, touch_normal
from femsense.sensing.types import ContactForce, Fit, SensedFrame, Sensor, Touch

SAME = 0.15
"""A contact nearer than this share of the body's diagonal to one of the frame before is the same one: it slid."""


def contacts_of(sensor: Sensor, k: int, fit: Fit, free: Equilibrium, previous: SensedFrame | None) -> tuple[ContactForce, ...]:
    """Return the contacts of a fit, `free` the state without them; those that begin a track have track −1.

    A contact at a given place is that place's all along, whatever its force is.
    """
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    contacts: list[ContactForce] = []
    cloudy = fit.rows.of_clouds
    response = response_std(sensor.knowledge, len(sensor.calibration.poses)) if cloudy else 0.0
    before = previous.state.segment_tensions if previous is not None and has_history(sensor.robot) else None
    law, shifted = (
        law_std(sensor, k, fit, free, before) if cloudy else (np.zeros(len(fit.touches)), np.zeros((len(fit.touches), 3)))
    )
    shares = np.hypot(response, law)
    for i, (touch, force) in enumerate(zip(fit.touches, fit.forces)):
        size, normal = float(np.linalg.norm(force)), touch_normal(sensor, touch, fit.state)
        if (size == 0.0 and touch.source != "given") or unspoken(fit, i):
            continue
        along = force / size if size > 0 else -normal
        own = fit.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] + shares[i] ** 2 * np.outer(force, force)
        contacts.append(
            ContactForce(
                frame=number,
                time_s=stamp,
                contact=len(contacts),
                position_m=touch.patch.mean(fit.state.positions),
                normal=normal,
                force_n_xyz=force,
                force_n=size,
                std_n=size_std(force, own) if size > 0 else float(np.sqrt(max(float(along @ own @ along), 0.0))),
                source=touch.source,
                track=place_of(sensor, touch) if touch.source == "given" else -1,
                position_std_m=freeze(np.hypot(place_std(touch, fit.place_covariance[i]), shifted[i])),
                radius_m=contact_radius(sensor, touch.object_radius_m, size),
                force_std_n_xyz=freeze(np.sqrt(np.maximum(np.diag(own), 0.0))),
            )
        )
    return tuple(tracked(contacts, () if previous is None else previous.contacts, SAME * sensor.size))


def place_of(sensor: Sensor, touch: Touch) -> int:
    """Return which of the given places a touch is at."""
    return int(np.linalg.norm(sensor.places - touch.place, axis=1).argmin())


def place_std(touch: Touch, covariance: FloatArray) -> FloatArray:
    """Return how well the place of a contact is known along each axis [m], shape (3,).

    Where the fit held a place that is seen (its force was none in the frame before, so that the shape says nothing of it), it is known as it is seen.

    Arguments:
        touch: the contact.
        covariance: of its place by the fit [m²], shape (3, 3).
    """
    held = touch.across_m if touch.source == "cloud" and touch.std_m == 0.0 else 0.0
    along = held**2 * (1.0 - touch.normal**2)
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0) + along))


def size_std(force: FloatArray, covariance: FloatArray) -> float:
    """Return the root mean square by which the size of a force may be off [N], to second order in its components.

    Its variance along the force, and what the components across add: one that the shape hardly shows shrinks to zero in the fit, so that it
    can only make the force larger. With C across and f the size: (2 tr C² + (tr C)²) / 4f².

    Arguments:
        force: [N], shape (3,), not zero.
        covariance: of its components [N²], shape (3, 3).
    """
    size = float(np.linalg.norm(force))
    along = force / size
    project = np.eye(3) - np.outer(along, along)
    across = project @ covariance @ project
    second = (2.0 * float((across**2).sum()) + float(np.trace(across)) ** 2) / (4.0 * size**2)
    second = min(second, float(np.trace(across)))  # a force that is little beside its deviation: no more than that
    return float(np.sqrt(max(float(along @ covariance @ along), 0.0) + second))


def smoothed(contacts: Sequence[ContactForce], time_constant_s: float) -> list[ContactForce]:
    """Return contacts whose forces are averaged over their track (first order, lagging by the time constant) [s]; 0 leaves them as they are."""
    if time_constant_s <= 0.0:
        return list(contacts)
    last: dict[int, ContactForce] = {}
    result = []
    for contact in contacts:
        before = last.get(contact.track)
        if before is not None:
            share = 1.0 - np.exp(-(contact.time_s - before.time_s) / time_constant_s)
            force = before.force_n_xyz + share * (contact.force_n_xyz - before.force_n_xyz)
            contact = replace(contact, force_n_xyz=force, force_n=float(np.linalg.norm(force)))
        last[contact.track] = contact
        result.append(contact)
    return result


def tracked(contacts: list[ContactForce], before: Sequence[ContactForce], reach: float) -> list[ContactForce]:
    """Return contacts with the tracks of the nearest ones of the frame before, each taken once."""
    pairs = sorted(
        (float(np.linalg.norm(c.position_m - b.position_m)), i, j) for i, c in enumerate(contacts) for j, b in enumerate(before)
    )
    taken: set[int] = set()
    for distance, i, j in pairs:
        if distance <= reach and contacts[i].track < 0 and j not in taken:
            contacts[i] = replace(contacts[i], track=before[j].track)
            taken.add(j)
    return contacts
