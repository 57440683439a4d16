"""Tensions end at 0: a fit that knows where goes through these nonsmooth lines in one step, and its model of the residual is right beyond them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from arm import arm, record, sweeps
from scipy.optimize import lsq_linear

from femsense.core.least_squares import gauss_newton
from femsense.core.local_model import LocalModel, Nonsmoothness
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import with_nuisance
from femsense.loop.fit.joint_fit import JointProblem
from femsense.loop.fit.noise_components import Noise
from femsense.model.effects import apply_effects

NOISE = Noise({"white": 1e-4}, "")


def bent(seed: int):
    """Return an evaluation of a residual with six nonsmooth lines in three parameters, their description, and the smallest sum of squares."""
    rng = np.random.default_rng(seed)
    A, W, U, v = rng.normal(size=(40, 3)), 3.0 * rng.normal(size=(40, 6)), rng.normal(size=(6, 3)), 0.3 * rng.normal(size=6)
    b = rng.normal(size=40) + A @ [1.0, -2.0, 0.5] + W @ np.maximum(v + U @ [1.0, -2.0, 0.5], 0.0)
    tries: list[bool] = []

    def evaluate(x: np.ndarray, derivative: bool):
        tries.append(derivative)
        on = v + U @ x >= 0
        return A @ x + W @ np.maximum(v + U @ x, 0.0) - b, A + (W * on) @ U if derivative else None

    def nonsmooth(x: np.ndarray) -> Nonsmoothness:
        return Nonsmoothness(W, v + U @ x, U, counted[0])

    counted = [v >= 0]
    costs = []
    for signs in product([False, True], repeat=6):  # in each cell the residual is a straight line
        on = np.array(signs)
        x = lsq_linear(A + (W * on) @ U, b - (W * on) @ v).x
        costs.append(float(np.sum(evaluate(x, False)[0] ** 2)))
    tries.clear()
    return evaluate, nonsmooth, tries, min(costs)


@pytest.mark.parametrize("seed", range(6))
def test_a_fit_that_knows_its_kinks_goes_through_them_at_once(seed: int) -> None:
    evaluate, nonsmooth, tries, best = bent(seed)
    plain = gauss_newton(evaluate, np.zeros(3))
    tries.clear()
    near = LocalModel(*evaluate(np.zeros(3), True), nonsmooth(np.zeros(3)), np.full(3, -np.inf), np.full(3, np.inf))
    cost = float(np.sum(evaluate(near.step(0.0), False)[0] ** 2))
    assert best * (1 - 1e-9) <= cost <= 1.05 * best
    assert cost <= plain.cost[-1] * 1.001


def test_what_a_step_changes_is_known_across_a_kink() -> None:
    evaluate, nonsmooth, _, _ = bent(1)
    r, J = evaluate(np.zeros(3), True)
    near = LocalModel(r, J, nonsmooth(np.zeros(3)), np.full(3, -np.inf), np.full(3, np.inf))
    for step in np.random.default_rng(2).normal(size=(5, 3)):
        np.testing.assert_allclose(near.change(step), evaluate(step, False)[0] - r, atol=1e-12)
        assert np.linalg.norm(J @ step - near.change(step)) > 0.1


def test_on_a_kink_the_derivative_has_no_gradient_and_takes_a_part_of_both_sides() -> None:
    up, down = np.array([3.0, 1.0]), np.array([1.0, 0.0])  # slopes below 0 and above it
    W = np.array([[2.0], [1.0], [0.0]])
    plain = np.array([[1.0], [0.0], [-0.25]])

    def evaluate(x: np.ndarray, derivative: bool):
        side = up if x[0] >= 0 else down
        r = np.array([*(side * x[0] + 0.1), 1.0 - 0.25 * x[0]])
        return r, (np.array([*side, -0.25])[:, None] if derivative else None)

    def nonsmooth(x: np.ndarray) -> Nonsmoothness:
        return Nonsmoothness(W, np.array(x), np.eye(1), np.array([x[0] >= 0]))

    fit = gauss_newton(evaluate, np.array([0.5]), nonsmooth=nonsmooth)
    gradients = [float(((plain + share * W).T @ fit.residual)[0]) for share in (0.0, 1.0)]
    assert abs(fit.theta[0]) < 1e-3 and gradients[0] < -0.1 and gradients[1] > 0.1
    assert abs(float((fit.jacobian.T @ fit.residual)[0])) < 1e-6


@pytest.mark.parametrize(("creep", "scatter"), [(False, 0.0), (True, 0.0), (False, 0.01)])
def test_zeros_on_both_sides_are_predicted(creep: bool, scatter: float) -> None:
    robot = arm((4, 1, 1))
    inputs, labels = sweeps(each=1)
    inputs = inputs + scatter * np.random.default_rng(4).random(inputs.shape)
    recording, _ = record(inputs, labels=labels, truth=robot)
    robot = apply_effects(robot, [{"name": "creep", "fraction": 0.3, "time_s": 4.0}]) if creep else robot
    data = prepare(robot, [recording], [])
    hypothesis, prior = with_nuisance(data)
    trial = data.train[0]
    problem = JointProblem(hypothesis, prior, data.train, [NOISE.whitener(trial.groups)], data.placement_std)
    at = problem.start(np.array([0.0, 0.02, -0.03, 0.0, 0.01]))
    there = problem.start(np.array([0.01, -0.03, 0.05, -0.04, 0.05]))
    r, J = problem.evaluate(at, True)
    nonsmooth = problem.nonsmooth(at)
    near = LocalModel(r, J, nonsmooth, at - 1.0, at + 1.0)
    assert len(nonsmooth.value) <= 12
    np.testing.assert_allclose(near.J, J, atol=0.02 * np.abs(J).max())
    true = problem.evaluate(there, False)[0] - r
    missed = [np.linalg.norm(change - true) / np.linalg.norm(true) for change in (near.change(there - at), J @ (there - at))]
    assert missed[0] < 0.05 and missed[1] > 3 * missed[0]
