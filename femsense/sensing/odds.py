"""L = −2 log of the prior odds of a contact against its absence.

| contact | prior odds | why |
|---|---|---|
| visible, at an observed object | 1 : 10 | one in ten objects near the body touches it; times the density of its gap (`no_penetration`) |
| … whose pixels fit no shape | 1 : 10 more | a fragment of the scene, or depth bleeding at a silhouette |
| inferred | 1 : 1000 | one frame in 1000; contact-free frames of the same recording lower the odds |
| … that pushes on a visible part of the surface | 1 : 10 more | its object would be visible, or hide the surface |
| … that hangs | 1 : 10 more | a thread or a thin hook, along gravity |
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from femsense.core.arrays import BoolArray, FloatArray
from femsense.inference.rows import Rows
from femsense.sensing.no_penetration import gap_odds
from femsense.sensing.types import Touch

if TYPE_CHECKING:
    from femsense.sensing.model import Model

VISIBLE = float(2.0 * np.log(10.0))
INFERRED = float(2.0 * np.log(1000.0))
UNRESOLVED = float(2.0 * np.log(10.0))
IN_SIGHT = float(2.0 * np.log(10.0))
HANGING = float(2.0 * np.log(10.0))
SEEN_BY = 3
"""A point is visible if at least this many pixels of the robot lie within an edge of it."""


def odds_of(model: Model, contact: Touch, rows: Rows) -> float:
    """Return L of a contact in a frame with these rows."""
    if contact.source == "given":
        return 0.0
    if contact.source == "cloud":
        unresolved = contact.shape is None or contact.shape.kind == "points"
        return VISIBLE + UNRESOLVED * unresolved + gap_odds(model, contact)
    if contact.pulls:
        return model.inferred_odds + HANGING
    return model.inferred_odds + IN_SIGHT * float(in_sight(model, rows, contact.place[None])[0])


def in_sight(model: Model, rows: Rows, places: FloatArray) -> BoolArray:
    """Return which points at rest (c, 3) [m] are visible to a camera, shape (c,)."""
    robot = rows.pixel & (np.abs(rows.residual) < 5.0 * rows.std)
    seen = rows.rest[robot]
    if len(seen) < SEEN_BY:
        return np.zeros(len(places), dtype=bool)
    distance = np.asarray(cKDTree(seen).query(places, k=[SEEN_BY], distance_upper_bound=model.sensor.surface.edge)[0])
    return np.asarray(np.isfinite(distance[:, 0]))
