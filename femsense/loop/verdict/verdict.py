"""The conclusion: accepted effects, remaining residual, limits of the data, and the returned robot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import Trial
from femsense.loop.fit.covariance import parameter_std
from femsense.loop.fit.discretisation_error import without_mesh_error
from femsense.loop.fit.fitted_model import FittedModel, mean_square
from femsense.loop.fit.model_error import Excess, excess_of, model_error
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.repeatability import repeatability
from femsense.loop.result.loop_result import FOUND, NONE, UNEXPLAINED, LoopResult
from femsense.loop.result.records import Left, Structure
from femsense.loop.search.search_state import Search
from femsense.loop.verdict.confounding import confounded
from femsense.loop.verdict.empirical import judged_correction
from femsense.loop.verdict.report_data import gather
from femsense.loop.verdict.residual_diagnostics import describe_left, frame_errors, structure_tests
from femsense.loop.verdict.returned_model import (
    MODULUS,
    entries_of,
    is_significant,
    prediction_gap,
    promoted_nuisances,
    returned_effects,
    significant_effects,
)
from femsense.loop.verdict.sentences import by_mesh, by_noise, everywhere_in_words, evidence_for, on_linear, verdict_in_words
from femsense.loop.verdict.summary import (
    chain_of_effects,
    data_card,
    detectable,
    errors_of,
    residual_table,
    tried_effects,
    untestable,
    values_of,
)
from femsense.model.effects import Entry, apply_effects
from femsense.model.robot import Robot

SAME = 0.01, 1e-5
"""Largest difference between the predictions of the returned robot and the fitted model: this share of the held-out error, or this [m]."""


def conclude(data: Data, search: Search, rng: np.random.Generator, *, correct: bool = False) -> LoopResult:
    """Return the result of a search, with the data of the report, and with an empirical correction if `correct`."""
    before, final, noise = search.before, search.final, search.noise
    std = parameter_std(data, final, noise, _seed_std(search))
    measured = repeatability(data, final, noise)
    promoted = [n for n in promoted_nuisances(data, search) if is_significant(final, n, std[n], data.thresholds)]
    added = [n for n, _ in search.history[1:] if n in final.fit.hypothesis.names]
    significant = significant_effects(data, final, added, std)
    names, back, insignificant = returned_effects(data, search, promoted, significant, _seed_std(search))
    drifted = (
        MODULUS in promoted and MODULUS not in names
    )  # a reduction of the residual by an implausible modulus explains nothing
    promoted = [n for n in names if n in NUISANCE]
    entries = entries_of(back, names) if names else []
    effects = chain_of_effects(data, search, promoted, names, back, std)
    lacks = lacks_much(data, back, final, noise)
    shown = back if lacks else final  # the residual includes what unaccepted nuisance effects would remove
    surprise = _surprise(data, back, noise)
    plain = [without_mesh_error(t, jet.residual, noise, nor_placements=True) for t, jet in zip(data.train, shown.fit.jets)]
    tests = structure_tests(data.train, plain, rng=rng, level=data.thresholds.structure)
    excess = excess_of(data, before, final, back, noise, measured)
    found = _not_returned(search, names)
    open_to_doubt = (tests.significant or surprise) and (drifted or excess.explained < data.thresholds.explained)
    unexplained = lacks or (found and not effects) or open_to_doubt or excess.is_large
    verdict = UNEXPLAINED if unexplained else FOUND if effects else NONE
    pairs = confounded(search, names, data.thresholds)
    correction, learned = judged_correction(data, back) if correct else (None, None)
    robot = _returned_robot(data, entries)
    robot = robot if robot.correction is learned else replace(robot, correction=learned)
    robot = replace(robot, name=improved_name(robot.name)) if entries or learned is not None else robot
    only_held = bool(surprise) and not tests.significant and not lacks
    left = _left(data, back if only_held else shown, noise, tests, excess, held=only_held)
    budget = model_error(data, excess, noise, measured)
    return LoopResult(
        verdict=verdict,
        sentence=verdict_in_words(verdict, effects, found, before, back, budget, pairs)
        + by_noise(data, measured)
        + by_mesh(data, search, back)
        + on_linear(data, back, names, measured.total)
        + evidence_for(data, found, [n for n in added if n not in significant or n in insignificant])
        + surprise
        + _by_prediction(data, robot, back, noise)
        + everywhere_in_words(search.everywhere, data.thresholds),
        noise_m=measured.total,
        before=errors_of(data, before, rng),
        after=errors_of(data, back, rng),
        effects=tuple(effects),
        entries=tuple(entries),
        candidates=tuple(tried_effects(search.first, search.last, [*search.outweighed, *search.refits], names, data.thresholds)),
        confounded=tuple(pairs),
        next_experiment="",
        not_testable=tuple(untestable(search.first, names, data.thresholds)),
        detectable=detectable(search.last, {effect.name for effect in effects}),
        left=left,
        robot=robot,
        declared=data.declared,
        data=data_card(data, final, std, noise, measured.source, search.n_effective),
        model_error=budget,
        fitted_along={e["name"]: values_of(std, back, e["name"]) for e in entries if e["name"] not in names},
        correction=correction,
        everywhere=search.everywhere,
        residuals=residual_table(data, before, back),
        evidence=gather(data, search, back, shown, tests, rng),
    )


def improved_name(name: str) -> str:
    """Return the name of the returned robot, so that its runs differ from those of the declared one: finger becomes
    finger-improved, and that finger-improved-2."""
    begin, found, count = name.partition("-improved")
    if not found or not (count == "" or re.fullmatch(r"-\d+", count)):
        return f"{name}-improved"
    return f"{begin}-improved-{int(count[1:] or 1) + 1}"


def _returned_robot(data: Data, entries: Sequence[Entry]) -> Robot:
    """Return the declared robot with effects, in its document too."""
    if not entries:
        return data.declared
    robot = apply_effects(data.declared, entries)
    if data.declared.document is None:
        return robot
    written = [*data.declared.document.get("effects", []), *entries]
    return replace(robot, document={**data.declared.document, "effects": written})


def _by_prediction(data: Data, robot: Robot, back: FittedModel, noise: Noise) -> str:
    """Return a sentence on the difference between the predictions of the returned robot and of the fitted model; empty if they agree."""
    share, least = SAME
    try:
        gap = prediction_gap(data, robot, back, noise)
    except FemsenseError as error:
        return f" The returned robot cannot reproduce the predictions of the fitted model: {error}."
    if gap <= max(share * back.held_rms, least):
        return ""
    return f" The returned robot predicts markers {1e3 * gap:.2f} mm away from those of the fitted model."


def _seed_std(search: Search) -> dict[str, FloatArray]:
    return {r.name: np.array(r.seed_std) for r in search.refits if r.is_named and r.seed_std is not None}


def lacks_much(data: Data, back: FittedModel, final: FittedModel, noise: Noise) -> bool:
    """Return whether the final model, with nuisance effects that are not accepted, has less than 1/`lacks` of the mean square of the returned one."""
    train = [mean_square(data.train, [j.residual for j in s.fit.jets], noise) for s in (back, final)]
    held = [mean_square(data.held, s.held_residuals, noise) for s in (back, final)]
    return any(own > data.thresholds.lacks * max(full, 1.0) for own, full in (train, held))


def _surprise(data: Data, back: FittedModel, noise: Noise) -> str:
    """Return a sentence if the whitened mean square of held-out data exceeds that of fitted data by more than `lacks`; else empty."""
    fitted = mean_square(data.train, [j.residual for j in back.fit.jets], noise)
    held = mean_square(data.held, back.held_residuals, noise)
    if held <= data.thresholds.lacks * max(fitted, 1.0):
        return ""
    frames = frame_errors(data.held, _beyond_mesh(data.held, back.held_residuals, noise))
    worst = max(frames, key=lambda frame: frame.rms_m)
    return (
        f" Held-out data have a larger residual than fitted data, most in frame {worst.frame} ({1e3 * worst.rms_m:.2f} mm):"
        " record more sweeps like that one."
    )


def _left(data: Data, fitted: FittedModel, noise: Noise, tests: Structure, excess: Excess, *, held: bool) -> Left:
    """Return the description of the remaining residual, of the fitted data or, if only these show it, of the held-out data."""
    trials, residuals = (data.held, fitted.held_residuals) if held else (data.train, [jet.residual for jet in fitted.fit.jets])
    beyond = _beyond_mesh(trials, residuals, noise)
    return describe_left(data.robot, trials, beyond, held_out=held, structure=tests, explained_share=excess.explained)


def _beyond_mesh(trials: list[Trial], residuals: list[FloatArray], noise: Noise) -> list[FloatArray]:
    return [without_mesh_error(t, r, noise) for t, r in zip(trials, residuals)]


def _not_returned(search: Search, names: list[str]) -> list[str]:
    """Return the effects that were found but are not returned."""
    return [n for n, _ in search.history[1:] if n not in names and n in search.final.fit.hypothesis.names]
