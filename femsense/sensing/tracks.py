"""Contacts of a frame, their identity over frames (tracks), and their forces averaged over time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.fem.equilibrium import Equilibrium
from femsense.sensing.touches import contact_radius, touch_normal
from femsense.sensing.types import ContactForce, SensedFrame, Sensor, Touch

SAME = 0.15
"""A contact closer than this share of the body's diagonal to one of the previous frame, in space or on the body, is the same."""


def contacts_of(
    sensor: Sensor,
    k: int,
    touches: Sequence[Touch],
    forces: FloatArray,
    covariances: Iterable[FloatArray],
    place_covariances: Iterable[FloatArray],
    state: Equilibrium,
    previous: SensedFrame | None,
) -> tuple[ContactForce, ...]:
    """Return the contacts of frame k. New ones have track −1, those at given contact points the number of that point.

    Arguments:
        forces: [N], shape (m, 3).
        covariances: covariance of each force [N²], shape (3, 3).
        place_covariances: covariance of each contact point [m²], shape (3, 3).
        state: the equilibrium under the forces.
    """
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    found: list[ContactForce] = []
    for touch, force, own, place in zip(touches, forces, covariances, place_covariances):
        size, normal = float(np.linalg.norm(force)), touch_normal(sensor, touch, state)
        std = size_std(force, own) if size > 0.0 else float(np.sqrt(max(float(normal @ own @ normal), 0.0)))
        found.append(
            ContactForce(
                frame=number,
                time_s=stamp,
                contact=len(found),
                position_m=touch.patch.mean(state.positions),
                normal=normal,
                force_n_xyz=force,
                force_n=size,
                std_n=std,
                source=touch.source,
                track=place_of(sensor, touch) if touch.source == "given" else -1,
                position_std_m=freeze(np.sqrt(np.maximum(np.diag(place), 0.0))),
                radius_m=contact_radius(sensor, touch.object_radius_m, size),
                force_std_n_xyz=freeze(np.sqrt(np.maximum(np.diag(own), 0.0))),
            )
        )
    return tuple(found) if previous is None else tuple(tracked(found, touches, previous, SAME * sensor.size))


def place_of(sensor: Sensor, touch: Touch) -> int:
    """Return which of the given contact points a contact is at."""
    return int(np.linalg.norm(sensor.places - touch.place, axis=1).argmin())


def size_std(force: FloatArray, covariance: FloatArray) -> float:
    """Return the root mean square error of the magnitude of a force [N], to second order in its components.

    With the variance σ² along the force, the covariance C across it and the magnitude f: σ² + (2 tr C² + (tr C)²) / 4f². The second term matters
    because a poorly determined transverse component shrinks to zero in the fit and can only increase the magnitude.

    Arguments:
        force: the force [N], shape (3,), not zero.
        covariance: covariance of its components [N²], shape (3, 3).
    """
    size = float(np.linalg.norm(force))
    along = force / size
    project = np.eye(3) - np.outer(along, along)
    across = project @ covariance @ project
    second = (2.0 * float((across**2).sum()) + float(np.trace(across)) ** 2) / (4.0 * size**2)
    second = min(second, float(np.trace(across)))  # limit for forces that are small relative to their standard deviation
    return float(np.sqrt(max(float(along @ covariance @ along), 0.0) + second))


def smoothed(contacts: Sequence[ContactForce], time_constant_s: float) -> list[ContactForce]:
    """Return the contacts with forces averaged over their track by a first-order low-pass filter with this time constant [s]; 0:
    unchanged."""
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


def tracked(contacts: list[ContactForce], touches: Sequence[Touch], previous: SensedFrame, reach: float) -> list[ContactForce]:
    """Return the contacts with the tracks of the nearest ones of the previous frame; each track is used once.

    A contact is followed where it stays on the body, which may move far between two frames, and where it stays in space, as an object
    does along which the body slides: the smaller one of both distances counts.

    Arguments:
        touches: the contacts as they were fitted, with their places at rest.
        reach: largest distance of a contact from its place in the previous frame [m].
    """
    pairs = sorted(
        (min(_distance(contact.position_m, old.position_m), _distance(touch.place, old_touch.place)), i, j)
        for i, (contact, touch) in enumerate(zip(contacts, touches))
        for j, (old, old_touch) in enumerate(zip(previous.contacts, previous.touches))
    )
    taken: set[int] = set()
    for distance, i, j in pairs:
        if distance <= reach and contacts[i].track < 0 and j not in taken:
            contacts[i] = replace(contacts[i], track=previous.contacts[j].track)
            taken.add(j)
    return contacts


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(a - b))
