"""How far fitted values may be off: misfit, and gravity on its sphere."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.least_squares import covariance_of
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.covariance import coordinate_std, misfit, parameter_std, std_by_sweeps
from femsense.loop.fit.fitted_model import fit_model
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.model.effects import find_effect
from femsense.model.effects.loads import SIZE, STANDARD_GRAVITY
from femsense.model.observation import Hypothesis


def linear_fit(rows: np.ndarray, gravity: np.ndarray, residual: np.ndarray | None = None) -> Any:
    """Return a fit of gravity alone with whitened rows (k, 3), at its optimum: the size of gravity is known besides."""
    prior = gravity / np.linalg.norm(gravity) / SIZE.std
    J = np.vstack([rows, prior])
    r = np.zeros(len(J)) if residual is None else residual
    parameters = [SimpleNamespace(length=SIZE)] * 3
    return SimpleNamespace(
        own=0,
        coordinates=gravity,
        std=np.sqrt(np.diag(covariance_of(J))),
        jets=[],
        hypothesis=SimpleNamespace(parameters=parameters),
        fit=SimpleNamespace(jacobian=J, residual=r, theta=gravity),
    )


NOISE = Noise({"white": 1e-4}, "")


def test_gravity_seen_along_one_axis_may_point_anywhere_on_a_circle() -> None:
    side, down = 4.0, -np.sqrt(STANDARD_GRAVITY**2 - 16.0)
    fit = linear_fit(np.array([[0.0, 0.0, 1 / 0.05]]), np.array([side, 0.0, down]))
    std = coordinate_std(fit, [], NOISE)
    # on a circle of radius 4 that the estimate lies on: E (x − 4)² = 16 (1 + 1/2), E y² = 16/2
    np.testing.assert_allclose(std[:2], [side * np.sqrt(1.5), side * np.sqrt(0.5)], rtol=0.03)
    assert fit.std[0] < 0.3 < std[0]  # what the tangent says
    assert std[2] == pytest.approx(0.05, rel=0.2)


@pytest.mark.parametrize("size", [STANDARD_GRAVITY, 9.4])
def test_gravity_seen_along_all_axes_has_the_usual_spread(size: float) -> None:
    towards, std = np.array([0.6, 0.0, -0.8]), 0.05
    # the data say `size`, what is known says 9.80665: the optimum lies between them
    best = (size / std**2 + STANDARD_GRAVITY / SIZE.std**2) / (1 / std**2 + 1 / SIZE.std**2)
    residual = np.append((best - size) * towards / std, (best - STANDARD_GRAVITY) / SIZE.std)
    fit = linear_fit(np.eye(3) / std, best * towards, residual)
    np.testing.assert_allclose(coordinate_std(fit, [], NOISE), fit.std, rtol=0.05)


def trial(count: int) -> Any:
    return SimpleNamespace(groups=SimpleNamespace(state=np.repeat(np.arange(count), 5), surface=None), mesh_error=None)


@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_a_model_that_leaves_more_than_the_noise_is_trusted_less(factor: float) -> None:
    rng = np.random.default_rng(2)
    noise = Noise({"white": 1e-6, "state": 2e-4}, "")
    residual = factor * 2e-4 * rng.standard_normal((400, 3))
    fit = SimpleNamespace(jets=[SimpleNamespace(residual=np.repeat(residual, 5, axis=0))], fit=SimpleNamespace(theta=np.zeros(1)))
    assert misfit(fit, [trial(400)], noise) == pytest.approx(max(1.0, factor), rel=0.05)


def test_parameters_leave_less_to_judge_the_noise_by() -> None:
    noise = Noise({"white": 1e-6, "state": 1e-4}, "")
    fit = SimpleNamespace(jets=[SimpleNamespace(residual=np.full((10, 3), 1e-4))], fit=SimpleNamespace(theta=np.zeros(3)))
    assert misfit(fit, [trial(2)], noise) == pytest.approx(np.sqrt(2.0), rel=1e-3)


def sweeps_fit(values: np.ndarray, rows: int) -> tuple[Any, Any]:
    """Return data and a fitted model: one parameter, the mean of whitened rows; `values` are what each sweep has it be."""
    residual = np.concatenate([np.full(3 * rows, v) for v in values - values.mean()])
    jet = SimpleNamespace(residual=residual.reshape(-1, 3), rest=np.zeros((0, 3)))
    J = np.ones((len(residual), 1))
    fit = SimpleNamespace(own=0, jets=[jet], fit=SimpleNamespace(jacobian=J, residual=residual, theta=np.zeros(1)))
    groups = SimpleNamespace(sweep=np.repeat(np.arange(len(values)), rows))
    return SimpleNamespace(
        train=[SimpleNamespace(groups=groups, poses=(), together=False, seen=None, scene=SimpleNamespace(crossings=None))]
    ), SimpleNamespace(fit=fit)


def test_sweeps_that_disagree_say_by_how_much() -> None:
    values = np.array([0.3, -0.5, 0.9, 0.1, -0.8])
    data, fitted = sweeps_fit(values, 4)
    # of equal sweeps: the variance of a mean of five; half leverage gives each its share back, 1 / (1 − 1/5)
    expected = np.sqrt(np.sum((values - values.mean()) ** 2) / 5 / 4)
    np.testing.assert_allclose(std_by_sweeps(data, fitted), expected, rtol=1e-6)
    two, fitted = sweeps_fit(values[:2], 4)
    assert not std_by_sweeps(two, fitted).any()


def test_a_time_that_a_seed_holds_still_leaves_the_fraction_open() -> None:
    inputs, labels = sweeps(1.5, each=1)
    robot = arm((4, 1, 1))
    truth = [{"name": "creep", "fraction": 0.2, "time_s": 6.0}]
    data = prepare(robot, [record(inputs, labels=labels, truth=robot, effects=truth, noise=1e-4)[0]], [])
    noise, effect = Noise({"white": 1e-4}, ""), find_effect("creep")
    hypothesis = Hypothesis(robot, ((effect, {"time_s": 8.0}, effect.parameters(robot, "tension")),))
    fitted = fit_model(data, hypothesis, Prior(np.zeros(1), np.full(1, np.inf)), noise, np.array([0.2]))
    std = parameter_std(data, fitted, noise, {})["creep"]
    assert std[0] > 1.5 * fitted.fit.std[0]
    more = parameter_std(data, fitted, noise, {"creep": np.array([0.3])})["creep"]
    assert more[0] == pytest.approx(np.hypot(std[0], 0.3))
