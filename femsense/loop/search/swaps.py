"""Re-tests of accepted effects, because an effect that is accepted early can absorb part of one that is still missing.

After each further effect: is an earlier one still needed, and does an alternative, or the same effect elsewhere, fit better in its place? At the end: does
an effect fit better than the input offsets; and, with weights that include the model error, does a simpler and more plausible effect suffice?
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.fit.cross_validation import LEAST_SWEEPS, sweeps_predicted
from femsense.loop.fit.fitted_model import FittedModel, held_chi2, keeping, without_effect
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search.acceptance import acceptance_test, eligible, prior_cost
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.forward_selection import leaders, shortlist
from femsense.loop.search.input_offset import OFFSETS, evidence_for_offsets, offsets_are_evident
from femsense.loop.search.location_search import closer, may_lie_elsewhere
from femsense.loop.search.refit import beyond, evidence, refit
from femsense.loop.search.screening import Candidate, screen_model
from femsense.loop.search.search_state import OffsetAlternative, Refit, Setting, at_step
from femsense.model.recording import state_key

History = list[tuple[str, FittedModel]]


def swapped(setting: Setting, history: History, refits: list[RefitRecord]) -> tuple[History, list[RefitRecord]]:
    """Return the history without earlier effects that the whole model no longer needs, and with alternatives that beat the others; and the refits,
    including those of the alternatives."""
    for name in [name for name, _ in history[1:-1]]:
        fitted = history[-1][1]
        less = _if_needless(setting, fitted, name)
        if less is not None:
            history = [*history[:-1], (history[-1][0], less)]
            continue
        alternatives = _alternatives(setting.data, fitted, refits, name)
        if not alternatives or (alternatives == [name] and not may_lie_elsewhere(setting.data, fitted, name, setting.noise)):
            continue
        history, refits = _exchanged(setting, history, refits, name, alternatives)
    return history, refits


def alternatives_to(own: RefitRecord, refits: Sequence[RefitRecord], table: Sequence[Candidate]) -> list[RefitRecord]:
    """Return the refits that pass on top of the same model as an accepted one and that the last screening leaves without a gain."""
    left = {c.effect.name for c in table if c.score > 0.0}
    return [r for r in refits if r.passes and r.answers_as(own) and r.name not in left]


def simplest(
    setting: Setting, history: History, refits: list[RefitRecord], names: Sequence[str]
) -> tuple[History, list[RefitRecord]]:
    """Return a history and its refits in which a simpler and more plausible effect replaces each one that it may stand for.

    For weights that include the model error: the evidence of an effect then also measures how well it compensates for that error in the fitted data, and
    held-out data decide whether a simpler one suffices (`predicts_worse`). The penalty of an effect is that of its parameters and of implausible values.
    """
    for name in [name for name, _ in history[1:]]:
        others = [n for n in names if n not in history[-1][1].fit.hypothesis.names]
        history, refits = _exchanged(setting, history, refits, name, others, by_held_out=True)
    return history, refits


def predicts_worse(data: Data, fitted: FittedModel, other: FittedModel) -> bool:
    """Return whether the squared error of another model in held-out states, paired by state, is larger by more than one standard error; also if there are
    too few states to tell."""
    rises = dict[tuple[int, bytes], list[float]]()
    for i, (trial, own, new) in enumerate(zip(data.held, fitted.held_residuals, other.held_residuals)):
        for k, rise in zip(trial.scene.frame, (new**2 - own**2).sum(axis=1)):
            rises.setdefault((i, state_key(trial.scene.recording, int(k))), []).append(float(rise))
    means = np.array([np.mean(own) for own in rises.values()])
    return len(means) < LEAST_SWEEPS or bool(means.mean() > means.std(ddof=1) / np.sqrt(len(means)))


def _exchanged(
    setting: Setting,
    history: History,
    refits: list[RefitRecord],
    name: str,
    alternatives: list[str],
    *,
    by_held_out: bool = False,
) -> tuple[History, list[RefitRecord]]:
    """Return a history in which the best alternative replaces an effect if it is better, by evidence or on held-out data; and the refits."""
    fitted = history[-1][1]
    setting.progress(f"refitting {' or '.join(alternatives)} instead of {name}")
    try:
        without = without_effect(setting.data, fitted, name, setting.noise)
        best, records = _better(setting, fitted, without, name, alternatives, by_held_out)
        if best is not None:
            history = [*_without(setting, history, without, name), (best.candidate.effect.name, best.fitted)]
    except FemsenseError:
        return history, refits
    if best is not None:
        refits = [replace(r, verdict=PASSES) if r.name == name and r.is_named else r for r in refits]
        records = [replace(r, verdict=NAMED) if r is best.record else r for r in records]
    return history, [*refits, *at_step(records, len(history) - 1)]


def _if_needless(setting: Setting, fitted: FittedModel, name: str) -> FittedModel | None:
    """Return a model without an effect that later ones have made unnecessary (evidence for keeping it ≤ q log n), with the place of the last effect
    improved; else None."""
    data, noise, terms = setting.data, setting.noise, fitted.fit.hypothesis.terms
    count = sum(len(p) for effect, _, p in terms if effect.name == name)
    if not count:
        return None
    setting.progress(f"testing whether {name} is still needed")
    price = count * float(np.log(setting.n_effective))
    try:
        without = without_effect(data, fitted, name, noise, worth=beyond(fitted.fit, price))
    except FemsenseError:
        return None
    if evidence(without.fit, fitted.fit) > price:
        return None
    *_, (effect, seed, parameters) = without.fit.hypothesis.terms
    places = effect.nearby(data.robot, seed) and len(parameters) == len(effect.parameters(data.robot, data.control))
    return closer(data, without, noise)[0] if places else without


def _alternatives(data: Data, fitted: FittedModel, refits: Sequence[RefitRecord], name: str) -> list[str]:
    """Return the effects whose evidence was within `evidence` of an accepted one's, the best first; and the effect itself if its seed was selected."""
    seeds = {effect.name: seed for effect, seed, parameters in fitted.fit.hypothesis.terms if parameters}
    named = [r for r in refits if r.name == name and r.is_named]
    if name not in seeds or not named or np.isinf(data.thresholds.swap):
        return []
    own = named[-1]
    near = [
        r
        for r in refits
        if r.answers_as(own)
        and r.passes
        and r.evidence > own.evidence - data.thresholds.evidence
        and r.name not in fitted.fit.hypothesis.names
    ]
    others = list(dict.fromkeys(r.name for r in sorted(near, key=lambda r: -r.evidence)))
    return [name] * bool(seeds[name]) + others


def _better(
    setting: Setting, fitted: FittedModel, without: FittedModel, name: str, alternatives: list[str], by_held_out: bool
) -> tuple[Refit | None, list[RefitRecord]]:
    """Return the best alternative if it is better than the accepted effect, and the records of all."""
    data, noise = setting.data, setting.noise
    table = screen_model(data, without.fit, noise, fields_of(data, without, [name, *alternatives]), setting.n_effective)
    own = _same(table, fitted, name)
    if own is None:
        return None, []
    price = own.cost + prior_cost(data.declared, own.effect, fitted.fit)
    worth = evidence(without.fit, fitted.fit) - price
    listed = [c for c in table if c.effect.name in alternatives and (c.cost < price or not by_held_out)]
    asked = _asked(setting, without, shortlist(listed, data.thresholds, data.effort, first=True), name)
    records = [RefitRecord(name, own.seed, PASSES, in_place_of=name, dbic=worth), *(r.record for r in asked if r.record.passes)]
    able = eligible(data, asked, noise)
    if by_held_out:
        serve = [r for r in able if r.penalty < price and not predicts_worse(data, fitted, r.fitted)]
        return min(serve, key=lambda r: r.penalty, default=None), records
    best = max(able, key=lambda r: r.on_all_data, default=None)
    least = worth + _held_decrease(data, without, fitted, noise) + data.thresholds.swap
    return (best if best is not None and best.on_all_data > least else None), records


def _held_decrease(data: Data, before: FittedModel, after: FittedModel, noise: Noise) -> float:
    """Return the decrease of χ² on held-out data."""
    return held_chi2(data, before, noise) - held_chi2(data, after, noise)


def _asked(setting: Setting, without: FittedModel, listed: Sequence[Candidate], name: str) -> list[Refit]:
    """Return the acceptance tests of candidates on top of a model, with the seeds of the leading ones improved."""
    asked = list[Refit]()
    for candidate in listed:
        record = RefitRecord(candidate.effect.name, candidate.seed, in_place_of=name)
        try:
            made = refit(setting.data, without, candidate, setting.noise)
        except FemsenseError:
            continue
        asked.append(acceptance_test(setting.data, without, candidate, made, record, setting.noise))
    leading = leaders(setting, without, dict(enumerate(asked)))
    return [leading.get(i, r) for i, r in enumerate(asked)]


def _same(table: Sequence[Candidate], fitted: FittedModel, name: str) -> Candidate | None:
    """Return the candidate of the accepted form: of those whose parameters are all fitted (places and times may be too), the one with most."""
    moving = {(p.key, p.part) for effect, _, parameters in fitted.fit.hypothesis.terms if effect.name == name for p in parameters}
    forms = [c for c in table if c.effect.name == name and {(p.key, p.part) for p in c.parameters} <= moving]
    return max(forms, key=lambda c: len(c.parameters), default=None)


def _without(setting: Setting, history: History, without: FittedModel, name: str) -> History:
    """Return the history as if one effect had never been accepted."""
    left = [n for n, _ in history[1:] if n != name]
    steps: History = [history[0]]
    for i, other in enumerate(left):
        known = [*NUISANCE, *left[: i + 1]]
        steps.append((other, without if i == len(left) - 1 else keeping(setting.data, without, known, setting.noise)))
    return steps


def instead_of_offsets(setting: Setting, fitted: FittedModel, names: Sequence[str]) -> OffsetAlternative | None:
    """Return the effect that best replaces the input offsets of a model; None if the data do not need these."""
    data, noise, n_effective = setting.data, setting.noise, setting.n_effective
    without = offsets_are_evident(data, fitted, noise, n_effective)
    if without is None or np.isinf(data.thresholds.swap):
        return None
    setting.progress("testing alternatives to the input offsets")
    worth = evidence_for_offsets(data, fitted, without, n_effective)
    table = screen_model(data, without.fit, noise, fields_of(data, without, names), n_effective)
    asked = _asked(setting, without, shortlist(table, data.thresholds, data.effort, first=False), OFFSETS)
    best = max(eligible(data, asked, noise), key=lambda r: r.score, default=None)
    if best is None:
        return OffsetAlternative(None, "", -np.inf, [r.record for r in asked])
    takes, ahead = _takes(data, best, fitted, without, worth)
    records = [r.saying(NAMED).record if takes and r is best else r.record for r in asked]
    return OffsetAlternative(best.fitted if takes else None, best.candidate.effect.name, ahead, records)


def _takes(data: Data, best: Refit, fitted: FittedModel, without: FittedModel, worth: float) -> tuple[bool, float]:
    """Return whether an effect replaces input offsets of evidence `worth` [dBIC], and by how much it is ahead; if their evidence is close, the
    cross-validated prediction of left-out sweeps is added."""
    assert best.record.cv_gain is not None
    ahead, evident, least = best.score - worth, data.thresholds.evidence, data.thresholds.swap
    predicts = best.record.cv_gain - sweeps_predicted(data.train, without.fit, fitted.fit)[0]
    return ahead > least or (ahead > -evident and ahead + predicts > least), ahead
