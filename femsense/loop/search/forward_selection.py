"""Forward selection: refit the best candidates with the full nonlinear equilibrium, accept one, and improve its seed and its form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import (
    FittedModel,
    fit_model,
    found_in,
    own_of,
    problem_of,
    span_at,
    with_term,
    with_values,
)
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search.acceptance import acceptance_test, eligible
from femsense.loop.search.location_search import climbed, lies_on_body, located
from femsense.loop.search.refit import evidence, refit, tried, within
from femsense.loop.search.screening import Candidate, joined, linear_gain
from femsense.loop.search.search_state import Refit, Setting, no_equilibrium
from femsense.loop.thresholds import Effort, Thresholds


def select_next(setting: Setting, fitted: FittedModel, table: list[Candidate]) -> tuple[Refit | None, list[RefitRecord]]:
    """Return the effect to add, or None if none passes; and the record of each refitted candidate."""
    data = setting.data
    listed = shortlist(table, data.thresholds, data.effort, first=not found_in(fitted))
    if not listed:
        return None, []
    refits, records = _refitted(setting, fitted, listed)
    if not any(r.record.passes for r in refits.values()):  # a seed may be the cause
        evident = data.thresholds.evidence
        refits = {i: polished(setting, fitted, r) if r.score > evident else r for i, r in refits.items()}
    leading = leaders(setting, fitted, refits)
    if not leading:
        return None, _updated(records, refits)
    first = max(leading, key=lambda i: leading[i].on_all_data)
    winner = _enriched(setting, fitted, leading[first], table).saying(NAMED)
    return winner, _updated(records, refits | leading | {first: winner})


def leaders(setting: Setting, fitted: FittedModel, refits: Mapping[int, Refit]) -> dict[int, Refit]:
    """Return the eligible refits whose score on all data is within the threshold `evidence` of the best score, each with its seed improved.

    "All data" are the fitted and the held-out frames together.
    """
    able = eligible(setting.data, refits.values(), setting.noise)
    best = max((r.on_all_data for r in able), default=np.inf)
    near = {i: r for i, r in refits.items() if r in able and r.on_all_data > best - setting.data.thresholds.evidence}
    return {i: r if r.record.seed_std is not None else polished(setting, fitted, r) for i, r in near.items()}


def _refitted(setting: Setting, fitted: FittedModel, listed: Sequence[Candidate]) -> tuple[dict[int, Refit], list[RefitRecord]]:
    """Return the refits of a shortlist by the number of their record, and the record of each refitted candidate."""
    refits: dict[int, Refit] = {}
    records: list[RefitRecord] = []
    evident = setting.data.thresholds.evidence
    for candidate in listed:
        name = candidate.effect.name
        setting.progress(f"refitting with {name}")
        record = RefitRecord(name, candidate.seed)
        others = [
            r.score for r in refits.values() if r.record.passes and r.candidate.effect.name != name
        ]  # forms of the same effect share their errors, so that a form must not stop another form early
        wanted = max([evident, *(score - 2.0 * evident for score in others)])
        try:
            made = refit(setting.data, fitted, candidate, setting.noise, wanted=wanted)
        except FemsenseError as error:
            records.append(replace(record, verdict=no_equilibrium(error)))
            continue
        refits[len(records)] = acceptance_test(setting.data, fitted, candidate, made, record, setting.noise)
        records.append(record)
    return refits, records


def _updated(records: Sequence[RefitRecord], refits: Mapping[int, Refit]) -> list[RefitRecord]:
    """Return the records, replaced by the record of the refit where there is one."""
    return [refits[i].record if i in refits else record for i, record in enumerate(records)]


def polished(setting: Setting, fitted: FittedModel, refitted: Refit) -> Refit:
    """Improve the place or time of a candidate effect after its fit, and repeat the acceptance test.

    A *refit* is the nonlinear fit of the model with one candidate effect added. The *seed* of a candidate is a start value that this fit cannot change,
    such as the place of a payload or a time; neighbouring values are tried here, and the best is kept. If the refit passes the acceptance test with its
    present seed and fails it with the improved one, the present seed is kept.

    Arguments:
        setting: data, noise and penalties of this step of the search.
        fitted: the model without the candidate.
        refitted: the refit of the candidate.

    Returns:
        the refit with its best seed and the result of its test. `record.seed_std` is the standard deviation of each coordinate of the seed [m or s] over
        the seeds that fit equally well.
    """
    made, scatter = _polish(setting, fitted, refitted)
    record = replace(refitted.record, seed_std=tuple(scatter))
    if made is refitted.fitted:
        return replace(refitted, record=record)
    better = acceptance_test(setting.data, fitted, refitted.candidate, made, record, setting.noise)
    return better if better.record.passes or not refitted.record.passes else replace(refitted, record=record)


def _enriched(setting: Setting, fitted: FittedModel, winner: Refit, table: list[Candidate]) -> Refit:
    """Return the best refit in a form with more parameters, if the evidence for that form exceeds the threshold `evidence`."""
    data, noise = setting.data, setting.noise
    winner = _with_more_markers(setting, fitted, winner, table)
    for form in _forms(table, winner.candidate.effect.name):
        if len(form.parameters) <= len(winner.candidate.parameters):
            continue
        setting.progress(_trying(form))
        made = richer_fit(data, fitted, winner, form, noise)
        if made is None:
            continue
        rich = acceptance_test(data, fitted, form, made, winner.record, noise)
        if rich.record.passes:
            rich = polished(setting, fitted, rich)
        more = evidence(winner.fitted.fit, rich.fitted.fit) - (rich.candidate.cost - winner.candidate.cost)
        if rich.record.passes and more > data.thresholds.evidence:
            winner = replace(rich, record=replace(rich.record, seed=form.seed))
    return winner


def _with_more_markers(setting: Setting, fitted: FittedModel, winner: Refit, table: list[Candidate]) -> Refit:
    """Return marker offsets extended by the offsets of further markers; other effects are returned unchanged.

    Markers are added one at a time, while the evidence for each exceeds the threshold `evidence`. One test of all markers together would
    reject a few real offsets, because its penalty counts the parameters of all markers.
    """
    data, noise = setting.data, setting.noise
    alone = [c for c in table if c.effect is winner.candidate.effect] if winner.candidate.effect.places_markers else []
    while others := [c for c in alone if not set(c.parameters) & set(winner.candidate.parameters)]:
        problem = problem_of(data, winner.fitted.fit, noise)
        gains = [linear_gain(winner.fitted.fit, problem, c.raw, c.placements) - c.cost for c in others]
        if max(gains) <= data.thresholds.evidence:
            break
        form = joined(winner.candidate, others[int(np.argmax(gains))])
        setting.progress(_trying(form))
        made = richer_fit(data, fitted, winner, form, noise)
        if made is None:
            break
        more = acceptance_test(data, fitted, form, made, winner.record, noise)
        gain = evidence(winner.fitted.fit, made.fit)
        if not more.record.passes or gain <= form.cost - winner.candidate.cost + data.thresholds.evidence:
            break
        winner = more
    return winner


def _trying(form: Candidate) -> str:
    count = len(form.parameters)
    return f"trying {form.effect.name} with {count} {'parameter' if count == 1 else 'parameters'}"


def richer_fit(data: Data, fitted: FittedModel, winner: Refit, form: Candidate, noise: Noise) -> FittedModel | None:
    """Return the fit of a richer form of an effect, started from the simpler one if the form contains its parameters."""
    settled, terms = winner.fitted.fit.hypothesis.settled, winner.fitted.fit.hypothesis.terms
    keys = {p.key for p in form.parameters}
    if settled != fitted.fit.hypothesis.settled or not {p.key for p in terms[-1][2]} <= keys:
        return tried(data, fitted, form, noise, winner.score + data.thresholds.evidence)
    found = {
        (p.key, p.part): float(v) for p, v in zip(terms[-1][2], winner.fitted.fit.coordinates[span_at(winner.fitted.fit, -1)])
    }
    own = [found.get((p.key, p.part), found.get((p.key, None), p.null)) for p in form.parameters]
    hypothesis, prior = with_term(fitted.fit, form.effect, form.seed, form.parameters)
    try:
        coordinates = with_values(winner.fitted.fit, own, at=-1)
        price = form.cost - winner.candidate.cost + data.thresholds.evidence
        predicted = linear_gain(winner.fitted.fit, problem_of(data, winner.fitted.fit, noise), form.raw, form.placements)
        if predicted < data.thresholds.hinted * price:
            return None
        worth = within(winner.fitted.fit, price)
        return fit_model(data, hypothesis, prior, noise, coordinates, own=own_of(winner.fitted), max_iterations=10, worth=worth)
    except FemsenseError:
        return None


def shortlist(table: list[Candidate], thresholds: Thresholds, effort: Effort, *, first: bool) -> list[Candidate]:
    """Return the best candidate of each effect, in its simplest form (or forms, if several are equally simple), the best first."""
    names = list(dict.fromkeys(c.effect.name for c in table if c.score > thresholds.evidence))
    chosen: list[Candidate] = []
    for name in names[: effort.refits if first else (effort.refits + 1) // 2]:
        forms = _forms(table, name)
        simple = min(len(c.parameters) for c in forms)
        chosen += [c for c in forms if len(c.parameters) == simple]
    return sorted(chosen, key=lambda c: -c.score)


def hinted(table: list[Candidate], thresholds: Thresholds, effort: Effort) -> bool:
    """Return whether a candidate could be on the shortlist of the present model, judged by the fields of the previous model.

    With the fields of the present model, a candidate may gain up to 1 / `thresholds.hinted` times as much.
    """
    wished = [replace(c, score=c.gain / thresholds.hinted - c.cost) for c in table]
    return bool(shortlist(wished, thresholds, effort, first=False))


def _forms(table: list[Candidate], name: str) -> list[Candidate]:
    """Return the best candidate of each form of an effect; one cable or marker alone is a form of its own."""
    best: dict[tuple[int, int], Candidate] = {}
    for candidate in table:
        if candidate.effect.name == name:
            best.setdefault((id(candidate.effect), len(candidate.parameters)), candidate)
    return list(best.values())


# --- improvement of seeds --------------------------------------------------------------------------------------------------


def _polish(setting: Setting, fitted: FittedModel, winner: Refit) -> tuple[FittedModel, Sequence[float]]:
    """Return the model with its seed (place, radius, time) improved, first among neighbouring seeds, then as fitted parameters; and the scatter over seeds."""
    data, noise = setting.data, setting.noise
    best, scatter, effect = winner.fitted, [0.0] * len(winner.candidate.parameters), winner.candidate.effect
    if effect.nearby(data.robot, winner.candidate.seed):
        setting.progress(f"trying neighbouring seeds of {effect.name}")
        ends = climbed(data, fitted, winner.candidate, noise)
        best, scatter = located(data, fitted, winner.candidate, winner.fitted, ends, noise)
    return (_with_seed_fitted(setting, best) if winner.candidate.parameters else best), scatter


def _with_seed_fitted(setting: Setting, best: FittedModel) -> FittedModel:
    """Return a model with the seed of its last effect fitted too, if that reduces χ² and stays inside the bounds."""
    data, noise = setting.data, setting.noise
    *_, (effect, seed, parameters) = best.fit.hypothesis.terms
    more = effect.polish(data.robot, data.control, seed)
    if not more:
        return best
    setting.progress(f"fitting the seed of {effect.name}")
    hypothesis, prior = with_term(best.fit, effect, seed, (*parameters, *more), at=-1)
    try:
        made = fit_model(data, hypothesis, prior, noise, with_values(best.fit, [p.null for p in more]), own=own_of(best))
    except FemsenseError:
        return best
    values = made.fit.coordinates[-len(more) :]
    inside = all(p.low + 1e-9 < v < p.high - 1e-9 for p, v in zip(more, values)) and lies_on_body(
        data.robot, more, values, data.thresholds
    )
    return made if made.fit.chi2 < best.fit.chi2 - data.thresholds.swap * len(more) and inside else best
