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
from femsense.loop.fit.fitted_model import FittedModel, fit_model, held_chi2, own_of, problem_of, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search.acceptance import acceptance_test
from femsense.loop.search.effect_fields import effect_fields, fields_of
from femsense.loop.search.forward_selection import select_next
from femsense.loop.search.location_search import climbed, closer, located, may_lie_elsewhere, same_place, without_term
from femsense.loop.search.refit import evidence, refit
from femsense.loop.search.screening import Candidate, screen, screen_model
from femsense.loop.search.search_state import Setting
from femsense.loop.search.swaps import swapped
from femsense.loop.thresholds import DEFAULTS
from femsense.model.effects import find_effect
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


def test_another_form_of_an_effect_is_held_against_other_effects_alone(started: tuple[Data, FittedModel]):
    data, fitted = started
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["payload", "cable_gain"]), COUNT)
    one, gain = (next(c for c in table if c.effect.name == name) for name in ("payload", "cable_gain"))
    forms = [replace(one, score=100.0), replace(one, effect=replace(one.effect), score=100.0), replace(gain, score=50.0)]
    _, records = select_next(Setting(data, NOISE, COUNT, lambda text: None), fitted, forms)
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


def test_a_place_is_found_from_one_far_off(started: tuple[Data, FittedModel]):
    data, fitted = started
    far = max(payloads(data, fitted)[:6], key=off)
    begun = refit(data, fitted, far, NOISE)
    best, _ = located(data, fitted, far, begun, climbed(data, fitted, far, NOISE), NOISE)
    where = best.fit.hypothesis.terms[-1][1]["point_m"]
    assert off(far) > 0.012 and np.linalg.norm(np.subtract(where, HIDDEN[0]["point_m"])) < 0.004


def test_places_are_alike_if_they_do_the_same_for_the_same(started: tuple[Data, FittedModel]):
    data, fitted = started
    one = payloads(data, fitted)[0]
    other = replace(one, step=-one.step)
    assert same_place(one, replace(one, step=1.05 * one.step)) and not same_place(one, other)
    across = replace(one, columns=np.roll(one.columns, 7, axis=0))
    assert not same_place(one, across)


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
    assert swapped(Setting(data, NOISE, COUNT, said.append), history, [named]) == (history, [named])
    assert not any("in the place" in text for text in said)


def test_a_refit_is_given_up_where_a_rival_explains_more(started: tuple[Data, FittedModel]):
    data, fitted = started
    one = payloads(data, fitted)[0]
    made = refit(data, fitted, one, NOISE)
    score = evidence(fitted.fit, made.fit) - one.cost
    assert score > 100.0 and made.fit.fit.status != STOPPED_EARLY
    for share, stops in ((1.1, True), (0.9, False)):
        rival = refit(data, fitted, one, NOISE, wanted=share * score)
        assert (rival.fit.fit.status == STOPPED_EARLY) == stops


@pytest.mark.parametrize("needless", [True, False])
def test_a_place_moves_on_where_what_it_was_found_beside_is_dropped(started: tuple[Data, FittedModel], needless: bool):
    data, fitted = started
    gains = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain"]), COUNT)
    beside = refit(data, fitted, gains[0], NOISE)
    far = max((c for c in payloads(data, beside)[:6] if off(c) > 0.012), key=off)
    both = refit(data, beside, far, NOISE)
    found = [("", fitted), ("cable_gain", beside), ("payload", both)]
    dear = np.inf if needless else 1.0  # what each number of an effect costs
    left = swapped(Setting(data, NOISE, dear, lambda text: None), found, [])[0][-1][1]
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


@pytest.mark.parametrize(("score", "passes"), [(16.0, True), (14.0, False)])
def test_held_out_data_that_speak_against_an_effect_count(started: tuple[Data, FittedModel], score: float, passes: bool):
    data, fitted = started
    one = payloads(data, fitted)[0]
    made = refit(data, fitted, one, NOISE)
    expensive = replace(one, cost=evidence(fitted.fit, made.fit) - score)
    rise = np.sqrt(1.0 + 5.0 / held_chi2(data, fitted, NOISE))  # χ² rises by 5
    worse = [replace(h, jet=replace(h.jet, residual=rise * h.jet.residual)) for h in fitted.held]
    lenient = replace(data, thresholds=replace(DEFAULTS, held_gain=-1e9))
    verdict = acceptance_test(lenient, fitted, expensive, replace(made, held=worse), RECORD, NOISE).record.verdict
    assert verdict == "passes" if passes else "with the held-out data" in verdict


@pytest.mark.parametrize(("acts", "passes"), [(4.0, True), (16.0, False)])
def test_what_hardly_acts_on_held_out_data_need_not_show_there(started: tuple[Data, FittedModel], acts: float, passes: bool):
    """What shifts them by χ² of A brings A ± 2 √A if it is true: −A is within three deviations of that where A is less than 9."""
    data, fitted = started
    one = payloads(data, fitted)[0]
    made, before = refit(data, fitted, one, NOISE), [h.jet.residual for h in fitted.held]
    shifts = [np.random.default_rng(0).normal(size=r.shape) for r in before]
    along = sum(float(np.vdot(s, r)) for s, r in zip(shifts, before)) / sum(float(np.vdot(r, r)) for r in before)
    across = [s - along * r for s, r in zip(shifts, before)]  # so that χ² of held-out data rises by A
    size = 1e-4 * np.sqrt(acts / sum(float(np.vdot(a, a)) for a in across))
    held = [replace(h, jet=replace(h.jet, residual=h.jet.residual + size * a)) for h, a in zip(fitted.held, across)]
    record = acceptance_test(data, fitted, one, replace(made, held=held), RECORD, NOISE).record
    assert record.held_dchi2 == pytest.approx(-acts, rel=1e-6) and record.dbic > 100.0
    assert record.passes if passes else "does not predict the held-out data" in record.verdict


def test_places_explain_as_much_where_the_misfit_hides_the_difference(started: tuple[Data, FittedModel]):
    data, fitted = started
    near, *others = payloads(data, fitted)
    other = next(c for c in others if np.linalg.norm(np.subtract(c.seed["point_m"], near.seed["point_m"])) > 0.01)
    one, two = (refit(data, fitted, c, NOISE) for c in (near, other))
    best, worse = sorted((one.fit, two.fit), key=lambda fit: fit.chi2)
    less, half = evidence(worse, best), 0.5 * np.abs(one.fit.coordinates[-3:] - two.fit.coordinates[-3:])
    assert worse.chi2 - best.chi2 > 2.0 * less  # so many times the noise is left
    still = replace(DEFAULTS, swap=np.inf)  # no place is moved
    for evident, as_good in ((0.9 * less, False), (1.1 * less, True)):
        own = replace(data, thresholds=replace(still, evidence=evident))
        scatter = np.array(located(own, fitted, near, one, [other], NOISE)[1])
        assert bool((scatter >= 0.99 * half).all()) is as_good


def test_neighbours_explain_as_much_where_the_misfit_hides_the_difference(started: tuple[Data, FittedModel]):
    """At a price at which no neighbour would count by the noise alone, some do, since more than the noise is left."""
    data, fitted = started
    own = replace(data, thresholds=replace(DEFAULTS, swap=np.inf, evidence=200.0))  # no place is moved
    made = refit(data, fitted, payloads(data, fitted)[0], NOISE)
    assert min(closer(own, made, NOISE)[1]) > 0.0
