"""What is named while another effect is missing may be wrong: in the whole model a rival, or the effect at another place, takes its place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.errors import DataError
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit.covariance import parameter_std
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search import forward_selection
from femsense.loop.search import refit as refits
from femsense.loop.search import search as searching
from femsense.loop.search.acceptance import acceptance_test
from femsense.loop.search.calibration import fitted_again
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.forward_selection import polished, shortlist
from femsense.loop.search.location_search import closer, without_last
from femsense.loop.search.refit import evidence, refit
from femsense.loop.search.screening import Candidate, linear_gain, screen_model
from femsense.loop.search.search_state import Refit
from femsense.loop.search.swaps import swapped
from femsense.model.effects import find_effect
from femsense.model.observation import Hypothesis

beside_a_tie = searching.beside_a_tie
RECORD = RefitRecord("", {})
NOISE = Noise({"white": 1e-4}, "")
COUNT = 300.0
HIDDEN = [
    {"name": "payload", "point_m": [0.05, 0.0, 0.01], "force_n": [0.06, 0.15, 0.12]},
    {"name": "cable_gain", "scale": {"up": 1.15}},
]


def started() -> tuple[Data, FittedModel]:
    robot = arm((4, 1, 1))
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)), effects=HIDDEN)
    data = prepare(robot, [recording], [])
    hypothesis, prior = with_nuisance(data)
    return data, fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))


def added(data: Data, fitted: FittedModel, name: str, step: int) -> tuple[FittedModel, RefitRecord]:
    """Return a fitted model with one more effect, rightly or not, and its record."""
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, [name]), COUNT)
    record = RefitRecord(name, {}, step=step)
    candidate = max(shortlist(table, first=True) or table, key=lambda c: c.score)
    made = acceptance_test(data, fitted, candidate, refit(data, fitted, candidate, NOISE), record, NOISE)
    return made.fitted, made.saying(NAMED).record


def test_a_rival_that_is_right_takes_the_place_of_what_was_named_first():
    data, base = started()
    first, wrong = added(data, base, "gravity", 1)
    second, right = added(data, first, "cable_gain", 2)
    rival = replace(wrong, name="payload", verdict=PASSES)
    history, refits = swapped(
        data, [("", base), ("gravity", first), ("cable_gain", second)], [wrong, rival, right], NOISE, COUNT, lambda text: None
    )
    assert [name for name, _ in history] == ["", "cable_gain", "payload"]
    assert history[-1][1].fit.chi2 < second.fit.chi2
    assert set(history[1][1].fit.hypothesis.names) == {"stiffness", "cable_offset", "cable_gain"}
    said = {(r.name, r.step): r.verdict for r in refits}
    assert said["gravity", 1] == "passes" and said["payload", 2] == "named"


def test_what_is_right_keeps_its_place():
    data, base = started()
    first, right = added(data, base, "payload", 1)
    second, other = added(data, first, "cable_gain", 2)
    rival = replace(right, name="gravity", verdict=PASSES)
    before = [("", base), ("payload", first), ("cable_gain", second)]
    history, refits = swapped(data, before, [right, rival, other], NOISE, COUNT, lambda text: None)
    assert {name for name, _ in history} == {"", "payload", "cable_gain"}  # perhaps at a better place
    assert history[-1][1].fit.chi2 <= second.fit.chi2
    assert not any(r.is_named for r in refits if r.name == "gravity")


def test_polishing_counts_as_the_evidence_that_it_brings_where_noise_is_larger_than_thought(monkeypatch: pytest.MonkeyPatch):
    data, base = started()
    better, _ = added(data, base, "payload", 1)
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    rough = Refit(shortlist(table, first=True)[0], base, 100.0, 100.0, RECORD)
    monkeypatch.setattr(forward_selection, "_polish", lambda *_: (better, []))
    gained = polished(data, base, rough, NOISE, lambda text: None).score - 100.0
    assert gained == pytest.approx(evidence(base.fit, better.fit)) and gained < 0.9 * (base.fit.chi2 - better.fit.chi2)


def test_a_polished_refit_is_weighed_against_the_model_without_it_as_its_rivals_are(monkeypatch: pytest.MonkeyPatch):
    data, base = started()
    better, _ = added(data, base, "payload", 1)
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    half = replace(base, fit=replace(base.fit, chi2=0.4 * base.fit.chi2))
    ahead = evidence(base.fit, half.fit)
    rough = Refit(shortlist(table, first=True)[0], half, ahead - 20.0, 100.0, RECORD)
    monkeypatch.setattr(forward_selection, "_polish", lambda *_: (better, []))
    assert polished(data, base, rough, NOISE, lambda text: None).score == pytest.approx(evidence(base.fit, better.fit) - 20.0)
    assert abs(evidence(base.fit, better.fit) - ahead - evidence(half.fit, better.fit)) > 1.0  # two steps are not one


def test_what_predicts_surely_goes_before_what_may_predict():
    def predicts(gain: float, spread: float) -> float:
        return forward_selection.surely_predicts(Refit(None, None, 0.0, 0.0, replace(RECORD, cv_gain=gain, cv_std=spread)))

    assert predicts(44.0, 14.0) > predicts(48.0, 45.0)
    assert predicts(44.0, np.inf) == 44.0


def test_weight_that_nobody_declared_is_refitted_however_far_behind_it_looks(monkeypatch: pytest.MonkeyPatch):
    def lenient(
        data: Data, fitted: FittedModel, candidate: Candidate, made: FittedModel, record: RefitRecord, noise: Noise
    ) -> Refit:
        return acceptance_test(data, fitted, candidate, made, record, noise).saying(PASSES)

    monkeypatch.setattr(forward_selection, "acceptance_test", lenient)
    monkeypatch.setattr(forward_selection, "explains", lambda fitted: True)
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)))
    data = prepare(arm((4, 1, 1), gravity=(0, 0, 0)), [recording], [])
    hypothesis, prior = with_nuisance(data)
    base = fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["gravity", "payload"]), COUNT)
    looks = [replace(c, score=forward_selection.PREDICTED_MUCH + 1.0 if c.effect.name == "gravity" else c.score) for c in table]
    table = sorted(looks, key=lambda c: -c.score)
    winner, _, records = forward_selection.select_next(data, base, table, NOISE, lambda text: None)
    assert {r.name for r in records} == {"gravity", "payload"}
    assert winner is not None and winner.candidate.effect.name == "gravity"


@pytest.mark.parametrize("explains", [True, False])
def test_until_an_effect_explains_the_data_rivals_are_refitted_to_the_end(monkeypatch: pytest.MonkeyPatch, explains: bool):
    asked = []

    def seen(data: Data, fitted: FittedModel, candidate: Candidate, noise: Noise, *, wanted: float, **named: Any) -> FittedModel:
        asked.append((candidate.effect.name, wanted))
        return refit(data, fitted, candidate, noise)

    def lenient(*given: Any) -> Refit:
        return acceptance_test(*given).saying(PASSES)

    data, base = started()
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload", "cable_gain"]), COUNT)
    looks = [
        replace(c, score=forward_selection.PREDICTED_MUCH + 1.0 if c.effect.name == "cable_gain" else 1e3 + c.score)
        for c in table
    ]
    monkeypatch.setattr(forward_selection, "refit", seen)
    monkeypatch.setattr(forward_selection, "acceptance_test", lenient)
    monkeypatch.setattr(forward_selection, "_polish", lambda data, fitted, winner, *_: (winner.fitted, [0.0]))
    monkeypatch.setattr(forward_selection, "explains", lambda fitted: explains)
    forward_selection.select_next(data, base, sorted(looks, key=lambda c: -c.score), NOISE, lambda text: None)
    assert asked == [("payload", forward_selection.EVIDENCE)] + [("cable_gain", forward_selection.EVIDENCE)] * (not explains)


@pytest.mark.parametrize("form", [True, False])
def test_another_form_of_what_leads_is_held_against_what_that_one_promised(monkeypatch: pytest.MonkeyPatch, form: bool):
    data, base = started()
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload", "cable_gain"]), COUNT)
    payload, gain = (next(c for c in table if c.effect.name == name) for name in ("payload", "cable_gain"))
    rival = replace(payload, effect=replace(payload.effect)) if form else gain
    asked = list[str]()

    def lenient(
        data: Data, fitted: FittedModel, candidate: Candidate, made: FittedModel, record: RefitRecord, noise: Noise
    ) -> Refit:
        asked.append(candidate.effect.name)
        return replace(acceptance_test(data, fitted, candidate, made, record, noise).saying(PASSES), gain=800.0)

    monkeypatch.setattr(forward_selection, "acceptance_test", lenient)
    monkeypatch.setattr(forward_selection, "polished", lambda data, fitted, refitted, *_: refitted)
    monkeypatch.setattr(forward_selection, "explains", lambda fitted: True)
    monkeypatch.setattr(forward_selection, "surely_predicts", lambda refitted: 0.0)
    forms = [replace(payload, score=100.0), replace(rival, score=60.0)]
    forward_selection.select_next(data, base, forms, NOISE, lambda text: None)
    assert asked == ["payload", "payload"] if form else asked == ["payload"]


@pytest.mark.parametrize(
    "name, drifted, explains, expected",
    [("gravity", False, False, 0), ("gravity", True, True, 0), ("gravity", True, False, 1), ("payload", True, False, 0)],
)
def test_where_calibration_has_drifted_gravity_starts_from_what_is_declared_too(
    monkeypatch: pytest.MonkeyPatch, name: str, drifted: bool, explains: bool, expected: int
):
    data, base = started()
    candidate = screen_model(data, base.fit, NOISE, fields_of(data, base, [name]), COUNT)[0]
    tight = Prior(base.fit.prior.mean, base.fit.prior.std * (1e-3 if drifted else 1e3))
    base = replace(base, fit=replace(base.fit, prior=tight))
    starts = []

    def seen(
        data: Data, hypothesis: Hypothesis, prior: Prior, noise: Noise, coordinates: np.ndarray, **given: Any
    ) -> FittedModel:
        starts.append(coordinates)
        return fit_model(data, hypothesis, prior, noise, coordinates, **given)

    monkeypatch.setattr(refits, "fit_model", seen)
    monkeypatch.setattr(refits, "explains", lambda fitted: explains)
    refit(data, base, candidate, NOISE)
    shared = len(base.fit.coordinates)
    declared = [c for c in starts if len(c) > shared and np.array_equal(c[:shared], base.fit.prior.mean)]
    assert len(declared) == expected


def test_effects_without_near_rivals_are_not_asked_again():
    data, base = started()
    first, own = added(data, base, "gravity", 1)
    second, other = added(data, first, "cable_gain", 2)
    rival = replace(own, name="payload", verdict=PASSES, dbic=0.1 * own.evidence - 20.0)
    before = [("", base), ("gravity", first), ("cable_gain", second)]
    history, refits = swapped(data, before, [own, rival, other], NOISE, COUNT, lambda text: None)
    assert history is before and len(refits) == 3


def test_a_refit_that_could_win_goes_to_its_end(monkeypatch: pytest.MonkeyPatch):
    data, base = started()
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    whole = refit(data, base, shortlist(table, first=True)[0], NOISE)

    def cut_short(data: Data, fitted: FittedModel, candidate: Candidate, noise: Noise, **_: float) -> FittedModel:
        hypothesis, prior = forward_selection.with_term(fitted.fit, candidate.effect, candidate.seed, candidate.parameters)
        start = np.concatenate([fitted.fit.coordinates, [p.null for p in candidate.parameters]])
        return fit_model(data, hypothesis, prior, noise, start, own=own_of(fitted), max_iterations=2)

    monkeypatch.setattr(forward_selection, "refit", cut_short)
    monkeypatch.setattr(forward_selection, "_polish", lambda data, fitted, winner, *_: (winner.fitted, [0.0]))
    winner, _, records = forward_selection.select_next(data, base, table, NOISE, lambda text: None)
    assert winner is not None and winner.fitted.fit.fit.status == "converged"
    assert winner.fitted.fit.chi2 == pytest.approx(whole.fit.chi2, rel=0.02)
    assert records[0].dchi2 == pytest.approx(evidence(base.fit, winner.fitted.fit))


def test_a_refit_that_cannot_go_further_is_compared_as_it_is(monkeypatch: pytest.MonkeyPatch):
    def collapses(*_: Any, **__: Any) -> FittedModel:
        raise DataError("no equilibrium in a held-out frame")

    data, base = started()
    candidate = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)[0]
    hypothesis, prior = forward_selection.with_term(base.fit, candidate.effect, candidate.seed, candidate.parameters)
    begun = np.concatenate([base.fit.coordinates, [p.null for p in candidate.parameters]])
    made = fit_model(data, hypothesis, prior, NOISE, begun, own=own_of(base), max_iterations=1)
    cut = acceptance_test(data, base, candidate, made, RECORD, NOISE)
    assert made.fit.fit.status == "iterations"
    monkeypatch.setattr(forward_selection, "fit_model", collapses)
    assert forward_selection._to_the_end(data, base, cut, NOISE) is cut


def test_what_goes_with_an_effect_that_was_as_good_is_found_beside_it():
    data, base = started()
    wrong, _ = added(data, base, "gravity", 1)
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["cable_gain"]), COUNT)
    candidate = (shortlist(table, first=True) or table)[0]
    tie = Refit(candidate, refit(data, base, candidate, NOISE), 0.0, 0.0, RECORD)
    instead, both, tried = beside_a_tie(data, wrong, tie, None, NOISE, ["cable_gain", "payload"], COUNT, lambda text: None)
    assert both is not None and both.candidate.effect.name == "payload" and tried[-1].is_named
    assert instead.fit.hypothesis.names[-1] == "cable_gain"
    assert both.fitted.fit.hypothesis.names[-2:] == ("cable_gain", "payload")
    assert beside_a_tie(data, both.fitted, tie, None, NOISE, ["cable_gain", "payload"], COUNT, lambda text: None)[1] is None


def test_what_fields_of_the_model_before_promise_is_what_its_own_do():
    data, base = started()
    names = ["cable_gain", "payload", "gravity"]
    before = fields_of(data, base, names)
    fitted, _ = added(data, base, "cable_gain", 1)
    hints = before.beside(fitted.fit)
    assert hints is not None and {e.name for e, _, _ in hints.todo} == {"payload", "gravity"}
    tables = [screen_model(data, fitted.fit, NOISE, f, COUNT) for f in (hints, fields_of(data, fitted, names))]
    best = [{n: max(c.score for c in table if c.effect.name == n) for n in ("payload", "gravity")} for table in tables]
    assert best[1]["payload"] > 100.0
    assert all(best[0][n] == pytest.approx(best[1][n], rel=0.25) for n in best[0])
    rival, _ = added(data, base, "payload", 1)
    assert fields_of(data, fitted, names).beside(rival.fit) is None  # a gain may be missing again
    other = replace(fitted.fit, hypothesis=replace(fitted.fit.hypothesis, settled=((find_effect("hyperelastic"), {}),)))
    assert before.beside(other) is None


@pytest.mark.parametrize("promises", [True, False])
def test_fields_are_computed_anew_where_those_of_the_model_before_promise_something(
    monkeypatch: pytest.MonkeyPatch, promises: bool
):
    data, base = started()
    fitted, _ = added(data, base, "cable_gain" if promises else "payload", 1)
    hints = fields_of(data, base, ["payload", "poisson"]).beside(fitted.fit)
    asked = list[str]()
    monkeypatch.setattr(searching, "fields_of", lambda *given: asked.append("anew") or fields_of(*given))
    if not promises:
        monkeypatch.setattr(forward_selection, "PREDICTED_MUCH", 1e3)
    fields, table = searching.scored(data, fitted, hints, NOISE, ["payload", "poisson"], COUNT)
    assert asked == ["anew"] * promises and (fields is hints) != promises
    assert {c.effect.name for c in table} <= {"payload", "poisson"}


def test_fields_of_the_model_before_that_nearly_suffice_are_computed_anew(monkeypatch: pytest.MonkeyPatch):
    data, base = started()
    fitted, _ = added(data, base, "cable_gain", 1)
    hints = fields_of(data, base, ["payload"]).beside(fitted.fit)
    assert hints is not None
    best = screen_model(data, fitted.fit, NOISE, hints, COUNT)[0]
    for share, anew in ((1.5, True), (2.5, False)):
        monkeypatch.setattr(forward_selection, "PREDICTED_MUCH", share * best.gain - best.cost)
        assert not shortlist([best], first=False)
        fields, _ = searching.scored(data, fitted, hints, NOISE, ["payload"], COUNT)
        assert (fields is not hints) == anew


def test_a_richer_form_is_tried_only_where_fields_promise_something(monkeypatch: pytest.MonkeyPatch):
    data, base = started()
    fields = fields_of(data, base, ["cable_gain"])
    table = screen_model(data, base.fit, NOISE, fields, COUNT)
    forms = sorted(forward_selection._forms(table, "cable_gain"), key=lambda c: len(c.parameters))
    one, all_of_them = forms[0], forms[-1]
    made = refit(data, base, one, NOISE)
    winner = Refit(one, made, evidence(base.fit, made.fit) - one.cost, 0.0, RECORD)
    J, r = np.asarray(made.fit.fit.jacobian), made.fit.fit.residual
    problem = forward_selection.problem_of(data, made.fit, NOISE)
    predicted_sum = linear_gain(made.fit, problem, all_of_them.raw, all_of_them.placements)
    whole = np.vstack(
        [
            whiten(problem.factors[0], all_of_them.raw[0]),
            np.zeros((len(r) - all_of_them.raw[0][:, :, 0].size, len(all_of_them.parameters))),
        ]
    )
    best = np.linalg.lstsq(np.column_stack([J, whole]), -r, rcond=1e-10)[0]
    alone = np.linalg.lstsq(J, -r, rcond=1e-10)[0]
    expected = np.sum((r + J @ alone) ** 2) - np.sum((r + np.column_stack([J, whole]) @ best) ** 2)
    assert predicted_sum == pytest.approx(expected, rel=1e-3, abs=1e-6)
    tried = list[bool]()
    monkeypatch.setattr(forward_selection, "fit_model", lambda *given, **more: tried.append(True) or fit_model(*given, **more))
    for share in (0.0, 1e9):
        monkeypatch.setattr(forward_selection, "HINTED", share)
        forward_selection._richer(data, base, winner, all_of_them, NOISE)
    assert tried == [True]


def test_a_place_is_improved_before_a_refit_is_turned_down_for_what_it_predicts(monkeypatch: pytest.MonkeyPatch):
    data, base = started()
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    asked = list[str]()

    def strict(
        data: Data, fitted: FittedModel, candidate: Candidate, made: FittedModel, record: RefitRecord, noise: Noise
    ) -> Refit:
        own = acceptance_test(data, fitted, candidate, made, record, noise)
        own = own.saying(PASSES if asked else "it does not predict")
        asked.append(candidate.effect.name)
        return own

    monkeypatch.setattr(forward_selection, "acceptance_test", strict)
    monkeypatch.setattr(forward_selection, "_polish", lambda data, fitted, winner, *_: (replace(winner.fitted), [0.0]))
    winner, _, records = forward_selection.select_next(data, base, table, NOISE, lambda text: None)
    assert winner is not None and asked[:2] == ["payload", "payload"] and records[0].is_named


def test_a_place_moves_on_where_the_body_is_as_the_load_has_bent_it():
    inputs, labels = sweeps(each=1)
    hidden = {"name": "payload", "point_m": [0.066, 0.004, 0.01], "force_n": [0.0, 0.3, -0.4]}
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)), effects=[hidden])
    data = prepare(arm((4, 1, 1)), [recording], [])
    hypothesis, prior = with_nuisance(data)
    base = fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    candidate = next(
        c for c in table if len(c.parameters) == 3 and np.linalg.norm(np.subtract(c.seed["point_m"], hidden["point_m"])) > 0.012
    )
    fitted = refit(data, base, candidate, NOISE)
    alone = without_last(fitted.fit)
    back = alone.fit.residual + np.asarray(fitted.fit.fit.jacobian)[:, -3:] @ fitted.fit.coordinates[-3:]
    np.testing.assert_allclose(back, fitted.fit.fit.residual, atol=1e-9)
    moved, scatter = closer(data, fitted, NOISE)
    assert np.linalg.norm(np.subtract(moved.fit.hypothesis.terms[-1][1]["point_m"], hidden["point_m"])) < 0.004
    assert moved.fit.chi2 < 0.5 * fitted.fit.chi2 and np.all(np.array(scatter) < 0.2)
    whole = polished(data, base, Refit(candidate, fitted, 0.0, 0.0, RECORD), NOISE, lambda text: None).fitted
    found, std = whole.fit.coordinates[-6:], parameter_std(data, whole, NOISE, {})["payload"]
    assert whole.fit.hypothesis.entries(whole.fit.coordinates)[-1]["point_m"] == found[3:].tolist()
    off = np.abs(found - [*hidden["force_n"], *hidden["point_m"]])
    assert np.all(off[3:] < 0.001) and np.all(off < 4.0 * std)


def test_a_model_on_top_of_which_much_is_promised_need_not_be_fitted_to_the_end(monkeypatch: pytest.MonkeyPatch):
    data, fitted = started()
    rough = fit_model(
        data, fitted.fit.hypothesis, fitted.fit.prior, NOISE, np.zeros(len(fitted.fit.coordinates)), max_iterations=1
    )
    fields = fields_of(data, rough, ["payload", "cable_gain"])
    best = max(c.gain for c in screen_model(data, rough.fit, NOISE, fields, COUNT))
    assert searching.spared_gain(data, rough, fields, NOISE, COUNT) == 0.0  # all states are little work
    monkeypatch.setattr(searching, "spares", lambda data, robot: True)
    spare = searching.spared_gain(data, rough, fields, NOISE, COUNT)
    assert spare == pytest.approx(searching.SPARED * best)
    finer = replace(NOISE, std={"white": 1e-5})
    assert searching.spared_gain(data, rough, fields, finer, COUNT) > 50.0 * spare  # by the noise that is known now
    known = rough.fit.jets
    whole, part = (fitted_again(data, rough, NOISE, known=known, spare=s) for s in (0.0, 100.0 * spare))
    assert len(part.fit.fit.cost) < len(whole.fit.fit.cost) and part.fit.chi2 < whole.fit.chi2 + 100.0 * spare
    assert part.fit.fit.status == "converged"
