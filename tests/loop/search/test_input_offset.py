"""A zero that moved is not yet an explanation: what does better in its place takes it, what does as well is said with it."""

from __future__ import annotations

import numpy as np
import pytest
from arm import arm, record

from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.search_state import OffsetAlternative, Setting
from femsense.loop.search.swaps import instead_of_offsets
from femsense.model.robot import Robot

NOISE = Noise({"white": 3e-4}, "")


def asked(
    robot: Robot, truth: Robot, cables: list[int], tried: list[str], top: float = 1.5, **changes
) -> OffsetAlternative | None:
    """Return what may be in the place of zeros that moved; the cables are pulled one after another."""
    inputs = np.zeros((4 * len(cables), 4))
    for i, cable in enumerate(cables):
        inputs[4 * i : 4 * i + 4, cable] = np.linspace(0.0, top, 4)
    data = prepare(robot, [record(inputs, truth=truth, noise=3e-4, **changes)[0]], [])
    hypothesis, prior = with_nuisance(data)
    full = fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    return instead_of_offsets(Setting(data, NOISE, 200.0, lambda text: None), full, tried)


def test_weight_on_one_mount_takes_the_place_of_zeros_that_moved():
    found = asked(arm((4, 1, 1), gravity=(0, 0, 0)), arm((4, 1, 1)), [0, 0, 0, 0], ["gravity", "cable_gain"])
    assert found is not None and found.name == "gravity" and found.ahead > 0.0  # weight is what the arm truly has
    assert found.fitted is not None and "cable_offset" not in found.fitted.fit.hypothesis.names


def test_a_zero_that_is_wrong_keeps_its_place():
    wrong = [{"name": "cable_offset", "tension_n": {"left": 0.4}}]
    found = asked(arm((4, 1, 1)), arm((4, 1, 1)), [0, 2, 1, 3], ["gravity", "cable_gain"], effects=wrong)
    assert found is not None and found.fitted is None and found.ahead < -10.0


@pytest.mark.parametrize(("zero", "named"), [(-1.5e-3, "cable_slack"), (-0.8e-3, "cable_slack"), (1.5e-3, "")])
def test_play_is_named_where_held_cables_pull_less_than_declared_and_a_zero_where_they_pull_more(zero: float, named: str):
    wrong = [{"name": "cable_offset", "displacement_m": {"left": zero}}]
    found = asked(arm((4, 1, 1)), arm((4, 1, 1)), [0, 2, 1, 3], ["cable_slack"], 6e-3, effects=wrong, actuation="displacement")
    assert found is not None and (found.fitted is not None) == bool(named)
    if found.fitted is not None:
        assert found.name == named and found.fitted.fit.coordinates[-1] == pytest.approx(-zero, rel=0.1)


def test_zeros_that_are_right_are_not_asked_about():
    assert asked(arm((4, 1, 1)), arm((4, 1, 1)), [0, 2, 1, 3], ["gravity"]) is None
