"""Ask of each effect, when another one was found, whether an alternative to it, or it itself elsewhere, is better now.

What is named first is chosen while the others are still missing, and may have won by what it took of theirs: a tilted gravity instead
of a payload as long as a scale of depth is missing, say, or a soft region in the wrong place as long as friction is. A step that
swaps one is what selection and pruning alone lack.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.fit.fitted_model import FittedModel, keeping
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search.acceptance import acceptance_test, prior_cost
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.forward_selection import polished, shortlist
from femsense.loop.search.location_search import may_lie_elsewhere
from femsense.loop.search.refit import evidence, refit
from femsense.loop.search.screening import Candidate, screen_model
from femsense.loop.search.search_state import Progress, Refit, at_step

History = list[tuple[str, FittedModel]]


def swapped(
    data: Data, history: History, refits: list[RefitRecord], noise: Noise, n_effective: float, say: Progress
) -> tuple[History, list[RefitRecord]]:
    """Return the history with alternatives in the places of effects, but for the last one, that they beat in the whole model, and the
    refits with what became of those that were asked."""
    for name in [name for name, _ in history[1:-1]] if np.isfinite(data.thresholds.swap) else []:
        fitted = history[-1][1]
        alternatives = _alternatives(data, fitted, refits, name)
        if not alternatives or (alternatives == [name] and not may_lie_elsewhere(data, fitted, name, noise)):
            continue
        say(f"refitting {' or '.join(alternatives)} in the place of {name}")
        try:
            without = keeping(data, fitted, [n for n in fitted.fit.hypothesis.names if n != name], noise)
            best, records = _best(data, fitted, without, name, alternatives, noise, n_effective, say)
            if best is not None:
                history = [*_without(data, history, without, name, noise), (best.candidate.effect.name, best.fitted)]
        except FemsenseError:
            continue
        if best is not None:
            refits = [replace(r, verdict=PASSES) if r.name == name and r.is_named else r for r in refits]
            records = [replace(r, verdict=NAMED) if r is best.record else r for r in records]
        refits = [*refits, *at_step(records, len(history) - 1)]
    return history, refits


def _alternatives(data: Data, fitted: FittedModel, refits: Sequence[RefitRecord], name: str) -> list[str]:
    """Return the effects that were nearly as good when one was named, the best first; the effect itself if its seed was chosen from many."""
    seeds = {effect.name: seed for effect, seed, parameters in fitted.fit.hypothesis.terms if parameters}
    named = [r for r in refits if r.name == name and r.is_named]
    if name not in seeds or not named:
        return []
    own = named[-1]
    near = [
        r
        for r in refits
        if r.answers_as(own)
        and r.passes
        and r.evidence > data.thresholds.near_as_good * own.evidence - data.thresholds.evidence
        and r.name not in fitted.fit.hypothesis.names
    ]
    others = list(dict.fromkeys(r.name for r in sorted(near, key=lambda r: -r.evidence)))
    return [name] * bool(seeds[name]) + others[: data.effort.alternatives]


def _best(
    data: Data,
    fitted: FittedModel,
    without: FittedModel,
    name: str,
    alternatives: list[str],
    noise: Noise,
    n_effective: float,
    say: Progress,
) -> tuple[Refit | None, list[RefitRecord]]:
    """Return the best alternative if it is better than what is named, and what became of each."""
    table = screen_model(data, without.fit, noise, fields_of(data, without, [name, *alternatives]), n_effective)
    own = _same(table, fitted, name)
    if own is None:
        return None, []
    worth = evidence(without.fit, fitted.fit) - own.cost - prior_cost(data.declared, own.effect, fitted.fit)
    records = [RefitRecord(name, own.seed, PASSES, in_place_of=name, dbic=worth)]
    best: Refit | None = None
    listed = [c for c in table if c.effect.name in alternatives]
    for candidate in shortlist(listed, data.thresholds, data.effort, first=True):
        record = RefitRecord(candidate.effect.name, candidate.seed, in_place_of=name)
        try:
            made = refit(data, without, candidate, noise)
        except FemsenseError:
            continue
        tried = acceptance_test(data, without, candidate, made, record, noise)
        if not tried.record.passes:
            continue
        tried = polished(data, without, tried, noise, say)
        records.append(tried.record)
        if tried.score > (worth + data.thresholds.swap if best is None else best.score):
            best = tried
    return best, records


def _same(table: Sequence[Candidate], fitted: FittedModel, name: str) -> Candidate | None:
    """Return the candidate of the form that is named: the one with most of what is fitted, which may be its place or time, too."""
    moving = {(p.key, p.part) for effect, _, parameters in fitted.fit.hypothesis.terms if effect.name == name for p in parameters}
    forms = [c for c in table if c.effect.name == name and {(p.key, p.part) for p in c.parameters} <= moving]
    return max(forms, key=lambda c: len(c.parameters), default=None)


def _without(data: Data, history: History, without: FittedModel, name: str, noise: Noise) -> History:
    """Return the history as if one effect had never been found."""
    left = [n for n, _ in history[1:] if n != name]
    steps: History = [history[0]]
    for i, other in enumerate(left):
        known = [*NUISANCE, *left[: i + 1]]
        steps.append((other, without if i == len(left) - 1 else keeping(data, without, known, noise)))
    return steps
