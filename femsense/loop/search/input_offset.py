"""Input offsets that moved, and whether an effect says better what they took.

The offsets are fitted along with everything, so that an effect competes with them only for what they leave. A camera whose distances
are off, a load or a weight can look much like a wrong offset: the offsets then swallow it, and would be named. So the model is fitted
without them, and every effect is asked what it would explain in their place.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.cross_validation import sweeps_predicted
from femsense.loop.fit.discretisation_error import beyond_mesh
from femsense.loop.fit.fitted_model import FittedModel, held_chi2, keeping, span_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search.acceptance import (
    acceptance_test,
    discretisation_rms,
    held_share,
    moved_by,
    sure_beyond_mesh,
)
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.forward_selection import polished, shortlist
from femsense.loop.search.refit import evidence, refit
from femsense.loop.search.screening import screen_model
from femsense.loop.search.search_state import OffsetAlternative, Progress, Refit
from femsense.model.effects import OF_INPUTS
from femsense.model.effects.base import range_units

(OFFSETS,) = OF_INPUTS
"""The input offsets."""


def moved_nuisance(data: Data, fitted: FittedModel, name: str) -> int:
    """Return how many values of a nuisance the data moved significantly away from what is declared, and by more than a share of it."""
    part = span_of(fitted.fit, name)
    values, std, decides = fitted.fit.coordinates[part], fitted.fit.std[part], data.thresholds
    if not len(values):
        return 0
    parameters = next(own for effect, _, own in fitted.fit.hypothesis.terms if effect.name == name)
    size = np.abs(values) / np.maximum(range_units(parameters, data.robot.body.cable_names, data.input_scale), 1e-12)
    return int(((np.abs(values) > decides.significant * std) & (size > decides.relevant)).sum())


def evidence_for_offsets(data: Data, fitted: FittedModel, without: FittedModel, n_effective: float) -> float:
    """Return the dBIC of the offsets that moved: the others, as good as declared, cost nothing."""
    moved, count = moved_nuisance(data, fitted, OFFSETS), len(data.robot.body.cables)
    return evidence(without.fit, fitted.fit) - moved * float(np.log(n_effective)) - 2.0 * float(np.log(max(count, 1)))


def offsets_are_evident(data: Data, fitted: FittedModel, noise: Noise, n_effective: float) -> FittedModel | None:
    """Return the model without the offsets if it misses them, else None."""
    if not moved_nuisance(data, fitted, OFFSETS):
        return None
    try:
        without = keeping(data, fitted, [n for n in fitted.fit.hypothesis.names if n != OFFSETS], noise)
    except FemsenseError:
        return None
    if evidence_for_offsets(data, fitted, without, n_effective) <= data.thresholds.evidence:
        return None
    moved, declared = (beyond_mesh(data.held, s.held_residuals, noise) for s in (fitted, without))
    if moved >= declared:
        return None
    better, std_error = sweeps_predicted(data.train, without.fit, fitted.fit)
    held = held_chi2(data, without, noise) - held_chi2(data, fitted, noise)
    decides, expected = data.thresholds, held_share(data) * evidence(without.fit, fitted.fit)
    sure = sure_beyond_mesh(better, std_error, held, expected, decides)
    least = decides.above_mesh_if_sure if sure else decides.offsets_above_mesh
    return without if moved_by(without, fitted) > least * discretisation_rms(data, without) else None


def instead_of_offsets(
    data: Data, fitted: FittedModel, names: Sequence[str], noise: Noise, n_effective: float, say: Progress
) -> OffsetAlternative | None:
    """Ask which effect explains what the input offsets of a model explain; None where they explain nothing.

    Play of held cables does what offsets below those declared do. Of the two it is named where no offset is above: offsets err both ways.
    """
    without = offsets_are_evident(data, fitted, noise, n_effective)
    if without is None or not np.isfinite(data.thresholds.swap):
        return None
    say("asking what else might be in the place of the input offsets")
    worth = evidence_for_offsets(data, fitted, without, n_effective)
    table = screen_model(data, without.fit, noise, fields_of(data, without, names), n_effective)
    passing: dict[int, Refit] = {}
    records: list[RefitRecord] = []
    for candidate in shortlist(table, data.thresholds, data.effort, first=False):
        record = RefitRecord(candidate.effect.name, candidate.seed, in_place_of=OFFSETS)
        try:
            made = refit(data, without, candidate, noise)
        except FemsenseError:
            continue
        tried = acceptance_test(data, without, candidate, made, record, noise)
        passing |= {len(records): tried} if tried.record.passes else {}
        records.append(tried.record)
    if not passing:
        return OffsetAlternative(None, "", -np.inf, records)
    at = max(passing, key=lambda i: passing[i].score)
    best = polished(data, without, passing[at], noise, say)
    ahead = best.score - worth
    assert best.record.cv_gain is not None
    predicts = best.record.cv_gain - sweeps_predicted(data.train, without.fit, fitted.fit)[0]
    evident, better = data.thresholds.evidence, data.thresholds.swap
    takes = ahead > better or (ahead > -evident and ahead + predicts > better)  # where evidence is close, what predicts better
    takes = takes or (
        best.candidate.effect.mirrors(OFFSETS) and best.fitted.fit.chi2 < fitted.fit.chi2 + evident
    )  # its mirror image
    records[at] = best.saying(NAMED).record if takes else best.record
    return OffsetAlternative(best.fitted if takes else None, best.candidate.effect.name, ahead, records)
