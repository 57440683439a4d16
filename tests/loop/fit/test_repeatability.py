"""The noise is what repeats, is declared, or is measured at rest; what varies with the state is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit.fitted_model import FittedModel, fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.repeatability import Repeatability, repeatability
from femsense.model.recording import Recording
from femsense.model.recording_parts import RestMarkers

WIDE = Noise({"white": 2e-3, "state": 3e-3, "sweep": 3e-3}, "")


def measured(recording: Recording) -> Repeatability:
    """Return what a recording of a truth that is a quarter stiffer tells of its noise."""
    data = prepare(arm((4, 1, 1)), [recording], [])
    return repeatability(data, fitted(data), WIDE)


def fitted(data: Data) -> FittedModel:
    hypothesis, prior = with_nuisance(data)
    return fit_model(data, hypothesis, prior, WIDE, np.zeros(len(prior.mean)), max_iterations=1)


def recorded(inputs: np.ndarray, labels: list[str], noise: float = 2e-4) -> Recording:
    hidden = [{"name": "stiffness", "scale": 1.25}]
    return record(inputs, labels=labels, truth=arm((4, 1, 1)), effects=hidden, noise=noise)[0]


def test_states_that_are_reached_again_tell_the_noise_whatever_the_model_leaves() -> None:
    inputs, labels = sweeps(each=1)
    found = measured(recorded(np.repeat(inputs, 3, axis=0), [name for name in labels for _ in range(3)]))
    assert found.known and found.std == pytest.approx(2e-4, rel=0.1) and "repeated states" in found.source
    assert found.total == pytest.approx(np.sqrt(3.0) * found.std)


def moving() -> tuple[np.ndarray, list[str]]:
    """Return inputs none of which repeats."""
    inputs = np.outer(np.linspace(0.1, 2.0, 8), [1.0, 0.0, 0.0, 0.0]) + np.outer(
        np.linspace(0.0, 1.0, 8) ** 2, [0.0, 1.0, 0.0, 0.0]
    )
    return inputs, [f"s{k // 2}" for k in range(8)]


def test_where_no_state_repeats_the_noise_is_assumed_or_declared_or_that_of_rest() -> None:
    recording = recorded(*moving())
    assumed = measured(recording)
    assert not assumed.known and assumed.std == WIDE.std["white"] and "assumed" in assumed.source
    declared = measured(replace(recording, marker_noise_m=3e-4))
    assert declared.known and declared.std == 3e-4 and "recording.toml" in declared.source
    names = recording.marker_names
    first = recording.marker_xyz[recording.marker_frame == 0]
    rest = RestMarkers(names, first, np.full(len(names), 1e-4), np.zeros(len(names), np.int64))
    at_rest = measured(replace(recording, rest=rest))
    assert at_rest.known and at_rest.std == pytest.approx(1e-4) and "rest.csv" in at_rest.source


def test_a_state_that_is_reached_another_way_is_no_repeat() -> None:
    """Friction makes a state depend on how it is reached: that is no noise."""
    level = [0.5, 1.0, 0.5, 1.5]
    inputs = np.outer(level, [1.0, 0.0, 0.0, 0.0])
    assert not measured(recorded(inputs, [f"s{k}" for k in range(4)])).known
