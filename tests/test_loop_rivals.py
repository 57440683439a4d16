"""A zero that moved is not yet an explanation: what does as well in its place is said with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from arm import arm, record
from femsense.loop.rivals import in_place_of

from femsense.loop.data import prepare
from femsense.loop.joint import Prior
from femsense.loop.noise import Noise
from femsense.loop.stages import make_stage, with_nuisance
from femsense.model import Robot

NOISE = Noise({"white": 3e-4}, "")


def rivals(robot: Robot, truth: Robot, cables: list[int], tried: list[str], **changes) -> dict[str, float]:
    """Return what does as well as the zeros of the cables, and by how much they are ahead; the cables are pulled one after another."""
    inputs = np.zeros((4 * len(cables), 4))
    for i, cable in enumerate(cables):
        inputs[4 * i : 4 * i + 4, cable] = np.linspace(0.0, 1.5, 4)
    data = prepare(robot, [record(inputs, truth=truth, noise=3e-4, **changes)[0]], [])
    hypothesis, prior = with_nuisance(data)
    full = make_stage(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    stiffness = replace(hypothesis, terms=hypothesis.terms[:1])
    without = make_stage(data, stiffness, Prior(prior.mean[:1], prior.std[:1]), NOISE, np.zeros(1))
    pairs = in_place_of(data, "cable_offset", full, without, NOISE, 200.0, tried)
    assert all(p["pair"][0] == "cable_offset" for p in pairs)
    return {p["pair"][1]: p["dbic_gap"] for p in pairs}


def test_weight_on_one_mount_does_as_well_as_zeros_that_moved():
    found = rivals(arm((4, 1, 1), gravity=(0, 0, 0)), arm((4, 1, 1)), [0], ["gravity", "cable_gain"])
    assert found["gravity"] < 0.0  # weight is what the arm truly has
    assert "cable_gain" not in found


def test_a_zero_that_is_wrong_has_no_rival():
    wrong = [{"name": "cable_offset", "tension_n": {"left": 0.4}}]
    assert not rivals(arm((4, 1, 1)), arm((4, 1, 1)), [0, 2, 1, 3], ["gravity", "cable_gain"], effects=wrong)
