"""A model of an arm, fitted to a recording of it, as the loop begins."""

from __future__ import annotations

import numpy as np
from arm import record, sweeps

from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit.fitted_model import FittedModel, fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.model.robot import Robot

NOISE = Noise({"white": 1e-4}, "")


def fitted_arm(robot: Robot, height: float = 3.0) -> tuple[Data, FittedModel]:
    """Return data of sweeps up to a height [N], and the robot with what calibration may move, fitted to them."""
    inputs, labels = sweeps(height, each=1)
    recording, _ = record(inputs, labels=labels)
    data = prepare(robot, [recording], [])
    hypothesis, prior = with_nuisance(data)
    return data, fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
