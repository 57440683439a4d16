"""What is reported of a fitted frame: contacts with their standard deviations and tracks."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.sensing.model import Fit, Model
from femsense.sensing.touches import contact_radius, touch_normal
from femsense.sensing.tracks import place_of, size_std, tracked
from femsense.sensing.types import ContactForce, SensedFrame

SAME = 0.15
"""A contact nearer than this share of the diagonal to one of the previous frame continues its track."""


def contacts_of(model: Model, best: Fit, previous: SensedFrame | None) -> tuple[ContactForce, ...]:
    """Return the contacts of a fit; those that begin a track have track −1, those at given places the number of their place."""
    sensor, k = model.sensor, best.frame.index
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    found: list[ContactForce] = []
    for i, (contact, force) in enumerate(zip(best.contacts, best.forces)):
        size, normal = float(np.linalg.norm(force)), touch_normal(sensor, contact, best.state)
        if size == 0.0 and contact.source != "given":
            continue
        own = covariance_of(model, best, i)
        std = size_std(force, own) if size > 0.0 else float(np.sqrt(max(float(normal @ own @ normal), 0.0)))
        found.append(
            ContactForce(
                frame=number,
                time_s=stamp,
                contact=len(found),
                position_m=contact.patch.mean(best.state.positions),
                normal=normal,
                force_n_xyz=force,
                force_n=size,
                std_n=std,
                source=contact.source,
                track=place_of(sensor, contact) if contact.source == "given" else -1,
                position_std_m=freeze(np.sqrt(np.maximum(np.diag(best.place_covariance[i]), 0.0))),
                radius_m=contact_radius(sensor, contact.object_radius_m, size),
                force_std_n_xyz=freeze(np.sqrt(np.maximum(np.diag(own), 0.0))),
            )
        )
    return tuple(tracked(found, () if previous is None else previous.contacts, SAME * sensor.size))


def covariance_of(model: Model, best: Fit, i: int) -> FloatArray:
    """Return the covariance of the force of contact i [N²], shape (3, 3): of the fit, and of the model's compliance."""
    force = best.forces[i]
    own = best.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
    return np.asarray(own + model.compliance_std**2 * np.outer(force, force))
