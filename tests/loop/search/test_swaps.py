"""What is named while another effect is missing may be wrong: in the whole model a rival, or the effect at another place, takes its place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.arrays import FloatArray, IntArray
from femsense.io.checkpoint import Checkpoint
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.covariance import parameter_std
from femsense.loop.fit.fitted_model import FittedModel, fit_model, problem_of, with_nuisance
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search.acceptance import acceptance_test, held_share
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.forward_selection import polished, richer_fit, select_next, shortlist
from femsense.loop.search.location_search import closer, without_term
from femsense.loop.search.refit import evidence, refit
from femsense.loop.search.screening import linear_gain, screen_model
from femsense.loop.search.search import scored, search_effects
from femsense.loop.search.search_state import Refit, SearchProgress, Setting
from femsense.loop.search.swaps import predicts_worse, swapped
from femsense.loop.thresholds import DEFAULTS, EFFORT
from femsense.model.effects import find_effect

RECORD = RefitRecord("", {})
NOISE = Noise({"white": 1e-4}, "")
COUNT = 300.0
LENIENT = replace(DEFAULTS, held_gain=-1e9, plainly_worse=np.inf)
"""Evidence alone."""
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


def set_in(data: Data) -> Setting:
    return Setting(data, NOISE, COUNT, lambda text: None)


def added(data: Data, fitted: FittedModel, name: str, step: int) -> tuple[FittedModel, RefitRecord]:
    """Return a fitted model with one more effect, rightly or not, and its record."""
    table = screen_model(data, fitted.fit, NOISE, fields_of(data, fitted, [name]), COUNT)
    record = RefitRecord(name, {}, step=step)
    candidate = max(shortlist(table, DEFAULTS, EFFORT, first=True) or table, key=lambda c: c.score)
    made = acceptance_test(data, fitted, candidate, refit(data, fitted, candidate, NOISE), record, NOISE)
    return made.fitted, made.saying(NAMED).record


def test_a_rival_that_is_right_takes_the_place_of_what_was_named_first():
    data, base = started()
    first, wrong = added(data, base, "gravity", 1)
    second, right = added(data, first, "cable_gain", 2)
    rival = replace(wrong, name="payload", verdict=PASSES)
    history, refits = swapped(set_in(data), [("", base), ("gravity", first), ("cable_gain", second)], [wrong, rival, right])
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
    history, refits = swapped(set_in(data), before, [right, rival, other])
    assert {name for name, _ in history} == {"", "payload", "cable_gain"}  # perhaps at a better place
    assert history[-1][1].fit.chi2 <= second.fit.chi2
    assert not any(r.is_named for r in refits if r.name == "gravity")


LARGE_GAIN = {"name": "cable_gain", "scale": {"up": 1.5}}
ERROR = {"name": "payload", "point_m": [0.05, 0.0, 0.01], "force_n": [0.02, 0.05, 0.04]}


def beside_an_error(*, held_out_too: bool) -> tuple[Data, FittedModel]:
    """Return data with a gain, and an error of the model that a payload makes up for: where they are fitted, or held out too."""
    robot, (inputs, labels) = arm((4, 1, 1)), sweeps(each=1)
    fitted, plain = (
        record(inputs, labels=labels, truth=robot, effects=effects)[0] for effects in ([ERROR, LARGE_GAIN], [LARGE_GAIN])
    )
    data = replace(prepare(robot, [fitted], [fitted if held_out_too else plain]), thresholds=LENIENT)
    hypothesis, prior = with_nuisance(data)
    return data, fit_model(data, hypothesis, prior, NOISE, np.zeros(len(prior.mean)))


@pytest.mark.parametrize("held_out_too", [False, True])
def test_beside_an_error_of_the_model_a_simpler_effect_takes_the_place_of_what_explains_more_unless_it_predicts_worse(
    held_out_too: bool,
):
    data, base = beside_an_error(held_out_too=held_out_too)
    named, own = added(data, base, "payload", 1)
    _, other = added(data, base, "cable_gain", 1)
    other = replace(other, verdict=PASSES)
    assert own.evidence > other.evidence + 10.0
    history = [("", base), ("payload", named)]
    course = SearchProgress(
        data,
        data,
        base,
        history,
        1,
        named,
        base,
        ["payload", "cable_gain"],
        False,
        [own, other],
        noise=NOISE,
        n_effective=COUNT,
        over=True,
        holds_error=True,
    )
    _, search = search_effects(course, Checkpoint(None), lambda text: None)
    assert [name for name, _ in search.history][:2] == ["", "payload" if held_out_too else "cable_gain"]
    assert search.final.held_rms <= named.held_rms and search.final.fit is search.history[-1][1].fit
    said = {(r.name, r.in_place_of): r.verdict for r in search.refits}
    if not held_out_too:
        assert said["cable_gain", "payload"] == NAMED and said["payload", None] == said["payload", "payload"] == PASSES


def test_a_polished_refit_is_weighed_against_the_model_without_it_as_its_rivals_are():
    data, base = started()
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    far = max(table[:6], key=lambda c: np.linalg.norm(np.subtract(c.seed["point_m"], HIDDEN[0]["point_m"])))
    made = refit(data, base, far, NOISE)
    rough = acceptance_test(data, base, far, made, RECORD, NOISE)
    better = polished(set_in(data), base, rough)
    gained = evidence(base.fit, better.fitted.fit) - evidence(base.fit, made.fit)
    assert better.score == pytest.approx(evidence(base.fit, better.fitted.fit) - far.cost) and gained > 10.0
    assert abs(gained - (made.fit.chi2 - better.fitted.fit.chi2)) > 1.0  # noise is larger than thought


def test_effects_without_near_rivals_are_not_asked_again():
    data, base = started()
    first, own = added(data, base, "gravity", 1)
    second, other = added(data, first, "cable_gain", 2)
    rival = replace(own, name="payload", verdict=PASSES, dbic=0.1 * own.evidence - 20.0)
    before = [("", base), ("gravity", first), ("cable_gain", second)]
    history, refits = swapped(set_in(data), before, [own, rival, other])
    assert history is before and len(refits) == 3


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
def test_fields_are_computed_anew_where_those_of_the_model_before_promise_something(promises: bool):
    data, base = started()
    fitted, _ = added(data, base, "cable_gain" if promises else "payload", 1)
    hints = fields_of(data, base, ["payload", "poisson"]).beside(fitted.fit)
    assert hints is not None
    own = data if promises else replace(data, thresholds=replace(DEFAULTS, evidence=1e3))
    fields, table = scored(own, fitted, hints, NOISE, ["payload", "poisson"], COUNT)
    assert (fields is hints) != promises
    assert {c.effect.name for c in table} <= {"payload", "poisson"}


def test_fields_of_the_model_before_that_nearly_suffice_are_computed_anew():
    data, base = started()
    fitted, _ = added(data, base, "cable_gain", 1)
    hints = fields_of(data, base, ["payload"]).beside(fitted.fit)
    assert hints is not None
    best = screen_model(data, fitted.fit, NOISE, hints, COUNT)[0]
    for share, anew in ((1.5, True), (2.5, False)):
        own = replace(data, thresholds=replace(DEFAULTS, evidence=share * best.gain - best.cost))
        assert not shortlist([best], own.thresholds, EFFORT, first=False)
        fields, _ = scored(own, fitted, hints, NOISE, ["payload"], COUNT)
        assert (fields is not hints) == anew


def test_a_richer_form_is_tried_only_where_fields_promise_something():
    data, base = started()
    fields = fields_of(data, base, ["cable_gain"])
    table = screen_model(data, base.fit, NOISE, fields, COUNT)
    one, all_of_them = (of(table, key=lambda c: len(c.parameters)) for of in (min, max))
    made = refit(data, base, one, NOISE)
    winner = Refit(one, made, evidence(base.fit, made.fit) - one.cost, RECORD)
    J, r = np.asarray(made.fit.fit.jacobian), made.fit.fit.residual
    problem = problem_of(data, made.fit, NOISE)
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
    for share, tried in ((0.0, True), (1e9, False)):
        own = replace(data, thresholds=replace(DEFAULTS, hinted=share))
        assert (richer_fit(own, base, winner, all_of_them, NOISE) is not None) == tried


def test_a_place_is_improved_before_a_refit_is_turned_down_for_what_it_predicts():
    data, base = started()
    table = screen_model(data, base.fit, NOISE, fields_of(data, base, ["payload"]), COUNT)
    far = max(table[:6], key=lambda c: np.linalg.norm(np.subtract(c.seed["point_m"], HIDDEN[0]["point_m"])))
    rough = acceptance_test(data, base, far, refit(data, base, far, NOISE), RECORD, NOISE)
    end = polished(set_in(data), base, rough)
    there = acceptance_test(data, base, far, end.fitted, RECORD, NOISE)
    held = [r.record.held_dchi2 / r.record.dchi2 / held_share(data) for r in (rough, there)]
    for wanted, found in ((0.5 * (held[0] + held[1]), True), (2.0 * max(held), False)):
        own = replace(data, thresholds=replace(DEFAULTS, held_gain=wanted, significant=0.0))
        winner, records = select_next(set_in(own), base, [far])
        assert (winner is not None) == found and records[0].is_named == found


def leaving(fitted: FittedModel, frame_mm: Callable[[IntArray], FloatArray]) -> FittedModel:
    """Return a fitted model that leaves so much of each held-out frame along each axis [mm]."""
    held = []
    for h, trial in zip(fitted.held, beside_an_error(held_out_too=False)[0].held):
        left = np.repeat(1e-3 * frame_mm(trial.scene.frame)[:, None], 3, axis=1)
        held.append(replace(h, jet=replace(h.jet, residual=left)))
    return replace(fitted, held=held)


def test_what_is_closer_in_one_state_alone_is_not_surely_closer():
    data, base = beside_an_error(held_out_too=False)
    first = int(data.held[0].scene.frames[0])
    own, everywhere = leaving(base, lambda k: np.full(len(k), 1.0)), leaving(base, lambda k: 0.9 + 0.001 * k)
    by_one = leaving(base, lambda k: np.where(k == first, 0.0, 1.01))
    assert rms_of(by_one.held_residuals) < rms_of(own.held_residuals)
    assert predicts_worse(data, everywhere, own) and not predicts_worse(data, own, everywhere)
    assert not predicts_worse(data, by_one, own)
    two = replace(data, held=[t.part(t.scene.frames[:2]) for t in data.held])
    assert predicts_worse(two, own, everywhere)  # too few states to show that the simpler model suffices


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
    alone = without_term(fitted.fit, -1)
    back = alone.fit.residual + np.asarray(fitted.fit.fit.jacobian)[:, -3:] @ fitted.fit.coordinates[-3:]
    np.testing.assert_allclose(back, fitted.fit.fit.residual, atol=1e-9)
    moved, scatter = closer(data, fitted, NOISE)
    assert np.linalg.norm(np.subtract(moved.fit.hypothesis.terms[-1][1]["point_m"], hidden["point_m"])) < 0.004
    assert moved.fit.chi2 < 0.5 * fitted.fit.chi2 and np.all(np.array(scatter) < 0.2)
    whole = polished(set_in(data), base, Refit(candidate, fitted, 0.0, RECORD)).fitted
    found, std = whole.fit.coordinates[-6:], parameter_std(data, whole, NOISE, {})["payload"]
    assert whole.fit.hypothesis.entries(whole.fit.coordinates)[-1]["point_m"] == found[3:].tolist()
    off = np.abs(found - [*hidden["force_n"], *hidden["point_m"]])
    assert np.all(off[3:] < 0.001) and np.all(off < 4.0 * std)
