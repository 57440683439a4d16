"""How much a contact that only the shape shows has to explain: more than the errors of the model explain in free frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.sensing.prepare import FreeFrame, Prepared
from femsense.sensing.row_noise import weighed
from femsense.sensing.search import evidence_of
from femsense.sensing.types import Sensor

FOLDS = 4
"""So many parts of the free frames are asked, each by what the others teach."""
MOST = 12
"""Free frames that are asked at most."""
BEYOND = 3.0
"""A contact has to gain more than the largest gain of a free frame by so many times the scatter of these."""


def with_gains_of_free_frames(prepared: Prepared) -> Sensor:
    """Return the sensor with the gain in log evidence that a contact needs: what noise alone gives once in 1000 frames, or what free frames gain.

    There nothing touches, so that what one more contact would explain is an error of the model: one that the frame itself has not taught.
    """
    sensor, free = prepared.sensor, list(prepared.free)
    asked = [free[i] for i in np.unique(np.linspace(0, len(free) - 1, min(MOST, len(free))).round().astype(int))]
    if len(asked) < FOLDS:
        return sensor
    others = [prepared.without(asked[fold::FOLDS]) for fold in range(FOLDS)]
    gains = [_gain(others[i % FOLDS], prepared.free[k]) for i, k in enumerate(asked)]
    limit = max(gains) + BEYOND * float(np.std(gains))
    return replace(sensor, knowledge=replace(sensor.knowledge, gain_limit=max(sensor.knowledge.gain_limit, limit)))


def _gain(sensor: Sensor, frame: FreeFrame) -> float:
    """Return the largest gain that a contact would have in a free frame."""
    rows = weighed(sensor.knowledge, frame.means)
    gain, _ = evidence_of(sensor, frame.state, rows, frame.moves, np.zeros((len(rows.std), 0)))
    return max(float(gain.max(initial=0.0)), 0.0)
