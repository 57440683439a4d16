"""How much a contact that only the shape shows has to explain: more than the errors of the model explain in free frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.calib.from_clouds import free_clouds
from femsense.core.errors import FemsenseError
from femsense.model.quasi_static_path import free_path
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.sensing.prepare import make_sensor, scan_of
from femsense.sensing.search import evidence
from femsense.sensing.separation import segmented
from femsense.sensing.types import Sensor

FOLDS = 4
"""So many parts of the free frames are asked, each by what the others teach."""
MOST = 12
"""Free frames that are asked at most."""
BEYOND = 3.0
"""A contact has to gain more than the largest gain of a free frame by so many times the scatter of these."""


def with_gains_of_free_frames(sensor: Sensor, robot: Robot, recording: Recording, calibration: Calibration) -> Sensor:
    """Return the sensor with the gain in log evidence that a contact needs: what noise alone gives once in 1000 frames, or what free frames gain.

    There nothing touches, so that what one more contact would explain is an error of the model: one that the frame itself has not taught.

    Arguments:
        sensor: as `make_sensor` made it.
        robot, recording, calibration: what it was made of.
    """
    free = free_clouds(recording)
    asked = [free[i] for i in np.unique(np.linspace(0, len(free) - 1, min(MOST, len(free))).round().astype(int))]
    if len(asked) < FOLDS:
        return sensor
    gains = [
        gain
        for fold in range(FOLDS)
        for gain in _gains(
            make_sensor(robot, recording, calibration, options=sensor.options, without=asked[fold::FOLDS]), asked[fold::FOLDS]
        )
    ]
    limit = max(gains) + BEYOND * float(np.std(gains)) if gains else 0.0
    return replace(sensor, knowledge=replace(sensor.knowledge, gain_limit=max(sensor.knowledge.gain_limit, limit)))


def _gains(sensor: Sensor, frames: list[int]) -> list[float]:
    """Return the largest gain that a contact would have in each of some free frames; those that give nothing are left out."""
    gains = []
    for k, state in free_path(sensor.driven, frames):
        try:
            scan = scan_of(sensor, k, state)
            gain, _ = evidence(sensor, segmented(sensor, k, scan, state, None, None)[1])
        except FemsenseError:
            continue
        gains.append(max(float(gain.max(initial=0.0)), 0.0))
    return gains
