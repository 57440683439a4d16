"""Recordings whose states do not repeat, made on the declared linear mesh: little work, and the answer is right."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from arm import arm, record

from femsense.core.least_squares import STOPPED_EARLY
from femsense.core.work import Work, counting
from femsense.fem.mesh import to_linear
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.noise_components import Noise
from femsense.loop.improve import improve
from femsense.loop.result.loop_result import LoopResult
from femsense.loop.search.calibration import calibrated_on, calibrated_pose, fitted_again
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.element_order import linear_suffice
from femsense.loop.search.refit import adds_history, refit
from femsense.loop.search.screening import screen_model
from femsense.model.effects import apply_effects
from femsense.model.recording import Recording
from femsense.model.remeshing import robot_on_mesh
from femsense.model.robot import Robot

NAMES = ["discretisation", "payload", "cable_gain", "cable_friction"]
FRAMES = 24


def linear(robot: Robot) -> Robot:
    return robot_on_mesh(robot, to_linear(robot.body.mesh))


def recorded(truth: Robot, seed: int, gain: float = 1.0) -> Recording:
    """Return frames no two of which pull the cables alike."""
    rng = np.random.default_rng(seed)
    inputs = rng.uniform(0.0, 3.0, (FRAMES, 4)) * (rng.random((FRAMES, 4)) < 0.6)
    labels = [f"s{k // 8}" for k in range(FRAMES)]
    effects = () if gain == 1.0 else ({"name": "cable_gain", "scale": {"up": gain}},)
    return record(inputs, labels=labels, truth=truth, effects=effects, seed=seed)[0]


@cache
def improved(gain: float) -> tuple[LoopResult, Work, list[str]]:
    told: list[str] = []
    declared = linear(arm((4, 2, 2)))
    with counting() as work:
        loop = improve(
            declared,
            [recorded(declared, 1, gain)],
            validation=[recorded(declared, 2, gain)],
            effects=NAMES,
            progress=told.append,
        )
    return loop, work, told


def test_nothing_is_found_where_nothing_is_hidden_with_few_equilibria() -> None:
    loop, work, told = improved(1.0)
    assert loop.verdict == "none" and not loop.effects
    assert work.equilibria < 24 * FRAMES
    assert told[-1].startswith("testing the remaining residual (") and any("% " in t or "%," in t for t in told)


def test_a_hidden_gain_is_found_with_few_equilibria() -> None:
    loop, work, _ = improved(0.8)
    assert [e.name for e in loop.effects] == ["cable_gain"]
    assert loop.after.validation_rms_m < 1.1 * np.sqrt(3) * 1e-4
    assert work.equilibria < 60 * FRAMES  # friction, and a gain of each cable, are fitted to the end beside it


def test_linear_elements_suffice_only_where_they_leave_plainly_less() -> None:
    declared = linear(arm((4, 2, 2)))
    own, other = recorded(declared, 1), recorded(arm((6, 2, 2), law="neo_hookean"), 1)
    record_own = linear_suffice(prepare(declared, [own], [recorded(declared, 2)]))
    assert record_own is not None and "quadratic elements leave" in record_own.verdict
    assert linear_suffice(prepare(declared, [other], [recorded(declared, 2)])) is None


def test_the_robot_that_is_handed_back_stays_on_the_declared_mesh() -> None:
    loop, _, _ = improved(0.8)
    assert not loop.robot.body.mesh.is_quadratic
    row = next(c for c in loop.candidates if c.name == "discretisation")
    assert "linear ones" in row.refits[0].verdict
    gain = next(e for e in loop.entries if e["name"] == "cable_gain")["scale"]["up"]
    assert gain == pytest.approx(0.8, abs=0.02)


def test_friction_is_fitted_to_the_end_however_little_its_null_predicts() -> None:
    """At its null every segment of a cable slides, whatever the frame before."""
    declared = linear(arm((4, 2, 2)))
    inputs = np.random.default_rng(4).uniform(0.0, 3.0, (FRAMES, 4))
    truth = apply_effects(declared, [{"name": "cable_friction", "coefficient": 0.4}])
    data = prepare(declared, [record(inputs, truth=truth)[0]], [recorded(declared, 2)])
    noise = Noise({"white": 1e-4}, "")
    base = calibrated_on(data, data.robot, calibrated_pose(data, data.robot, noise))
    base = fitted_again(data, base, noise)
    table = screen_model(data, base.fit, noise, fields_of(data, base, ["cable_friction", "cable_gain"]), 100.0)
    one, other = (next(c for c in table if c.effect.name == name) for name in ("cable_friction", "cable_gain"))
    assert adds_history(base.fit, one, np.full(len(one.parameters), 0.4)) and not adds_history(base.fit, other, np.array([0.8]))
    simple = min((c for c in table if c.effect.name == "cable_friction"), key=lambda c: len(c.parameters))
    made = refit(data, base, simple, noise, wanted=1e9)
    assert made.fit.fit.status != STOPPED_EARLY
    assert made.fit.coordinates[-1] == pytest.approx(0.4, abs=0.05)
