"""Accepted effects with one value per cable or chamber, after the search has ended.

A form with one value, or with the value of one cable, has the smallest penalty and is accepted first; missing effects can hide
the differences between cables until then. The richer form of each accepted effect is therefore refitted in the whole model, and replaces
the simple one if its further parameters have evidence and the held-out error does not grow.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel, fit_model, own_of, span_at, with_term, with_values
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import RefitRecord
from femsense.loop.search.refit import evidence, within
from femsense.loop.search.search_state import Setting, no_equilibrium
from femsense.model.effects import FORMS
from femsense.model.observation import Term


def with_all_parts(setting: Setting, fitted: FittedModel) -> tuple[FittedModel, list[RefitRecord]]:
    """Return the model with the richer forms that have evidence, and the record of each form that was fitted."""
    data, records = setting.data, list[RefitRecord]()
    for i, term in enumerate(fitted.fit.hypothesis.terms):
        for richer in _richer_terms(data, term):
            setting.progress(f"trying {term[0].name} with {len(richer[2])} parameters")
            price = (len(richer[2]) - len(term[2])) * float(np.log(setting.n_effective)) + data.thresholds.evidence
            record = RefitRecord(term[0].name, term[1])
            try:
                made = _fitted_with(data, fitted, i, richer, setting.noise, price)
            except FemsenseError as error:
                records.append(replace(record, verdict=no_equilibrium(error)))
                continue
            gain = evidence(fitted.fit, made.fit)
            worse = made.held_rms > fitted.held_rms
            better = gain > price and not worse
            verdict = (
                "accepted with one value each"
                if better
                else "the values of each are not distinguished"
                if gain <= price
                else "separate values predict the held-out data worse"
            )
            score = gain - price + data.thresholds.evidence
            records.append(replace(record, verdict=verdict, dchi2=gain, dbic=score, validation_rms_m=made.held_rms))
            fitted = made if better else fitted
    return fitted, records


def _richer_terms(data: Data, term: Term) -> Iterator[Term]:
    """Yield the forms of a term with one value per part if the term has one for all parts, or for some of them."""
    effect, seed, own = term
    parts = {p.part for p in own}
    for form in FORMS:
        if form.name != effect.name or form.places_markers:
            continue
        every = form.parameters(data.robot, data.control)
        named = all(isinstance(p.part, str) for p in every)
        if (
            len(every) > len(own)
            and named
            and {p.key for p in every} == {p.key for p in own}
            and parts <= {None, *(p.part for p in every)}
        ):
            yield form, seed, every


def _fitted_with(data: Data, fitted: FittedModel, i: int, richer: Term, noise: Noise, price: float) -> FittedModel:
    """Return the model with another form of its i-th term, started from its current values; a part without a value starts from
    their mean. Raises DataError."""
    fit = fitted.fit
    found = {p.part: float(v) for p, v in zip(fit.hypothesis.terms[i][2], fit.coordinates[span_at(fit, i)])}
    usual = found.get(None, float(np.mean(list(found.values()))))
    start = with_values(fit, [found.get(p.part, usual) for p in richer[2]], at=i)
    hypothesis, prior = with_term(fit, *richer, at=i)
    return fit_model(data, hypothesis, prior, noise, start, own=own_of(fitted), max_iterations=10, worth=within(fit, price))
