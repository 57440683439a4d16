"""The verdict belongs to the experiment, not to how it is told; and a log that is wrong is blamed on no effect of the cables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from arm import arm, record, sweeps
from changed import in_unit, log_permuted, renumbered, reordered, sweeps_shuffled, turned_world

from femsense.core.pose import make_pose, rotation_from_vector
from femsense.loop.improve import improve
from femsense.loop.result.loop_result import LoopResult
from femsense.model.recording import Recording
from femsense.model.robot import Robot

TRIED = ["cable_gain", "cable_friction", "creep"]
GAIN = {"name": "cable_gain", "scale": {"left": 0.8}}
FRICTION = {"name": "cable_friction", "coefficient": 0.25}
Told = Callable[[Robot, Recording, Path], tuple[Robot, Recording]]


def experiment(effect: dict) -> tuple[Robot, Recording]:
    """Return a small arm and a recording in which an effect is hidden; each sweep ends with slack cables."""
    inputs, labels = sweeps(each=2)
    robot = arm((4, 1, 1))
    return robot, record(inputs, effects=[effect], labels=labels, truth=robot)[0]


def said(robot: Robot, recording: Recording, tried: Sequence[str] = TRIED) -> LoopResult:
    return improve(robot, [recording], effects=tried)


def numbers(loop: LoopResult) -> dict[str, tuple[float, float]]:
    """Return every number that was named, with its standard deviation; a table name → value gives one a cable."""
    result = {}
    for effect in loop.effects:
        for key, p in effect.parameters.items():
            value, std = (v if isinstance(v, dict) else {"": v} for v in (p.value, p.std))
            result |= {f"{effect.name}.{key}.{cable}": (value[cable], std[cable]) for cable in value}
    return result


def assert_same(told: LoopResult, plain: LoopResult, share: float = 0.2) -> None:
    """Check names, verdict and numbers, which may differ by a share of their standard deviations."""
    assert told.verdict == plain.verdict
    assert [e.name for e in told.effects] == [e.name for e in plain.effects]
    ours, theirs = numbers(told), numbers(plain)
    assert ours.keys() == theirs.keys()
    for key, (value, std) in theirs.items():
        assert ours[key][0] == pytest.approx(value, abs=share * std), key


@pytest.fixture(scope="module")
def gain() -> tuple[Robot, Recording, LoopResult]:
    robot, recording = experiment(GAIN)
    return robot, recording, said(robot, recording)


WORLD = make_pose(rotation_from_vector([0.7, -1.9, 0.4]), [0.3, -0.2, 0.5])
TOLD: dict[str, Told] = {
    "sweeps shuffled": lambda robot, r, folder: (robot, sweeps_shuffled(r, np.random.default_rng(4))),
    "mesh in millimetres": lambda robot, r, folder: (in_unit(robot, "mm", folder), r),
    "world turned": lambda robot, r, folder: turned_world(robot, r, WORLD),
    "mesh renumbered": lambda robot, r, folder: (renumbered(robot, np.random.default_rng(5)), r),
    "markers and cables reordered": lambda robot, r, folder: reordered(robot, r, np.random.default_rng(6)),
}


@pytest.mark.parametrize("how", TOLD)
def test_the_verdict_is_the_same_however_it_is_told(how: str, gain: tuple[Robot, Recording, LoopResult], tmp_path: Path):
    robot, recording, plain = gain
    assert plain.verdict == "effects"
    assert numbers(plain)["cable_gain.scale.left"][0] == pytest.approx(0.8, abs=0.02)
    assert_same(said(*TOLD[how](robot, recording, tmp_path)), plain)


def test_friction_does_not_care_for_the_order_of_sweeps_that_end_slack():
    robot, recording = experiment(FRICTION)
    shuffled = sweeps_shuffled(recording, np.random.default_rng(1))
    assert shuffled.sweep != recording.sweep
    loop = said(robot, shuffled, ["cable_friction", "cable_gain"])
    assert [e.name for e in loop.effects] == ["cable_friction"]
    value, std = numbers(loop)["cable_friction.coefficient."]
    assert value == pytest.approx(0.25, abs=max(3 * std, 0.01))


@pytest.mark.parametrize("draw", range(2))
def test_a_log_that_belongs_to_other_frames_is_blamed_on_no_effect(draw: int):
    robot, recording = experiment(GAIN)
    loop = said(robot, log_permuted(recording, np.random.default_rng(draw)))
    assert not {e.name for e in loop.effects} & {"cable_friction", "creep"}
    assert loop.verdict != "effects"
