"""What to do next where an error is left, in a person's words, with what it brings."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record

from femsense.loop.data.dataset import prepare
from femsense.loop.design.next_steps import next_steps
from femsense.loop.fit.fitted_model import fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.model.recording import Recording


def steps_after(recording: Recording, *, measured: bool = True) -> list[str]:
    data, noise = prepare(arm((4, 1, 1)), [recording], []), Noise({"white": 1e-4}, "")
    hypothesis, prior = with_nuisance(data)
    fitted = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)), max_iterations=3)
    return next_steps(data, fitted, noise, noise_is_measured=measured)


def one_at_a_time() -> Recording:
    """Return a recording that pulls one cable at a time and never rests."""
    inputs = np.concatenate([np.outer([0.5, 1.0, 2.0], row) for row in np.eye(4)])
    return record(inputs, labels=[f"s{k // 3}" for k in range(12)], truth=arm((4, 1, 1)))[0]


def test_what_recordings_lack_is_said_with_what_it_brings() -> None:
    said = steps_after(one_at_a_time())
    assert {text.split()[0] for text in said} == {"weigh", "record", "hang", "pull"}
    before, after = (float(number) for number in re.findall(r"(?:from|to) ([\d.e+-]+)", said[0][said[0].index("deviation") :]))
    assert said[0].startswith("hang") and "the standard deviation of" in said[0] and 0.0 < after < 0.8 * before


def test_what_is_recorded_already_is_not_asked_for() -> None:
    inputs = np.array([[0.0, 0, 0, 0], [2.0, 0, 0, 0], [0, 2.0, 0, 0], [2.0, 2.0, 0, 0], [1.0, 2.0, 2.0, 0], [0, 0, 1.0, 2.0]])
    inputs = np.concatenate([inputs, inputs])
    recording, _ = record(inputs, labels=[f"s{k // 3}" for k in range(12)], truth=arm((4, 1, 1)))
    loaded = {"load_frame": np.array([1]), "load_points": np.array([[0.1, 0.0, 0.01]]), "load_forces": np.zeros((1, 3))}
    said = steps_after(replace(recording, **loaded))
    assert [text.split()[0] for text in said] == ["weigh"]


@pytest.mark.parametrize("measured", [True, False])
def test_states_are_asked_for_again_where_nothing_tells_the_noise(measured: bool) -> None:
    assert steps_after(one_at_a_time(), measured=measured)[0].startswith("repeat three") != measured
