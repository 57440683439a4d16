"""Where an effect acts: some states show the way to places, fits decide, and what is in its place is not sought again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.least_squares import STOPPED_EARLY
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.representative_states import FEWEST, spread_states
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.discretisation_error import with_mesh_errors
from femsense.loop.fit.fitted_model import FittedModel, fit_model, held_chi2, own_of, problem_of, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search.acceptance import acceptance_test
from femsense.loop.search.effect_fields import effect_fields, fields_of, part_that_tells
from femsense.loop.search.forward_selection import has_settled, select_next
from femsense.loop.search.location_search import climbed, closer, fitted_at, located, may_lie_elsewhere, same_place, without_term
from femsense.loop.search.refit import evidence, refit, refit_from
from femsense.loop.search.screening import Candidate, screen, screen_model
from femsense.loop.search.search_state import Refit
from femsense.loop.search.subsampling import RepresentativeCases, representative_cases
from femsense.loop.search.swaps import swapped
from femsense.loop.thresholds import DEFAULTS, EFFORT
from femsense.model.effects import apply_effects, find_effect
from femsense.model.observation import Hypothesis

RECORD = RefitRecord("", {})
NOISE = Noise({"white": 1e-4}, "")
COUNT = 300.0
HIDDEN: list[dict[str, Any]] = [
    {"name": "payload", "point_m": [0.066, 0.004, 0.01], "force_n": [0.0, 0.3, -0.4]},
    {"name": "cable_gain", "scale": {"up": 1.15}},
]


@pytest.fixture(scope="module")
def started() -> tuple[Data, FittedModel]:
    inputs, labels = sweeps(each=6)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)), effects=HIDDEN[:1])
    data = prepare(arm((4, 1, 1)), [recording], [])
    hypothesis, prior = with_nuisance(data)
    fitted = fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    return data, fit_model(data, hypothesis, prior, NOISE, fitted.fit.coordinates, own=own_of(fitted))  # not of a rough step


def payloads(data: Data, fitted: FittedModel) -> list[Candidate]:
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["payload"]), COUNT)
    return [c for c in table if len(c.parameters) == 3]


def off(candidate: Candidate) -> float:
    return float(np.linalg.norm(np.subtract(candidate.seed["point_m"], HIDDEN[0]["point_m"])))


@pytest.fixture
def toilsome(started: tuple[Data, FittedModel]) -> tuple[Data, FittedModel]:
    """The same, as if all states were too much work."""
    data, fitted = started
    return replace(data, effort=replace(EFFORT, work=FEWEST * len(data.robot.body.mesh.tets))), fitted


@pytest.fixture
def some(toilsome: tuple[Data, FittedModel]) -> RepresentativeCases:
    """Some of the states, of data with an error of the mesh."""
    data, fitted = toilsome
    return representative_cases(with_mesh_errors(data, fitted, []), fitted, NOISE)


def test_some_states_of_a_fit_are_what_a_fit_to_these_begins_with(started: tuple[Data, FittedModel], some: RepresentativeCases):
    fit, fitted = some.fitted.fit, started[1]
    assert some.spares and some.data.train[0].mesh_error is not None and not some.data.held
    residual, jacobian = problem_of(some.data, fit, NOISE).evaluate(fitted.fit.fit.theta, True)
    assert jacobian is not None and len(residual) < 0.6 * len(fitted.fit.fit.residual)
    np.testing.assert_allclose(fit.fit.residual, residual, atol=1e-4)
    np.testing.assert_allclose(fit.fit.jacobian, jacobian, atol=1e-3 * np.abs(jacobian).max())
    assert fit.chi2 == pytest.approx(residual @ residual, rel=1e-4)
    assert some.of(fitted.fit, NOISE).chi2 == fit.chi2


def test_where_all_states_are_little_work_none_is_left_out(started: tuple[Data, FittedModel]):
    data, fitted = started
    every = representative_cases(data, fitted, NOISE)
    assert every.fitted is fitted and all(rows.all() for rows in every.rows) and not every.spares


def test_a_candidate_is_the_same_to_some_states(started: tuple[Data, FittedModel], some: RepresentativeCases):
    data, fitted = started
    one = payloads(data, fitted)[0]
    own = some.candidate(one, NOISE)
    fields = effect_fields(some.fitted.fit, some.data.train, [(one.effect, one.seed, one.parameters)])
    expected = screen(some.fitted.fit, problem_of(some.data, some.fitted.fit, NOISE), fields, COUNT)[0]
    assert own is not None and own.cost == one.cost and own.gain == pytest.approx(expected.gain, rel=1e-4) and own.gain < one.gain
    np.testing.assert_allclose(own.step, expected.step, rtol=1e-3)
    rubbing = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_friction"]), COUNT)[0]
    assert some.candidate(replace(rubbing, step=np.array([0.1])), NOISE) is None  # its states need those before


IN_SOME = "stopped early: in some of the states"


def searched(
    started: tuple[Data, FittedModel], *names: str, alike: bool = False, each: int = 1
) -> tuple[list[str], list[RefitRecord]]:
    """Return what growth says that it refits of a shortlist, whose scores may be alike, and its records; what is left explains the data."""
    data, fitted = started
    data = replace(data, thresholds=replace(DEFAULTS, explains=np.inf, promising=-1e9))
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, names), COUNT)
    listed = [c for n in names for c in [c for c in table if c.effect.name == n][: each if n == "payload" else 1]]
    said = list[str]()
    winner, records = select_next(data, fitted, [replace(c, score=100.0) if alike else c for c in listed], NOISE, said.append)
    assert winner is not None and winner.candidate.effect.name == "payload" and "refitting with payload" in said
    return [text for text in said if text.startswith("refitting")], records


def test_rivals_that_stay_far_behind_in_some_states_are_not_fitted_to_all(toilsome: tuple[Data, FittedModel]):
    _, records = searched(toilsome, "payload", "cable_gain", "poisson")
    assert [r.name for r in records] == ["payload", "cable_gain", "poisson"]
    assert all(r.verdict.startswith(IN_SOME) for r in records[1:])


def test_what_promises_as_much_is_fitted_to_all_states_in_the_order_of_what_it_explains_in_some(
    toilsome: tuple[Data, FittedModel],
):
    said, records = searched(toilsome, "cable_gain", "payload", alike=True)
    assert said[:3] == [
        "refitting with cable_gain in some states",
        "refitting with payload in some states",
        "refitting with payload",
    ]
    assert [r.name for r in records] == ["payload", "cable_gain"] and records[1].verdict.startswith(IN_SOME)


def test_rivals_are_fitted_to_all_states_where_these_are_little_work(started: tuple[Data, FittedModel]):
    said, records = searched(started, "payload", "cable_gain", "poisson")
    assert said == [f"refitting with {name}" for name in ("payload", "cable_gain", "poisson")]
    assert not any("some of the states" in r.verdict for r in records)


def test_another_form_of_an_effect_is_held_against_other_effects_alone(started: tuple[Data, FittedModel]):
    data, fitted = started
    data = replace(data, thresholds=replace(DEFAULTS, explains=np.inf, promising=-1e9))
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["payload", "cable_gain"]), COUNT)
    one, gain = (next(c for c in table if c.effect.name == name) for name in ("payload", "cable_gain"))
    forms = [replace(one, score=100.0), replace(one, effect=replace(one.effect), score=100.0), replace(gain, score=50.0)]
    _, records = select_next(data, fitted, forms, NOISE, lambda text: None)
    assert [r.name for r in records] == ["payload", "payload", "cable_gain"]
    assert "stopped early" not in records[1].verdict and records[2].verdict.startswith("stopped early")


def test_some_states_are_spread_and_never_too_few(started: tuple[Data, FittedModel]):
    trial = started[0].train[0]
    inputs, frames = trial.scene.recording.inputs, trial.scene.frames
    states = {k: inputs[k].round(9).tobytes() for k in frames}
    every = len(set(states.values()))
    assert every > FEWEST + 2 and len(frames) > every  # some states come back
    for most, count in ((1, FEWEST), (FEWEST + 2, FEWEST + 2), (1000, every)):
        cases, share = spread_states(trial, most)
        assert share == pytest.approx(count / every)
        assert len({states[k] for k in cases}) == count
        assert cases.tolist() == [k for k in frames if states[k] in {states[f] for f in cases}]
        np.testing.assert_allclose(inputs[cases].max(axis=0), inputs[frames].max(axis=0))


def test_fields_are_those_of_the_fit_whatever_was_solved_last(started: tuple[Data, FittedModel]):
    data, fitted = started
    fit = fitted.fit
    fitted = fit_model(data, fit.hypothesis, fit.prior, NOISE, fit.coordinates, own=own_of(fitted))  # not of a rough step
    robot, trial = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates), data.train[0]
    payload = find_effect("payload")
    one = (payload, payload.seeds(robot)[0], payload.parameters(robot, data.control))
    expected = effect_fields(fitted.fit, data.train, [one]).raw[0]
    elsewhere = Hypothesis(robot.with_body(robot.body.with_gravity(np.array([0.0, 9.0, 0.0]))))
    fit_model(data, elsewhere, Prior(np.zeros(0), np.zeros(0)), NOISE, np.zeros(0), own=own_of(fitted))
    states = trial.starts_on(robot.body.mesh)
    assert any(not np.array_equal(states[k].positions, s.positions) for k, s in fitted.fit.jets[0].states.items())
    found = effect_fields(fitted.fit, data.train, [one]).raw[0]
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_a_few_states_lead_to_the_place_and_alike_places_are_fitted_once(started: tuple[Data, FittedModel]):
    data, fitted = started
    far = max(payloads(data, fitted)[:6], key=off)
    begun = refit(data, fitted, far, NOISE)
    best, _ = located(data, fitted, far, begun, climbed(data, fitted, far, NOISE), NOISE)
    where = best.fit.hypothesis.terms[-1][1]["point_m"]
    assert off(far) > 0.012 and np.linalg.norm(np.subtract(where, HIDDEN[0]["point_m"])) < 0.004
    still = replace(data, effort=replace(EFFORT, rounds=0))  # climbs end where they begin
    for same_field, same_step, count in ((2.0, 0.0, 2), (-1.0, np.inf, 1)):
        own = replace(still, thresholds=replace(DEFAULTS, same_field=same_field, same_step=same_step))
        climbs = climbed(own, fitted, far, NOISE)
        assert len(climbs) == count and len(fitted_at(own, fitted, far, begun, climbs, NOISE)) <= count


def test_a_refit_begins_where_one_to_some_of_the_states_ended(started: tuple[Data, FittedModel], some: RepresentativeCases):
    data, fitted = started
    one = payloads(data, fitted)[0]
    own = some.candidate(one, NOISE)
    assert own is not None
    near, plain = refit(some.data, some.fitted, own, NOISE), refit(data, fitted, one, NOISE)
    made = refit(data, fitted, one, NOISE, begin=near.fit)
    hypothesis, prior = near.fit.hypothesis, near.fit.prior
    there = fit_model(data, hypothesis, prior, NOISE, near.fit.coordinates, own=own_of(near), max_iterations=0)
    assert made.fit.fit.cost[0] == pytest.approx(there.fit.chi2, rel=0.01)
    assert made.fit.fit.cost[0] < 0.5 * plain.fit.fit.cost[0]
    assert made.fit.chi2 == pytest.approx(plain.fit.chi2, abs=1.0)


def test_a_fit_to_all_states_starts_from_those_of_the_fit_to_some(started: tuple[Data, FittedModel], some: RepresentativeCases):
    data, fitted = started
    one = payloads(data, fitted)[0]
    own = some.candidate(one, NOISE)
    assert own is not None
    near = refit(some.data, some.fitted, own, NOISE).fit
    refit(data, fitted, one, NOISE)  # what else was tried has left its states since then
    theta = np.array(near.fit.theta)
    theta[near.own] = np.log(1e-3)  # a modulus with which nothing stands: it ends where it began
    fallen = replace(near, fit=replace(near.fit, theta=theta))
    assert refit_from(data, fitted, fallen, NOISE) is None
    starts = data.train[0].starts_on(near.hypothesis.robot.body.mesh)
    assert near.jets[0].states and all(starts[k].positions is s.positions for k, s in near.jets[0].states.items())


def test_places_are_alike_if_they_do_the_same_for_the_same(started: tuple[Data, FittedModel]):
    data, fitted = started
    one = payloads(data, fitted)[0]
    other = replace(one, step=-one.step)
    assert same_place(one, replace(one, step=1.05 * one.step), DEFAULTS) and not same_place(one, other, DEFAULTS)
    across = replace(one, columns=np.roll(one.columns, 7, axis=0))
    assert not same_place(one, across, DEFAULTS)


def test_an_effect_in_its_place_is_not_sought_elsewhere_and_one_that_is_not_is():
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)), effects=HIDDEN)
    data = prepare(arm((4, 1, 1)), [recording], [])
    hypothesis, prior = with_nuisance(data)
    base = fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    gains = screen_model(data, base.fit, NOISE, fields_of(data, base, ["cable_gain"]), COUNT)
    gained = refit(data, base, gains[0], NOISE)
    far = max((c for c in payloads(data, gained)[:6] if off(c) > 0.012), key=off)
    wrong = refit(data, gained, far, NOISE)
    right, _ = located(data, gained, far, wrong, climbed(data, gained, far, NOISE), NOISE)
    assert may_lie_elsewhere(data, wrong, "payload", NOISE)
    assert may_lie_elsewhere(data, right, "cable_gain", NOISE)  # it has no place: nothing is known
    assert not may_lie_elsewhere(data, right, "payload", NOISE)
    history = [("", base), ("payload", wrong), ("cable_gain", right)]
    named, said = RefitRecord("payload", {}, NAMED, step=1, dbic=1000.0), list[str]()
    assert swapped(data, history, [named], NOISE, COUNT, said.append) == (history, [named])
    assert not any("in the place" in text for text in said)


def test_a_refit_with_nowhere_to_go_is_given_up_where_a_rival_explains_more(started: tuple[Data, FittedModel]):
    data, fitted = started
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain", "creep", "payload"]), COUNT)
    first = {name: next(c for c in table if c.effect.name == name) for name in ("cable_gain", "creep", "payload")}
    one = first["payload"]
    made = refit(data, fitted, one, NOISE)
    score = evidence(fitted.fit, made.fit) - one.cost
    assert score > 100.0 and made.fit.fit.status != STOPPED_EARLY
    for settled in (True, False):
        rival = refit(data, fitted, one, NOISE, wanted=1.1 * score, settled=settled)
        assert (rival.fit.fit.status == STOPPED_EARLY) == settled
    ahead = [Refit(one, made, 0.0, RECORD)]
    assert [has_settled(data, first[name], ahead) for name in first] == [True, False, False]
    assert not has_settled(data, first["cable_gain"], [])


@pytest.mark.parametrize("needless", [True, False])
def test_a_place_moves_on_where_what_it_was_found_beside_is_dropped(started: tuple[Data, FittedModel], needless: bool):
    data, fitted = started
    gains = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain"]), COUNT)
    beside = refit(data, fitted, gains[0], NOISE)
    far = max((c for c in payloads(data, beside)[:6] if off(c) > 0.012), key=off)
    both = refit(data, beside, far, NOISE)
    found = [("", fitted), ("cable_gain", beside), ("payload", both)]
    dear = np.inf if needless else 1.0  # what each number of an effect costs
    left = swapped(data, found, [], NOISE, dear, lambda text: None)[0][-1][1]
    if not needless:
        assert left is both
        return
    assert left.fit.hypothesis.names == ("stiffness", "cable_offset", "payload")
    assert np.linalg.norm(np.subtract(left.fit.hypothesis.terms[-1][1]["point_m"], HIDDEN[0]["point_m"])) < 0.004


def test_a_term_taken_out_leaves_the_others_where_they_are(started: tuple[Data, FittedModel]):
    data, fitted = started
    one = payloads(data, fitted)[0]
    made = refit(data, fitted, one, NOISE)
    less = without_term(made.fit, 0)
    _, _, parameters = made.fit.hypothesis.terms[0]
    kept = [n for n in made.fit.hypothesis.names if n != made.fit.hypothesis.terms[0][0].name]
    assert list(less.hypothesis.names) == kept
    np.testing.assert_array_equal(less.coordinates, made.fit.coordinates[len(parameters) :])
    assert less.fit.jacobian.shape[1] == made.fit.fit.jacobian.shape[1] - len(parameters)
    assert screen(
        less,
        problem_of(data, made.fit, NOISE),
        effect_fields(made.fit, data.train, [(one.effect, one.seed, one.parameters)]),
        COUNT,
    )


def test_where_a_climb_ends_a_fit_to_all_states_is_made_if_some_of_them_are_for_it(toilsome: tuple[Data, FittedModel]):
    data, fitted = toilsome
    far = max(payloads(data, fitted)[:6], key=off)
    begun, climbs = refit(data, fitted, far, NOISE), climbed(data, fitted, far, NOISE)
    best, _ = located(data, fitted, far, begun, climbs, NOISE)
    assert np.linalg.norm(np.subtract(best.fit.hypothesis.terms[-1][1]["point_m"], HIDDEN[0]["point_m"])) < 0.004
    assert len(best.fit.fit.residual) == len(begun.fit.fit.residual)
    there = fitted_at(data, fitted, far, begun, climbs, NOISE)
    assert there and all(len(one.fit.fit.residual) == len(begun.fit.fit.residual) for one in there)
    own = representative_cases(data, fitted, NOISE).candidate(far, NOISE)
    assert own is not None and not fitted_at(data, fitted, far, best, [own], NOISE)  # what was made explains more by far


def test_a_place_moves_on_as_some_of_the_states_have_it(toilsome: tuple[Data, FittedModel]):
    data, fitted = toilsome
    made = refit(data, fitted, payloads(data, fitted)[0], NOISE)
    moved, scatter = closer(data, made, NOISE)
    begun, end = (np.array(m.fit.hypothesis.terms[-1][1]["point_m"]) for m in (made, moved))
    assert np.linalg.norm(end - HIDDEN[0]["point_m"]) < 0.6 * np.linalg.norm(begun - HIDDEN[0]["point_m"])
    assert moved.fit.chi2 < 0.75 * made.fit.chi2 and len(moved.fit.fit.residual) == len(made.fit.fit.residual)
    assert len(scatter) == 3 and all(0.0 < s < 0.3 for s in scatter)


def test_another_law_is_told_by_some_of_the_states(started: tuple[Data, FittedModel]):
    data, fitted = started
    law = next(f for f in data.forms if f.name == "hyperelastic" and f.discrete)
    seed = law.seeds(data.robot)[0]
    todo = [(law, seed, law.parameters(data.robot, data.control))]
    less = replace(EFFORT, work=FEWEST * len(data.robot.body.mesh.tets))
    whole, between = (effect_fields(fitted.fit, data.train, todo, effort=e).raw[0][:, :, 0] for e in (EFFORT, less))
    part = part_that_tells(data.train[0], data.robot, less)
    assert len(part.scene.frames) < 0.6 * len(data.train[0].scene.frames)
    assert 0.0 < rms_of([between - whole]) < 0.25 * rms_of([whole])
    exact = np.isin(data.train[0].scene.frame, spread_states(data.train[0], FEWEST)[0])
    assert rms_of([(between - whole)[exact]]) < 0.02 * rms_of([whole])
    rubbing = apply_effects(data.robot, [{"name": "cable_friction", "coefficient": 0.2}])
    assert part_that_tells(data.train[0], rubbing, less) is data.train[0]  # states there need those before


@pytest.mark.parametrize(("score", "passes"), [(16.0, True), (14.0, False)])
def test_held_out_data_that_speak_against_an_effect_count(started: tuple[Data, FittedModel], score: float, passes: bool):
    data, fitted = started
    one = payloads(data, fitted)[0]
    made = refit(data, fitted, one, NOISE)
    expensive = replace(one, cost=evidence(fitted.fit, made.fit) - score)
    better = held_chi2(data, fitted, NOISE) - held_chi2(data, made, NOISE)
    against = replace(data, thresholds=replace(DEFAULTS, held_counts=-5.0 / better))  # as if χ² rose by 5
    verdict = acceptance_test(against, fitted, expensive, made, RECORD, NOISE).record.verdict
    assert verdict == "passes" if passes else "held-out data speak against it" in verdict
