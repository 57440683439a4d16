"""The joint fit: where it starts, what a step may cost, and where it ends."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import arm
from fitted_arm import NOISE, fitted_arm

from femsense.core.errors import DataError
from femsense.core.least_squares import GaussNewtonOptions, gauss_newton
from femsense.loop.data.trial import Trial
from femsense.loop.fit.fitted_model import with_term
from femsense.loop.fit.joint_fit import Jets, JointProblem, nearby_start
from femsense.loop.fit.noise_components import whiten
from femsense.model.effects import find_effect
from femsense.model.observation import SceneJet


def test_a_step_that_goes_too_far_is_refused_and_not_solved_by_all_means() -> None:
    data, fitted = fitted_arm(arm((4, 2, 2)))
    rough_only = list[bool]()

    class TooFar(JointProblem):
        """A problem in which no state that is only tried converges."""

        def jet(
            self, trial: Trial, own: Any, coordinates: Any, derivative: bool, starts: Any, rough: bool, *rest: Any
        ) -> SceneJet:
            rough_only.append(rough)
            if rough:
                raise DataError("no equilibrium")
            return JointProblem.jet(self, trial, own, coordinates, derivative, starts, rough, *rest)

    problem = TooFar(fitted.fit.hypothesis, fitted.fit.prior, data.train, [NOISE.whitener(data.train[0].groups, None)], 1.0)
    problem.near = fitted.fit.jets
    theta = np.array(fitted.fit.fit.theta)
    problem.evaluate(theta, False)  # the start is solved by all means
    with pytest.raises(DataError):
        problem.evaluate(theta + 0.01, False)
    assert rough_only == [True, False, True]


@pytest.mark.parametrize("clamp", ["base_compliance", None])
def test_a_fit_begins_at_the_states_of_the_model_before_unless_their_clamp_is_another(clamp: str | None) -> None:
    data, fitted = fitted_arm(arm((4, 2, 2)))
    hypothesis, prior = fitted.fit.hypothesis, fitted.fit.prior
    theta = np.array(fitted.fit.fit.theta)
    theta[fitted.fit.own] += np.log(0.9)  # a rival went elsewhere
    if clamp is not None:
        effect = find_effect(clamp)
        parameters = effect.parameters(data.robot, "tension")
        hypothesis, prior = with_term(fitted.fit, effect, {}, parameters)
        theta = np.append(theta, [0.2 * p.high for p in parameters])
    trial = replace(data.train[0], starts={})
    problem = JointProblem(hypothesis, prior, [trial], [NOISE.whitener(trial.groups, None)], 1.0)
    problem.evaluate(theta, True)
    kept = dict(trial.starts_on(data.robot.body.mesh))
    begins = JointProblem(hypothesis, prior, [trial], problem.factors, 1.0)
    begins.last = Jets(fitted.fit.jets, theta)
    wanted = kept if clamp else fitted.fit.jets[0].states
    (starts,) = begins.starts(theta, True)
    assert wanted and all(starts[k].positions is state.positions for k, state in wanted.items())


def test_states_that_are_far_apart_lend_each_other_no_factors() -> None:
    data, _ = fitted_arm(arm((4, 2, 2)))
    body, kept = data.robot.body, data.train[0].starts_on(data.robot.body.mesh)
    k = next(k for k, state in kept.items() if state.factor is not None)
    free = ~np.isin(np.arange(len(body.mesh.nodes)), body.clamped)[:, None]
    beside, far = (replace(kept[k], positions=kept[k].positions + by * body.reach * free, factor=None) for by in (0.005, 0.02))
    assert nearby_start(kept[k], beside, body).factor is kept[k].factor and nearby_start(kept[k], far, body).factor is None
    assert all(nearby_start(kept[k], state, body).positions is state.positions for state in (beside, far))


@pytest.mark.parametrize("own", [False, True])
def test_a_fit_that_ends_on_its_way_has_the_residual_of_its_end(own: bool) -> None:
    data, fitted = fitted_arm(arm((4, 2, 2)))
    trial = replace(data.train[0], initial=None)
    problem = JointProblem(fitted.fit.hypothesis, fitted.fit.prior, [trial], [NOISE.whitener(trial.groups, None)], 1.0)
    problem.near = fitted.fit.jets
    theta = problem.start(fitted.fit.coordinates + 0.02)
    fit = gauss_newton(problem.evaluate, theta, options=GaussNewtonOptions(max_iterations=3))
    problem.evaluate(fit.theta + 1e-3, False)  # a step that is not taken
    problem.last = None
    fit = problem.outcome(replace(fit, own=own))
    white = whiten(problem.factors[0], fit.jets[0].residual)
    np.testing.assert_allclose(white, fit.fit.residual[: white.size], atol=1e-3)


def test_a_step_that_is_not_taken_leaves_no_state_behind() -> None:
    data, fitted = fitted_arm(arm((4, 2, 2)))
    trial = replace(data.train[0], starts={})
    problem = JointProblem(fitted.fit.hypothesis, fitted.fit.prior, [trial], [NOISE.whitener(trial.groups, None)], 1.0)
    theta = np.array(fitted.fit.fit.theta)
    at = problem.evaluate(theta, True)[0]
    kept = trial.starts_on(fitted.fit.hypothesis.robot.body.mesh)
    before = {k: s.positions for k, s in kept.items()}
    far, soft = theta.copy(), theta.copy()
    far[problem.own] += np.log(0.8)
    soft[problem.own] = np.log(0.02)  # it collapses
    there = problem.evaluate(far, False)[0]
    with pytest.raises(DataError):
        problem.evaluate(soft, False)
    assert all(kept[k].positions is x for k, x in before.items())
    np.testing.assert_allclose(problem.evaluate(far, True)[0], there, atol=0.05)  # taken after all: solved to the last
    assert not any(kept[k].positions is x for k, x in before.items())
    np.testing.assert_allclose(problem.evaluate(theta, True)[0], at, atol=1e-3)
