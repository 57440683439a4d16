"""Fitted models and what is held still in them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.loop.data.dataset import prepare
from femsense.loop.data.trial import Groups
from femsense.loop.fit.fitted_model import fit_model, keeping, mean_square, with_seeds_still
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


def test_states_that_are_repeated_do_not_hide_what_is_left():
    """How repeats differ tells of noise alone: with three of each state the mean square stays what it was with one."""
    marker, frame = np.tile(np.arange(4), 5), np.repeat(np.arange(5), 4)
    once = Groups(marker, frame, frame, np.arange(20))
    thrice = Groups(np.tile(marker, 3), np.arange(60) // 4, np.arange(60) // 4, np.tile(np.arange(20), 3))
    noise, rng = Noise({"white": 1e-4, "state": 1e-3}, ""), np.random.default_rng(3)
    left = 5e-3 * rng.normal(size=(20, 3))
    repeated = np.tile(left, (3, 1)) + 1e-4 * rng.normal(size=(60, 3))
    trials = [SimpleNamespace(groups=groups, mesh_error=None) for groups in (once, thrice)]
    one, three = (mean_square([t], [r], noise) for t, r in zip(trials, (left, repeated)))
    assert one > 20.0 and three == pytest.approx(one, rel=0.05)
