"""The conclusion: accepted effects, remaining residual, limits of the data, and the returned robot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import Trial
from femsense.loop.fit.discretisation_error import without_mesh_error
from femsense.loop.fit.fitted_model import FittedModel, mean_square
from femsense.loop.fit.model_error import Excess, excess_of, model_error
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.repeatability import Repeatability, repeatability
from femsense.loop.result.loop_result import LoopResult, Verdict
from femsense.loop.result.records import Left, NamedEffect, Structure
from femsense.loop.search.search_state import Search
from femsense.loop.verdict.confounding import confounded
from femsense.loop.verdict.empirical import judged_correction
from femsense.loop.verdict.report_data import gather
from femsense.loop.verdict.residual_diagnostics import describe_left, frame_errors, structure_tests
from femsense.loop.verdict.returned_model import (
    Returned,
    entries_of,
    prediction_gap,
    returned_part,
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
from femsense.model.marker_correction import Correction
from femsense.model.robot import Robot

SAME = 0.01, 1e-5
"""Largest difference between the predictions of the returned robot and the fitted model: this share of the held-out error, or this [m]."""


def conclude(data: Data, search: Search, rng: np.random.Generator, *, correct: bool = False) -> LoopResult:
    """Return the result of a search, with the data of the report, and with an empirical correction if `correct`."""
    before, final, noise = search.before, search.final, search.noise
    measured = repeatability(data, final, noise)
    returned = returned_part(data, search)
    names, back, std = returned.names, returned.back, returned.std
    entries = entries_of(back, names) if names else []
    effects = chain_of_effects(data, search, [n for n in names if n in NUISANCE], names, back, std)
    remaining = _remaining(data, search, back, measured, rng)
    found = _not_returned(search, names)
    verdict = _verdict(data, returned, remaining, found, effects)
    pairs = confounded(search, names, data.thresholds)
    correction, learned = judged_correction(data, back) if correct else (None, None)
    robot = _returned_robot(data, entries, learned)
    budget = model_error(data, remaining.excess, noise, measured)
    return LoopResult(
        verdict=verdict,
        sentence=verdict_in_words(verdict, effects, found, before, back, budget, pairs)
        + by_noise(data, measured)
        + by_mesh(data, search, back)
        + on_linear(data, back, names, measured.total)
        + evidence_for(data, found, returned.insignificant)
        + remaining.surprise
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
        left=_left(data, back, remaining, noise),
        robot=robot,
        declared=data.declared,
        data=data_card(data, final, std, noise, measured.source, search.n_effective),
        model_error=budget,
        fitted_along={e["name"]: values_of(std, back, e["name"]) for e in entries if e["name"] not in names},
        correction=correction,
        everywhere=search.everywhere,
        residuals=residual_table(data, before, back),
        evidence=gather(data, search, back, remaining.shown, remaining.tests, rng),
    )


@dataclass(frozen=True, eq=False, slots=True)
class Remaining:
    """The tests of the remaining residual."""

    shown: FittedModel
    """The model whose residual is tested: the last one of the search; or, if the returned one `lacks` much, that, so that the residual includes what
    rejected nuisance effects would remove."""
    lacks: bool
    """Whether the last model of the search has a much smaller residual than the returned one."""
    surprise: str
    """A sentence if held-out data have a much larger residual than fitted data; else empty."""
    tests: Structure
    excess: Excess

    @property
    def only_held_out(self) -> bool:
        """Whether only held-out data show it."""
        return bool(self.surprise) and not self.tests.significant and not self.lacks


def _remaining(data: Data, search: Search, back: FittedModel, measured: Repeatability, rng: np.random.Generator) -> Remaining:
    noise, lacks = search.noise, lacks_much(data, back, search.final, search.noise)
    shown = back if lacks else search.final
    plain = [without_mesh_error(t, jet.residual, noise, nor_placements=True) for t, jet in zip(data.train, shown.fit.jets)]
    tests = structure_tests(data.train, plain, rng=rng, level=data.thresholds.structure)
    excess = excess_of(data, search.before, search.final, back, noise, measured)
    return Remaining(shown, lacks, _surprise(data, back, noise), tests, excess)


def _verdict(data: Data, returned: Returned, remaining: Remaining, found: Sequence[str], effects: Sequence[NamedEffect]) -> str:
    """Return the verdict: a residual is unexplained if it is large, or has structure and the returned effects explain little of it."""
    excess = remaining.excess
    explained = not returned.drifted and excess.explained >= data.thresholds.explained
    if remaining.lacks or excess.is_large or (found and not effects):
        return Verdict.UNEXPLAINED
    if (remaining.tests.significant or remaining.surprise) and not explained:
        return Verdict.UNEXPLAINED
    return Verdict.FOUND if effects else Verdict.NONE


def improved_name(name: str) -> str:
    """Return the name of the returned robot, so that its runs differ from those of the declared one: finger becomes
    finger-improved, and that finger-improved-2."""
    begin, found, count = name.partition("-improved")
    if not found or not (count == "" or re.fullmatch(r"-\d+", count)):
        return f"{name}-improved"
    return f"{begin}-improved-{int(count[1:] or 1) + 1}"


def _returned_robot(data: Data, entries: Sequence[Entry], learned: Correction | None) -> Robot:
    """Return the declared robot with effects, in its document too, and with an empirical correction."""
    robot, document = data.declared, data.declared.document
    if entries:
        robot = apply_effects(robot, entries)
    if entries and document is not None:
        robot = replace(robot, document={**document, "effects": [*document.get("effects", []), *entries]})
    if entries or learned is not None:
        robot = replace(robot, name=improved_name(robot.name))
    return robot if robot.correction is learned else replace(robot, correction=learned)


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


def _left(data: Data, back: FittedModel, remaining: Remaining, noise: Noise) -> Left:
    """Return the description of the remaining residual, of the fitted data or, if only these show it, of the held-out data."""
    held = remaining.only_held_out
    trials, residuals = data.train, [jet.residual for jet in remaining.shown.fit.jets]
    if held:
        trials, residuals = data.held, back.held_residuals
    share, beyond = remaining.excess.explained, _beyond_mesh(trials, residuals, noise)
    return describe_left(data.robot, trials, beyond, held_out=held, structure=remaining.tests, explained_share=share)


def _beyond_mesh(trials: list[Trial], residuals: list[FloatArray], noise: Noise) -> list[FloatArray]:
    return [without_mesh_error(t, r, noise) for t, r in zip(trials, residuals)]


def _not_returned(search: Search, names: list[str]) -> list[str]:
    """Return the effects that were found but are not returned."""
    return [n for n, _ in search.history[1:] if n not in names and n in search.final.fit.hypothesis.names]
