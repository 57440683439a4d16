"""Where an effect acts: some states show the way to places, fits decide, and what is in its place is not sought again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.least_squares import STOPPED_EARLY
from femsense.fem.linalg import factorization
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.representative_states import FEWEST, spread_states
from femsense.loop.data.trial import Trial, rms_of
from femsense.loop.fit.discretisation_error import with_mesh_errors
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of, problem_of, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search import acceptance, forward_selection, location_search, pruning, subsampling
from femsense.loop.search import effect_fields as effect_fields_module
from femsense.loop.search import refit as refits
from femsense.loop.search.effect_fields import effect_fields, fields_of
from femsense.loop.search.forward_selection import _settled, polished
from femsense.loop.search.location_search import climbed, closer, located, may_lie_elsewhere
from femsense.loop.search.pruning import prune
from femsense.loop.search.refit import EVIDENCE, evidence, refit
from femsense.loop.search.screening import Candidate, screen, screen_model
from femsense.loop.search.search_state import Refit
from femsense.loop.search.subsampling import RepresentativeCases, representative_cases
from femsense.loop.search.swaps import swapped
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
def some(started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch) -> RepresentativeCases:
    """Some of the states, as if all of them were too much work, of data with an error of the mesh."""
    data, fitted = started
    tets = len(fitted.fit.hypothesis.robot.body.mesh.tets)
    monkeypatch.setattr(subsampling, "MOST_WORK", FEWEST * tets)
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


def searched(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch, *names: str, alike: bool = False
) -> tuple[list[tuple[str, bool]], list[RefitRecord]]:
    """Return what growth has refitted of a shortlist, whose scores may be alike, each with whether to all states, and its records."""
    data, fitted = started
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, names), COUNT)
    refitted = list[tuple[str, bool]]()

    def counted(
        own: Data, before: FittedModel, candidate: Candidate, noise: Noise, wanted: float = 0.0, **named: Any
    ) -> FittedModel:
        refitted.append((candidate.effect.name, before is fitted))
        return refit(own, before, candidate, noise, wanted=wanted, **named)

    monkeypatch.setattr(forward_selection, "refit", counted)
    monkeypatch.setattr(forward_selection, "tried", counted)
    monkeypatch.setattr(forward_selection, "explains", lambda fitted: True)
    listed = [next(c for c in table if c.effect.name == n) for n in names]
    monkeypatch.setattr(
        forward_selection, "shortlist", lambda table, first: [replace(c, score=100.0) if alike else c for c in listed]
    )
    monkeypatch.setattr(forward_selection, "_bar", lambda ahead, candidate: -np.inf)
    winner, _, records = forward_selection.select_next(data, fitted, table, NOISE, lambda text: None)
    assert winner is not None and winner.candidate.effect.name == "payload" and ("payload", True) in refitted
    return refitted, records


@pytest.mark.usefixtures("some")
def test_rivals_that_stay_far_behind_in_some_states_are_not_fitted_to_all(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    fitted, records = searched(started, monkeypatch, "payload", "cable_gain", "poisson")
    assert [f for f in fitted if f[0] != "payload"] == [("cable_gain", False), ("poisson", False)]
    assert all(r.verdict.startswith("stopped early: in some of the states") for r in records[1:])


@pytest.mark.usefixtures("some")
def test_what_promises_as_much_is_fitted_to_all_states_in_the_order_of_what_it_explains_in_some(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    fitted, records = searched(started, monkeypatch, "cable_gain", "payload", alike=True)
    assert fitted[:3] == [("cable_gain", False), ("payload", False), ("payload", True)]
    assert ("cable_gain", True) not in fitted
    assert [r.name for r in records] == ["payload", "cable_gain"] and records[1].verdict.startswith("stopped early: in some")


def test_rivals_are_fitted_to_all_states_where_these_are_little_work(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    fitted, records = searched(started, monkeypatch, "payload", "cable_gain", "poisson")
    assert [f for f in fitted if f[0] != "payload"] == [("cable_gain", True), ("poisson", True)]
    assert not any("some of the states" in r.verdict for r in records)


def test_another_form_of_an_effect_is_held_against_other_effects_alone(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["payload", "cable_gain"]), COUNT)
    listed = [*[c for c in table if c.effect.name == "payload"][:2], next(c for c in table if c.effect.name == "cable_gain")]
    asked = list[float]()

    def counted(
        own: Data, before: FittedModel, candidate: Candidate, noise: Noise, wanted: float = 0.0, **named: Any
    ) -> FittedModel:
        asked.append(wanted)
        return refit(own, before, candidate, noise, wanted=wanted, **named)

    for name, value in (("refit", counted), ("explains", lambda fitted: True), ("shortlist", lambda table, first: listed)):
        monkeypatch.setattr(forward_selection, name, value)
    monkeypatch.setattr(forward_selection, "_bar", lambda ahead, candidate: -np.inf)
    forward_selection.select_next(data, fitted, table, NOISE, lambda text: None)
    assert asked[:2] == [forward_selection.EVIDENCE] * 2 and asked[2] > 3 * forward_selection.EVIDENCE


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


def test_fields_are_those_of_the_fit_whatever_was_solved_last(started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch):
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
    factors, plain = list[int](), factorization.cholesky
    monkeypatch.setattr(factorization, "cholesky", lambda *given, **named: (factors.append(1), plain(*given, **named))[1])
    found = effect_fields(fitted.fit, data.train, [one]).raw[0]
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    distinct = {s.positions.tobytes() for s in fitted.fit.jets[0].states.values()}
    assert len(factors) < 1.5 * len(distinct)  # one for the derivatives of each state, hardly any to find it


def test_a_few_states_lead_to_the_place_and_alike_places_are_fitted_once(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    far = max(payloads(data, fitted)[:6], key=off)
    begun = refit(data, fitted, far, NOISE)
    refitted = list[Candidate]()

    def counted(own: Data, before: FittedModel, candidate: Candidate, noise: Noise, **named: Any) -> FittedModel | None:
        refitted.extend([candidate] if before is fitted else [])
        return refit(own, before, candidate, noise, **named)

    monkeypatch.setattr(location_search, "tried", counted)
    best, _ = located(data, fitted, far, begun, climbed(data, fitted, far, NOISE), NOISE)
    where = best.fit.hypothesis.terms[-1][1]["point_m"]
    assert off(far) > 0.012 and np.linalg.norm(np.subtract(where, HIDDEN[0]["point_m"])) < 0.004
    monkeypatch.setattr(location_search, "ROUNDS", 0)  # climbs end where they begin
    for alike, count in ((False, 2), (True, 1)):
        refitted.clear()
        monkeypatch.setattr(location_search, "_alike", lambda one, other, alike=alike: alike)
        located(data, fitted, far, begun, climbed(data, fitted, far, NOISE), NOISE)
        assert len(refitted) == count


def test_a_refit_begins_where_one_to_some_of_the_states_ended(
    started: tuple[Data, FittedModel], some: RepresentativeCases, monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    one = payloads(data, fitted)[0]
    own = some.candidate(one, NOISE)
    assert own is not None
    near, plain, starts = refit(some.data, some.fitted, own, NOISE), refit(data, fitted, one, NOISE), list[np.ndarray]()

    def seen(
        data: Data, hypothesis: Hypothesis, prior: Prior, noise: Noise, coordinates: np.ndarray, **given: Any
    ) -> FittedModel:
        starts.append(coordinates)
        return fit_model(data, hypothesis, prior, noise, coordinates, **given)

    monkeypatch.setattr(refits, "fit_model", seen)
    made = refit(data, fitted, one, NOISE, begin=near.fit)
    assert len(starts) == 1 and np.array_equal(starts[0], near.fit.coordinates)
    assert made.fit.chi2 == pytest.approx(plain.fit.chi2, abs=1.0)


def test_a_fit_to_all_states_starts_from_those_of_the_fit_to_some(
    started: tuple[Data, FittedModel], some: RepresentativeCases, monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    one = payloads(data, fitted)[0]
    own = some.candidate(one, NOISE)
    assert own is not None
    near = refit(some.data, some.fitted, own, NOISE).fit
    refit(data, fitted, one, NOISE)  # what else was tried has left its states since then
    begun = list[bool]()

    def seen(given: Data, hypothesis: Hypothesis, *_: Any, **__: Any) -> FittedModel:
        starts = given.train[0].starts_on(hypothesis.robot.body.mesh)
        begun.extend(starts[k] is state for k, state in near.jets[0].states.items())
        return fitted

    monkeypatch.setattr(refits, "fit_model", seen)
    refits.refit_from(data, fitted, near, NOISE)
    assert begun and all(begun)


def test_a_rival_that_its_place_brings_ahead_goes_there_before_one_is_named(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    far = max(payloads(data, fitted)[:6], key=off)
    rival = forward_selection.acceptance_test(data, fitted, far, refit(data, fitted, far, NOISE), RECORD, NOISE)
    there = polished(data, fitted, rival, NOISE, lambda text: None)
    gains = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain"]), COUNT)
    other = forward_selection.acceptance_test(data, fitted, gains[0], refit(data, fitted, gains[0], NOISE), RECORD, NOISE)
    monkeypatch.setattr(forward_selection, "WITHIN_REACH", rival.score / there.score / 2.0)

    def leaders(lead: float) -> list[Refit]:
        """Of both, the other one ahead of the rival by this share of what the rival gains where it is."""
        first = replace(other, score=rival.score + lead * (there.score - rival.score))
        assert first.score - EVIDENCE > rival.score
        leading, _ = forward_selection.leaders(data, fitted, {0: first, 1: rival}, NOISE, lambda text: None)
        return [leading[i] for i in leading if i > 0]

    (moved,) = leaders(0.2)
    assert moved.candidate.effect.name == "payload" and moved.score == pytest.approx(there.score)
    monkeypatch.setattr(
        forward_selection, "polished", lambda data, fitted, refitted, noise, say: there if refitted.climbs else refitted
    )
    monkeypatch.setattr(forward_selection, "_in_sight", lambda refitted: np.inf)
    assert leaders(0.9) and not leaders(1.2)  # it keeps less than it promised
    assert not leaders(4.0)  # out of reach


def test_places_are_alike_if_they_do_the_same_for_the_same(started: tuple[Data, FittedModel]):
    data, fitted = started
    one = payloads(data, fitted)[0]
    other = replace(one, step=-one.step)
    assert location_search._alike(one, replace(one, step=1.05 * one.step)) and not location_search._alike(one, other)
    across = replace(one, columns=np.roll(one.columns, 7, axis=0))
    assert not location_search._alike(one, across)


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
    assert swapped(data, history, [named], NOISE, COUNT, said.append) == (history, [named]) and not said


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
    ahead = [Refit(one, made, 0.0, 0.0, RECORD)]
    assert [_settled(data, first[name], ahead) for name in first] == [True, False, False]
    assert not _settled(data, first["cable_gain"], [])


@pytest.mark.parametrize("needless", [True, False])
def test_a_place_moves_on_where_what_it_was_found_beside_is_dropped(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch, needless: bool
):
    data, fitted = started
    gains = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain"]), COUNT)
    beside = refit(data, fitted, gains[0], NOISE)
    far = max((c for c in payloads(data, beside)[:6] if off(c) > 0.012), key=off)
    both = refit(data, beside, far, NOISE)
    monkeypatch.setattr(pruning, "evidence", lambda before, after: -1.0 if needless else 1e6)
    left = prune(data, both, NOISE, COUNT, lambda text: None)
    if not needless:
        assert left is both
        return
    assert left.fit.hypothesis.names == ("stiffness", "cable_offset", "payload")
    assert np.linalg.norm(np.subtract(left.fit.hypothesis.terms[-1][1]["point_m"], HIDDEN[0]["point_m"])) < 0.004


def test_a_term_taken_out_leaves_the_others_where_they_are(started: tuple[Data, FittedModel]):
    data, fitted = started
    one = payloads(data, fitted)[0]
    made = refit(data, fitted, one, NOISE)
    less = location_search._without(made.fit, 0)
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


@pytest.mark.usefixtures("some")
def test_where_a_climb_ends_a_fit_to_all_states_is_made_if_some_of_them_are_for_it(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    far = max(payloads(data, fitted)[:6], key=off)
    begun, climbs = refit(data, fitted, far, NOISE), climbed(data, fitted, far, NOISE)
    best, _ = located(data, fitted, far, begun, climbs, NOISE)
    assert np.linalg.norm(np.subtract(best.fit.hypothesis.terms[-1][1]["point_m"], HIDDEN[0]["point_m"])) < 0.004
    assert len(best.fit.fit.residual) == len(begun.fit.fit.residual)
    whole = list[np.ndarray]()
    monkeypatch.setattr(location_search, "refit_from", lambda data, fitted, fit, noise: whole.append(fit.coordinates))
    there = location_search._fitted_at(data, fitted, far, begun, climbs.ends, NOISE)
    assert whole and not there
    whole.clear()
    own = representative_cases(data, fitted, NOISE).candidate(far, NOISE)
    assert own is not None and not location_search._fitted_at(
        data, fitted, far, best, [own], NOISE
    )  # what was made explains more by far
    assert not whole


def test_a_place_moves_on_as_some_of_the_states_have_it(
    started: tuple[Data, FittedModel], some: RepresentativeCases, monkeypatch: pytest.MonkeyPatch
):
    data, fitted = started
    made = refit(data, fitted, payloads(data, fitted)[0], NOISE)
    asked, plain = list[tuple[int, bool]](), location_search._seeds_instead

    def ask(own: Data, at: FittedModel, noise: Noise, seeds: Sequence[dict[str, Any]]) -> list[Candidate]:
        asked.append((len(seeds), len(at.fit.fit.residual) < len(made.fit.fit.residual)))
        return plain(own, at, noise, seeds)

    monkeypatch.setattr(location_search, "_seeds_instead", ask)
    moved, scatter = closer(data, made, NOISE)
    assert all(cases == (count > 1) for count, cases in asked) and {count > 1 for count, _ in asked} == {True, False}
    begun, end = (np.array(m.fit.hypothesis.terms[-1][1]["point_m"]) for m in (made, moved))
    assert np.linalg.norm(end - HIDDEN[0]["point_m"]) < 0.6 * np.linalg.norm(begun - HIDDEN[0]["point_m"])
    assert moved.fit.chi2 < 0.75 * made.fit.chi2 and len(moved.fit.fit.residual) == len(made.fit.fit.residual)
    assert len(scatter) == 3 and all(0.0 < s < 0.3 for s in scatter)


def test_another_law_is_told_by_some_of_the_states(started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch):
    data, fitted = started
    law = next(f for f in data.forms if f.name == "hyperelastic" and f.discrete)
    seed = law.seeds(data.robot)[0]
    todo, asked, part = [(law, seed, law.parameters(data.robot, data.control))], list[int](), Trial.part

    def change() -> np.ndarray:
        return effect_fields(fitted.fit, data.train, todo).raw[0][:, :, 0]

    whole, tets = change(), len(data.robot.body.mesh.tets)
    monkeypatch.setattr(effect_fields_module, "MOST_WORK", FEWEST * tets)
    monkeypatch.setattr(Trial, "part", lambda trial, frames: (asked.append(len(frames)), part(trial, frames))[1])
    between = change()
    assert asked and asked[0] < 0.6 * len(data.train[0].scene.frames)
    assert 0.0 < rms_of([between - whole]) < 0.25 * rms_of([whole])
    exact = np.isin(data.train[0].scene.frame, spread_states(data.train[0], FEWEST)[0])
    assert rms_of([(between - whole)[exact]]) < 0.02 * rms_of([whole])
    rubbing = apply_effects(data.robot, [{"name": "cable_friction", "coefficient": 0.2}])
    assert effect_fields_module._part_that_tells(data.train[0], rubbing) is data.train[0]  # states there need those before


def test_what_promises_as_much_is_refitted_in_the_order_of_its_cost(started: tuple[Data, FittedModel]):
    data, fitted = started
    one, *_ = payloads(data, fitted)
    gain = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain"]), COUNT)[0]
    for share, names in ((0.96, ["cable_gain", "payload"]), (0.94, ["payload", "cable_gain"])):
        second = replace(gain, score=share * one.score, retained=1.0)
        assert second.cost < one.cost
        assert [c.effect.name for c in forward_selection.shortlist([one, second], first=True)] == names


def test_what_calibration_imitates_is_refitted_only_if_it_promises_more_than_all_others(started: tuple[Data, FittedModel]):
    data, fitted = started
    one, *_ = payloads(data, fitted)
    gain = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, ["cable_gain"]), COUNT)[0]
    for share, names in ((1.1, {"cable_gain", "payload"}), (0.9, {"payload"})):
        second = replace(gain, score=share * one.score, retained=0.01)
        assert {c.effect.name for c in forward_selection.shortlist([one, second], first=True)} == names


@pytest.mark.parametrize(("score", "passes"), [(16.0, True), (14.0, False)])
def test_held_out_data_that_speak_against_an_effect_count(
    started: tuple[Data, FittedModel], monkeypatch: pytest.MonkeyPatch, score: float, passes: bool
):
    data, fitted = started
    one = payloads(data, fitted)[0]
    made = refit(data, fitted, one, NOISE)
    expensive = replace(one, cost=evidence(fitted.fit, made.fit) - score)
    monkeypatch.setattr(acceptance, "held_shift", lambda *given: 6.25)  # it acts little there, so that chance may have it
    monkeypatch.setattr(acceptance, "held_chi2", lambda data, at, noise: 5.0 * (at is made))
    verdict = forward_selection.acceptance_test(data, fitted, expensive, made, RECORD, NOISE).record.verdict
    assert verdict == "passes" if passes else "held-out data speak against it" in verdict
