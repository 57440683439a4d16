"""Input offsets: do they differ from zero, and do the data need them?"""

from __future__ import annotations

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.discretisation_error import beyond_mesh
from femsense.loop.fit.fitted_model import FittedModel, span_of, without_effect
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.refit import evidence
from femsense.model.effects import OF_INPUTS
from femsense.model.effects.base import range_units

(OFFSETS,) = OF_INPUTS
"""The input offsets."""


def moved_nuisance(data: Data, fitted: FittedModel, name: str) -> int:
    """Return how many values of a nuisance differ from the declared one by more than `significant` σ and by more than the share `relevant`."""
    part = span_of(fitted.fit, name)
    values, std, thresholds = fitted.fit.coordinates[part], fitted.fit.std[part], data.thresholds
    if not len(values):
        return 0
    parameters = next(own for effect, _, own in fitted.fit.hypothesis.terms if effect.name == name)
    size = np.abs(values) / np.maximum(range_units(parameters, data.robot.body.cable_names, data.input_scale), 1e-12)
    return int(((np.abs(values) > thresholds.significant * std) & (size > thresholds.relevant)).sum())


def evidence_for_offsets(data: Data, fitted: FittedModel, without: FittedModel, n_effective: float) -> float:
    """Return the dBIC of the input offsets; only those that differ significantly from zero count as parameters."""
    moved, count = moved_nuisance(data, fitted, OFFSETS), len(data.robot.body.cables)
    return evidence(without.fit, fitted.fit) - moved * float(np.log(n_effective)) - 2.0 * float(np.log(max(count, 1)))


def offsets_are_evident(data: Data, fitted: FittedModel, noise: Noise, n_effective: float) -> FittedModel | None:
    """Return the model without the input offsets if the data need these, by evidence and held-out error; else None."""
    if not moved_nuisance(data, fitted, OFFSETS):
        return None
    try:
        without = without_effect(data, fitted, OFFSETS, noise)
    except FemsenseError:
        return None
    if evidence_for_offsets(data, fitted, without, n_effective) <= data.thresholds.evidence:
        return None
    moved, declared = (beyond_mesh(data.held, s.held_residuals, noise) for s in (fitted, without))
    return without if moved < declared else None
