"""Which effects are handed back, and with which sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record, sweeps
from fitted_arm import NOISE, fitted_arm

from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit.fitted_model import fit_model, with_nuisance, with_term
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.search_state import Search
from femsense.loop.thresholds import DEFAULTS
from femsense.loop.verdict import returned_model, summary
from femsense.loop.verdict.returned_model import HeldOutComparison
from femsense.model.effects import apply_effects, find_effect
from femsense.model.observation import Hypothesis


def test_a_model_without_equilibrium_is_not_handed_back() -> None:
    data, search = with_gain(300e3)
    fit = search.final.fit
    theta = np.array(fit.fit.theta)
    theta[fit.own] = np.log(1e-3)  # a modulus with which nothing stands
    fallen = replace(search.final, fit=replace(fit, fit=replace(fit.fit, theta=theta)))
    search = replace(search, final=fallen)
    assert returned_model.returnable_effects(data, search, ["stiffness"], ["stiffness"]) == ([], search.before)
    chain = summary.chain_of_effects(data, search, ["stiffness"], ["stiffness"], fallen, {})
    assert [c.validation_rms_after_m for c in chain] == [fallen.held_rms]


def test_a_model_may_have_a_larger_error_on_held_out_data_where_that_is_the_mesh_s_own() -> None:
    def holds(error: float, *, gain: float = 50.0, beyond: float = 0.6, calibrated: bool = False) -> bool:
        return HeldOutComparison(error, gain, beyond, calibrated).holds(DEFAULTS)

    assert holds(1.4) and holds(1.0, gain=-100.0)
    assert not holds(1.4, gain=-5.0) and holds(1.4, gain=5.0)
    assert not holds(1.4, beyond=1.1)
    assert holds(1.4, calibrated=True) and not holds(1.4, calibrated=True, gain=9.0)


def test_a_model_is_compared_with_the_declared_one_on_held_out_data() -> None:
    data, fitted = fitted_arm(arm((4, 2, 2)), 1.0)
    search = Search(
        replace(fitted, held_rms=fitted.held_rms / 1.4), [("", fitted)], fitted, fitted, NOISE, 10.0, [], [], [], None
    )
    assert not returned_model.holds_out(data, search, fitted)  # larger by 1.4, and χ² is the same
    wide = replace(data, thresholds=replace(DEFAULTS, not_worse=1.5))
    assert returned_model.holds_out(wide, search, fitted)


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
    names, back = returned_model.returnable_effects(data, search, [], ["cable_gain"])
    (entry,) = [e for e in back.fit.hypothesis.entries(back.fit.coordinates) if e["name"] == "cable_gain"]
    return names, entry["scale"]["left"]


def twice_as_far_off(search: Search) -> Search:
    """Return a search whose final model has twice the held-out residuals of the declared one."""
    held = [replace(h, jet=replace(h.jet, residual=2.0 * b.jet.residual)) for h, b in zip(search.final.held, search.before.held)]
    return replace(search, final=replace(search.final, held=held, held_rms=2.0 * search.before.held_rms))


def test_what_was_fitted_along_is_handed_back_with_what_is_named() -> None:
    data, search = with_gain(300e3 * 0.982)
    assert not returned_model.promoted_nuisances(data, search)
    names, gain = handed_back(data, search)
    assert names == ["cable_gain"]
    alone = returned_model.keeping(data, search.final, ["cable_gain"], search.noise)
    by_itself = float(np.exp(alone.fit.coordinates[0]))
    assert abs(gain - 0.92) < 0.4 * abs(by_itself - 0.92)


def test_a_nuisance_that_held_out_data_speak_against_stays_as_declared() -> None:
    data, search = with_gain(300e3)
    alone = returned_model.keeping(data, search.final, ["cable_gain"], search.noise)
    names, back = returned_model.returnable_effects(data, twice_as_far_off(search), [], ["cable_gain"])
    assert names == ["cable_gain"] and back.fit.hypothesis.names == ("cable_gain",)
    assert back.fit.coordinates == pytest.approx(alone.fit.coordinates, abs=1e-6)


def test_a_nuisance_that_is_as_declared_without_what_is_not_named_is_not_named() -> None:
    """An effect that is not sure is taken out, and the modulus that had moved for its sake goes back."""
    data, search = with_gain(300e3)
    fit = search.final.fit
    theta = np.array(fit.fit.theta)
    theta[fit.own] = np.log(1.2)
    moved = replace(search.final, fit=replace(fit, fit=replace(fit.fit, theta=theta)))
    assert returned_model.moved_nuisance(data, moved, "stiffness")
    names, _ = returned_model.returnable_effects(data, replace(search, final=moved), ["stiffness"], ["stiffness"])
    assert names == []


@pytest.mark.parametrize("std, sure", [(0.025, True), (0.031, False)])
def test_an_effect_is_named_only_where_its_own_value_is_away_from_none_by_three_deviations(std: float, sure: bool) -> None:
    data, search = with_gain(300e3)
    assert search.final.fit.coordinates[-1] == pytest.approx(np.log(0.92), abs=0.004)
    names = returned_model.significant_effects(data, search.final, ["cable_gain"], {"cable_gain": np.array([std])})
    assert names == (["cable_gain"] if sure else [])


@pytest.mark.parametrize("scatter, sure", [(0.0, True), (0.05, False)])
def test_what_is_named_is_sure_without_what_is_not_handed_back_too(scatter: float, sure: bool) -> None:
    data, search = with_gain(300e3)
    worse = twice_as_far_off(search)  # so that the gain is fitted alone
    seed_std = {"cable_gain": np.array([scatter])}
    names, back, unsure = returned_model.returned_effects(data, worse, [], ["cable_gain"], seed_std)
    assert (names, unsure) == ((["cable_gain"], []) if sure else ([], ["cable_gain"]))
    assert back.fit.hypothesis.names == (("cable_gain",) if sure else search.before.fit.hypothesis.names)


def test_where_a_load_hangs_is_not_what_makes_it_sure() -> None:
    data, fitted = fitted_arm(arm((4, 2, 2)), 1.0)
    payload = find_effect("payload")
    seed = {"point_m": [0.095, 0.0, 0.01]}
    place = tuple(replace(p, null=0.0) for p in payload.polish(data.robot, "tension", seed))
    parameters = (*payload.parameters(data.robot, "tension"), *place)
    hypothesis = replace(fitted.fit.hypothesis, terms=(*fitted.fit.hypothesis.terms, (payload, seed, parameters)))
    theta = np.concatenate([fitted.fit.fit.theta, [0.0, 0.0, 0.02], [0.09, 0.0, 0.01]])
    loaded = replace(fitted, fit=replace(fitted.fit, hypothesis=hypothesis, fit=replace(fitted.fit.fit, theta=theta)))

    def sure(force_std: float) -> bool:
        std = {"payload": np.array([force_std] * 3 + [1e-4] * 3)}
        return bool(returned_model.significant_effects(data, loaded, ["payload"], std))

    assert sure(0.005) and not sure(0.01)


def test_the_robot_that_is_handed_back_predicts_what_the_fitted_model_does() -> None:
    data, search = with_gain(300e3 * 0.9)
    names, back = returned_model.returnable_effects(data, search, [], ["cable_gain"])
    entries = returned_model.entries_of(back, names)
    assert [e["name"] for e in entries] == [*names, *(n for n in ("stiffness", "cable_offset") if n not in names)]
    whole = apply_effects(data.declared, entries)
    assert returned_model.prediction_gap(data, whole, back, search.noise) < 1e-6
    named = apply_effects(data.declared, [e for e in entries if e["name"] == "cable_gain"])
    assert returned_model.prediction_gap(data, named, back, search.noise) > 5e-4


def test_what_a_fit_moved_by_next_to_nothing_is_said_as_none() -> None:
    _, search = with_gain(300e3)
    fit = search.final.fit
    theta = np.array(fit.fit.theta)
    theta[fit.own :] = -4e-20
    moved = replace(search.final, fit=replace(fit, fit=replace(fit.fit, theta=theta)))
    offsets = summary.values_of({}, moved, "cable_offset")["tension_n"].value
    assert set(offsets.values()) == {0.0} and summary.values_of({}, moved, "stiffness")["scale"].value == 1.0
    assert 0.0 not in summary.values_of({}, search.final, "cable_offset")["tension_n"].value.values()
