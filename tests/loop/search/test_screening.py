"""Screening against whole walks: what another law or another mesh makes of the markers; and fits that leave no trace of steps not taken."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.errors import DataError
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import to_linear
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit import joint_fit
from femsense.loop.fit.fitted_model import FittedModel, fit_model, with_nuisance
from femsense.loop.fit.joint_fit import Jets, JointProblem, Prior
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.improve import improve
from femsense.loop.search.effect_fields import effect_fields
from femsense.loop.search.refit import with_term
from femsense.loop.search.search_state import Search
from femsense.loop.verdict import returned_model, sentences, verdict
from femsense.model.effects import FORMS, apply_effects, find_effect
from femsense.model.observation import Hypothesis, marker_residual, placements
from femsense.model.remeshing import robot_on_mesh
from femsense.model.robot import Robot

NOISE = Noise({"white": 1e-4}, "")


def staged(robot: Robot, height: float = 3.0) -> tuple[Data, FittedModel]:
    inputs, labels = sweeps(height, each=1)
    recording, _ = record(inputs, labels=labels)
    data = prepare(robot, [recording], [])
    hypothesis, prior = with_nuisance(data)
    return data, fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))


def whole_change(data: Data, fitted: FittedModel, other: Robot) -> np.ndarray:
    """Return by how much another robot changes the residual, each state solved for itself."""
    trial, jet = data.train[0], fitted.fit.jets[0]
    fixed = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    poses, _ = trial.place(fitted.fit.fit.theta[: fitted.fit.own], data.robot.marker_points.mean(axis=0))
    ties, model = other.tie_markers(placements(fixed, trial.scene, poses)), {}
    for k in jet.states:
        inputs = trial.scene.recording.inputs[k] + fixed.actuation.tension_offset
        tension = dict(zip(other.body.cable_names, np.maximum(fixed.actuation.gain * inputs, 0.0)))
        model[k] = ties.positions(solve_equilibrium(other.body, tension=tension).positions)
    return np.asarray(marker_residual(other, trial.scene, poses, model) - jet.residual)


@pytest.mark.parametrize("form", [f for f in FORMS if f.name == "hyperelastic"], ids=["neo_hookean", "gent"])
def test_another_law_is_screened_by_what_it_would_do(form) -> None:
    data, fitted = staged(arm((5, 2, 2)))
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    (seed,) = form.seeds(robot)
    parameters = form.parameters(robot, "tension")
    fields = effect_fields(fitted.fit, data.train, [(form, seed, parameters)])
    entry = {**seed, "jm": 1 / 0.3} if parameters else seed
    whole = whole_change(data, fitted, form.apply(robot, entry))
    assert np.linalg.norm(fields.raw[0][:, :, 0] - whole) < 1e-3 * np.linalg.norm(whole)
    assert np.abs(whole).max() > 1e-4


def test_another_mesh_is_screened_by_what_it_would_do() -> None:
    declared = arm((5, 2, 2))
    linear = to_linear(declared.body.mesh)
    effect = find_effect("discretisation")
    data, fitted = staged(robot_on_mesh(declared, linear), 1.0)
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    seed = {"element": "tet10"}
    fields = effect_fields(fitted.fit, data.train, [(effect, seed, ())])
    whole = whole_change(data, fitted, effect.apply(robot, seed))
    assert np.linalg.norm(fields.raw[0][:, :, 0] - whole) < 1e-3 * np.linalg.norm(whole)
    assert np.abs(whole).max() > 1e-3


def test_a_step_that_is_not_taken_leaves_no_state_behind() -> None:
    data, fitted = staged(arm((4, 2, 2)))
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


def test_a_step_that_goes_too_far_is_refused_and_not_solved_by_all_means(monkeypatch: pytest.MonkeyPatch) -> None:
    data, fitted = staged(arm((4, 2, 2)))
    problem = JointProblem(fitted.fit.hypothesis, fitted.fit.prior, data.train, [NOISE.whitener(data.train[0].groups, None)], 1.0)
    problem.near = fitted.fit.jets
    rough_only, plain = list[bool](), JointProblem._jets

    def too_far(self: JointProblem, theta: np.ndarray, derivative: bool, rough: bool) -> object:
        rough_only.append(rough)
        if rough:
            raise DataError("no equilibrium")
        return plain(self, theta, derivative, rough)

    monkeypatch.setattr(JointProblem, "_jets", too_far)
    theta = np.array(fitted.fit.fit.theta)
    problem.evaluate(theta, False)  # the start is solved by all means
    with pytest.raises(DataError):
        problem.evaluate(theta + 0.01, False)
    assert rough_only == [True, False, True]


@pytest.mark.parametrize("clamp", ["base_compliance", None])
def test_a_fit_begins_at_the_states_of_the_model_before_unless_their_clamp_is_another(clamp: str | None) -> None:
    data, fitted = staged(arm((4, 2, 2)))
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
    (starts,) = begins._starts(theta, True)
    assert wanted and all(starts[k].positions is state.positions for k, state in wanted.items())


def test_states_that_are_far_apart_lend_each_other_no_factors() -> None:
    data, _ = staged(arm((4, 2, 2)))
    body, kept = data.robot.body, data.train[0].starts_on(data.robot.body.mesh)
    k = next(k for k, state in kept.items() if state.factor is not None)
    free = ~np.isin(np.arange(len(body.mesh.nodes)), body.clamped)[:, None]
    beside, far = (replace(kept[k], positions=kept[k].positions + by * body.reach * free, factor=None) for by in (0.005, 0.02))
    assert joint_fit._lent(kept[k], beside, body).factor is kept[k].factor and joint_fit._lent(kept[k], far, body).factor is None
    assert all(joint_fit._lent(kept[k], state, body).positions is state.positions for state in (beside, far))


def test_a_fit_that_ends_on_its_way_has_the_residual_of_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    data, fitted = staged(arm((4, 2, 2)))
    plain = joint_fit.gauss_newton

    def tries_further(evaluate: Any, theta: np.ndarray, **more: Any) -> Any:
        fit = plain(evaluate, theta, **{**more, "trusted": 1e9})
        evaluate(fit.theta + 1e-3, False)  # a step that is not taken
        return replace(fit, own=False)

    monkeypatch.setattr(joint_fit, "gauss_newton", tries_further)
    trial = replace(data.train[0], initial=None)
    start = fitted.fit.coordinates + 0.02
    fit = joint_fit.fit_jointly(fitted.fit.hypothesis, fitted.fit.prior, [trial], NOISE, 1.0, start, near=fitted.fit.jets)
    white = whiten(NOISE.whitener(trial.groups, None), fit.jets[0].residual)
    np.testing.assert_allclose(white, fit.fit.residual[: white.size], atol=1e-3)


def test_a_model_without_equilibrium_is_not_handed_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def collapses(*_: object, **__: object) -> FittedModel:
        raise DataError("no equilibrium in frame 3")

    data, fitted = staged(arm((4, 2, 2)), 1.0)
    search = Search(fitted, [("", fitted)], fitted, fitted, NOISE, 10.0, [], [], [], None)
    monkeypatch.setattr(returned_model, "keeping", collapses)
    assert verdict.worth_handing_back(data, search, ["stiffness"], ["stiffness"]) == ([], fitted)
    chain = verdict._chain(data, search, ["stiffness"], ["stiffness"], fitted, {})
    assert [c["validation_rms_after_m"] for c in chain] == [fitted.held_rms]


def test_a_model_may_have_a_larger_error_on_held_out_data_where_that_is_the_mesh_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    data, fitted = staged(arm((4, 2, 2)), 1.0)
    before, base, back = (replace(fitted, held_rms=v) for v in (1.0, 1.5, 1.4))
    back = replace(
        back, fit=replace(fitted.fit, hypothesis=replace(fitted.fit.hypothesis, settled=((find_effect("hyperelastic"), {}),)))
    )
    search = Search(before, [("", base)], base, back, NOISE, 10.0, [], [], [], None)

    def holds(error: float, *, chi2: float = 50.0, beyond: float = 0.5) -> bool:
        model = replace(back, held_rms=error)
        monkeypatch.setattr(returned_model, "held_chi2", lambda _, s, noise: chi2 if s is model else 100.0)
        sizes = iter([0.8, beyond])
        monkeypatch.setattr(returned_model, "beyond_mesh", lambda *_: next(sizes))
        return returned_model.holds_out(data, search, model)

    assert holds(1.4) and holds(1.0, chi2=200.0)
    assert not holds(1.6)  # more than all that calibration may move
    search = replace(search, before=replace(fitted, held_rms=1.4))
    assert holds(1.56, chi2=49.0) and not holds(1.56, chi2=51.0) and not holds(1.65, chi2=49.0)  # a fall by 50 is far better
    search = replace(search, before=before)
    assert not holds(1.4, chi2=105.0) and holds(1.4, chi2=95.0)
    assert not holds(1.4, beyond=0.9)


@pytest.mark.parametrize("names, held", [(["stiffness"], True), (["stiffness", "cable_offset"], False)])
def test_a_larger_error_is_not_for_zeros_of_cables_which_much_else_looks_like(
    monkeypatch: pytest.MonkeyPatch, names: list[str], held: bool
) -> None:
    data, fitted = staged(arm((4, 2, 2)), 1.0)
    terms = tuple(t for t in fitted.fit.hypothesis.terms if t[0].name in names)
    back = replace(fitted, held_rms=1.4, fit=replace(fitted.fit, hypothesis=replace(fitted.fit.hypothesis, terms=terms)))
    search = Search(replace(fitted, held_rms=1.0), [("", back)], back, back, NOISE, 10.0, [], [], [], None)
    monkeypatch.setattr(returned_model, "held_chi2", lambda _, s, noise: 40.0 if s is back else 80.0)
    monkeypatch.setattr(returned_model, "beyond_mesh", lambda *_: 0.5)
    assert returned_model.holds_out(data, search, back) == held


@pytest.mark.parametrize(("noise_mm", "small"), [(0.2, False), (0.4, True)])
def test_a_residual_no_larger_than_the_noise_is_said_to_be_so(noise_mm: float, small: bool) -> None:
    fitted = replace(staged(arm((4, 2, 2)), 1.0)[1], held_rms=3e-4)
    noise = Noise({"white": 1e-3 * noise_mm / np.sqrt(3.0)}, "")
    sentence = verdict.verdict_in_words("unexplained", [], [], fitted, fitted, noise, None)
    assert sentence.startswith("A residual is left that no effect of the list explains")
    assert ("no larger than the noise" in sentence) == small and f"0.30 mm, noise {noise_mm:.2f} mm" in sentence


@pytest.mark.parametrize("error, mesh, expected", [(0.5, None, False), (0.5, 1.0, False), (0.9, 1.0, True)])
def test_where_the_data_are_explained_by_what_the_mesh_costs_the_sentence_says_so(
    error: float, mesh: float | None, expected: bool
) -> None:
    _, fitted = staged(arm((4, 2, 2)), 1.0)
    fitted = replace(fitted, held_rms=1e-3 * error)
    noise = Noise({"white": 0.5e-3 / np.sqrt(3.0)}, "")
    sentence = verdict.verdict_in_words("none", [], [], fitted, fitted, noise, None if mesh is None else 1e-3 * mesh)
    assert ("its discretisation error (1.00 mm" in sentence) == expected and "noise (0.50 mm)" in sentence


def test_values_are_said_in_short_whatever_they_are() -> None:
    values = {
        "center_m": {"value": [0.0151, -1.4e-19, -0.0264], "unit": "m"},
        "share": {"value": 0.24567, "unit": "1"},
        "markers": {"value": ["Base-1", "Base-2"], "unit": "1"},
        "scale": {"value": {"a": 0.9, "b": [0.0, 0.0]}, "unit": "1"},
    }
    said = sentences.values_in_words(values)
    assert said == "center_m [0.0151, 0, -0.0264] m, share 0.246, markers [Base-1, Base-2], scale a 0.9, b [0, 0]"


@pytest.mark.parametrize("mesh, costs", [(None, "0.50 mm."), (0.3e-3, "0.50 mm; the discretisation error is 0.30 mm.")])
def test_what_neither_the_noise_nor_the_mesh_explains_is_not_said_to_be_explained(mesh: float | None, costs: str) -> None:
    fitted = replace(staged(arm((4, 2, 2)), 1.0)[1], held_rms=0.9e-3)
    sentence = verdict.verdict_in_words("none", [], [], fitted, fitted, Noise({"white": 0.5e-3 / np.sqrt(3.0)}, ""), mesh)
    assert sentence == f"Nothing that was tried explains more of the data: held-out error 0.90 mm; their noise is {costs}"


@pytest.mark.parametrize("linear, named", [(True, True), (False, True), (True, False)])
def test_effects_that_are_named_on_linear_elements_may_stand_for_these(
    monkeypatch: pytest.MonkeyPatch, linear: bool, named: bool
) -> None:
    robot = arm((4, 2, 2))
    data, fitted = staged(robot_on_mesh(robot, to_linear(robot.body.mesh)) if linear else robot, 1.0)
    settled = ((find_effect("hyperelastic"), {}),) if named else ()
    back = replace(fitted, fit=replace(fitted.fit, hypothesis=replace(fitted.fit.hypothesis, settled=settled)))
    monkeypatch.setattr(sentences, "mesh_error_rms", lambda data: 2e-3)
    assert ("try discretisation" in sentences.on_linear(data, back)) == (linear and named)


def test_a_modulus_that_is_as_declared_once_zeros_stay_is_not_handed_back(monkeypatch: pytest.MonkeyPatch) -> None:
    data, softer = staged(arm((4, 2, 2), modulus=250e3))
    as_declared = replace(
        softer.fit, fit=replace(softer.fit.fit, theta=np.append(softer.fit.fit.theta[: softer.fit.own], [0.0] * 5))
    )
    search = Search(softer, [("", softer)], softer, softer, NOISE, 10.0, [], [], [], None)
    assert verdict.worth_handing_back(data, search, ["stiffness"], ["stiffness"])[0] == ["stiffness"]
    monkeypatch.setattr(returned_model, "keeping", lambda *_, **__: replace(softer, fit=as_declared))
    assert verdict.worth_handing_back(data, search, ["stiffness"], ["stiffness"])[0] == []


def with_gain(modulus: float) -> tuple[Data, Search]:
    """Return the search that found a cable's gain in a body whose modulus is off, too."""
    declared = arm((4, 2, 2))
    truth = apply_effects(arm((4, 2, 2), modulus=modulus), [{"name": "cable_gain", "scale": {"left": 0.92}}])
    inputs, labels = sweeps(3.0)
    recording, _ = record(inputs, labels=labels, truth=truth, noise=5e-5)
    data = prepare(declared, [recording], [])
    noise = Noise({"white": 5e-5}, "")
    hypothesis, prior = with_nuisance(data)
    base = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    before = fit_model(data, Hypothesis(declared), Prior(np.zeros(0), np.zeros(0)), noise, np.zeros(0))
    gain = find_effect("cable_gain")
    parameters = tuple(p for p in gain.parameters(declared, "tension") if p.part == "left")
    final = fit_model(data, *with_term(base.fit, gain, {}, parameters), noise, np.append(base.fit.coordinates, 0.0))
    return data, Search(before, [("", base), ("cable_gain", final)], base, final, noise, 100.0, [], [], [], None)


def handed_back(data: Data, search: Search) -> tuple[list[str], float]:
    """Return the names that are handed back, and the gain."""
    names, back = verdict.worth_handing_back(data, search, [], ["cable_gain"])
    (entry,) = [e for e in back.fit.hypothesis.entries(back.fit.coordinates) if e["name"] == "cable_gain"]
    return names, entry["scale"]["left"]


def test_a_modulus_that_is_off_by_little_goes_along_with_an_effect_that_would_make_up_for_it() -> None:
    data, search = with_gain(300e3 * 0.982)
    assert not verdict.promoted_nuisances(data, search)
    names, gain = handed_back(data, search)
    assert names == ["stiffness", "cable_gain"]
    alone = returned_model.keeping(data, search.final, ["cable_gain"], search.noise)
    by_itself = float(np.exp(alone.fit.coordinates[0]))
    assert abs(gain - 0.92) < 0.4 * abs(by_itself - 0.92)


def test_a_modulus_that_zeros_hide_goes_along_where_it_is_plain_without_them() -> None:
    data, search = with_gain(300e3 * 0.982)
    fit, covariance = search.final.fit, np.array(search.final.fit.fit.covariance)
    covariance[fit.own, fit.own] *= 1e4
    vague = replace(search.final, fit=replace(fit, fit=replace(fit.fit, covariance=covariance)))
    search = replace(search, final=vague, history=[search.history[0], ("cable_gain", vague)])
    assert not returned_model.moved_nuisance(data, vague, "stiffness", relevant=0.0)
    names, gain = handed_back(data, search)
    assert names == ["stiffness", "cable_gain"] and abs(gain - 0.92) < 2e-3


def test_a_modulus_that_moved_too_little_to_be_named_by_itself_goes_along_where_held_out_data_miss_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def folds(*_: object) -> FittedModel:
        raise DataError("no equilibrium in frame 3")

    data, search = with_gain(300e3 * 0.982)
    monkeypatch.setattr(returned_model, "with_sizes_still", folds)
    names, _ = verdict.worth_handing_back(data, search, ["stiffness"], ["stiffness", "cable_gain"])
    assert names == ["stiffness", "cable_gain"]


@pytest.mark.parametrize("tolerated, more, kept", [(1.02, 0.0, False), (1.2, 0.0, True), (1.2, 20.0, False)])
def test_what_is_handed_back_keeps_the_size_that_it_has_beside_all_nuisances_unless_held_out_data_miss_those(
    monkeypatch: pytest.MonkeyPatch, tolerated: float, more: float, kept: bool
) -> None:
    data, search = with_gain(300e3)
    beside = float(np.exp(search.final.fit.coordinates[-1]))
    alone = float(np.exp(returned_model.keeping(data, search.final, ["cable_gain"], search.noise).fit.coordinates[0]))
    assert abs(alone - beside) > 1e-3
    monkeypatch.setattr(returned_model, "NOT_WORSE", tolerated)
    monkeypatch.setattr(returned_model, "held_chi2", lambda _, fitted, noise: 100.0 + more * (fitted is not search.final))
    assert handed_back(data, search) == (["cable_gain"], pytest.approx(beside if kept else alone, abs=1e-5))


def test_a_linear_mesh_is_asked_for_quadratic_elements_whatever_else_makes_up_for_it() -> None:
    """Calibration makes the locking arm so soft that quadratic elements of that softness fold: screening cannot see them."""
    inputs, labels = sweeps(2.0)
    declared = arm((7, 2, 2), law="neo_hookean")
    recording, _ = record(inputs, labels=labels, truth=declared)  # a finer truth is softer by 1 %, which is named beside it
    linear = robot_on_mesh(declared, to_linear(declared.body.mesh))
    found = improve(linear, [recording], effects=["discretisation", "poisson", "cable_gain"])
    assert [e.name for e in found.effects] == ["discretisation"]
    assert found.after.validation_rms_m < 0.2 * found.before.validation_rms_m
    row = next(c for c in found.candidates if c.name == "discretisation")
    assert row.verdict == "named" and row.dbic > 10.0
    assert {str(r.seed) for r in row.refits} == {"{'element': 'tet10'}", "{'refinements': 1}"}


def test_linear_elements_stay_where_the_data_do_not_miss_quadratic_ones() -> None:
    inputs, labels = sweeps(0.005)  # it hardly moves
    declared = arm((7, 2, 2))
    declared = declared.with_body(declared.body.with_gravity([0.0, 0.0, 0.0]))
    recording, _ = record(inputs, labels=labels, truth=declared)
    linear = robot_on_mesh(declared, to_linear(declared.body.mesh))
    found = improve(linear, [recording], effects=["discretisation", "cable_gain"])
    assert found.verdict == "none" and not found.effects
    row = next(c for c in found.candidates if c.name == "discretisation")
    assert row.refits[0].verdict.startswith("too little evidence")


def test_the_numbers_of_a_seed_cost_as_much_as_parameters():
    place = {"center_m": [0.0, 0.0, 0.0], "radius_m": 0.1}
    assert penalty(1, place, 1, 10, 1000.0) == pytest.approx(5 * np.log(1000.0) + 2 * np.log(10))
    assert penalty(0, {"law": "neo_hookean"}, 1, 10, 1000.0) == pytest.approx(2 * np.log(10))
