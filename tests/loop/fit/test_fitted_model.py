"""Fitted models and what is held still in them."""

from __future__ import annotations

import numpy as np
from arm import arm, record, sweeps

from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import fit_model, keeping, with_seeds_still
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.model.effects import find_effect
from femsense.model.observation import Hypothesis


def test_times_that_are_held_still_stay_where_the_fit_had_them():
    inputs, labels = sweeps(each=1)
    robot, noise, creep, seed = arm((4, 1, 1)), Noise({"white": 1e-4}, ""), find_effect("creep"), {"time_s": 2.0}
    hidden = [{"name": "creep", "fraction": 0.2, "time_s": 3.0}]
    recording, _ = record(inputs, labels=labels, truth=robot, effects=hidden)
    data = prepare(robot, [recording], [])
    parameters = (*creep.parameters(robot, "tension"), *creep.polish(robot, "tension", seed))
    start, flat = np.array([0.1, np.log(5.0)]), Prior(np.zeros(2), np.full(2, np.inf))
    fitted = fit_model(data, Hypothesis(robot, ((creep, seed, parameters),)), flat, noise, start, max_iterations=2)
    still = with_seeds_still(data, fitted)
    assert [p.key for p in still.fit.hypothesis.parameters] == ["fraction"]
    assert still.fit.hypothesis.entries(still.fit.coordinates) == fitted.fit.hypothesis.entries(fitted.fit.coordinates)
    again = keeping(data, still, ["creep"], noise)
    (_, held, _), time_s = again.fit.hypothesis.terms[0], fitted.fit.hypothesis.entries(fitted.fit.coordinates)[0]["time_s"]
    assert held["time_s"] == time_s != 2.0
    assert again.fit.std.shape == (1,) and again.fit.chi2 < 1.1 * fitted.fit.chi2
