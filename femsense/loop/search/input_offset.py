"""Cable zeros that moved, and whether an effect says better what they took.

The zeros are fitted along with everything, so that an effect competes with them only for what they leave. A camera whose distances
are off, a load or a weight can look much like a wrong zero: the zeros then swallow it, and would be named. So the model is fitted
without them, and every effect is asked what it would explain in their place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.fit.cross_validation import sweeps_predicted
from femsense.loop.fit.discretisation_error import beyond_mesh
from femsense.loop.fit.fitted_model import Stage, held_chi2, keeping, span_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.acceptance import ABOVE_MESH_IF_SURE, held_share, judged, mesh_cost, moved_by, sure_beyond_mesh
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.forward_selection import polished, shortlist
from femsense.loop.search.refit import EVIDENCE, evidence, refit
from femsense.loop.search.screening import screen_stage
from femsense.loop.search.search_state import InPlace, Progress, Refit

ZEROS = "cable_offset"
SIGNIFICANT = 3.0
RELEVANT = 0.02
"""A nuisance that moved by more than three standard deviations and 2 % is named as an effect."""
ABOVE_MESH = 0.75
"""Zeros must move the markers by this much of what the mesh itself costs, which they imitate best (less where sweeps are sure, as of any effect)."""
BETTER = 2.0
"""dBIC by which an effect must be better than the zeros to take their place."""


def moved_nuisance(data: Data, stage: Stage, name: str, *, relevant: float = RELEVANT) -> int:
    """Return how many values of a nuisance the data moved significantly away from what is declared, and by more than a share of it."""
    part = span_of(stage.fit, name)
    values, std = stage.fit.coordinates[part], stage.fit.std[part]
    if not len(values):
        return 0
    size = np.abs(values) / (1.0 if name == "stiffness" else np.maximum(data.input_scale, 1e-12))
    return int(((np.abs(values) > SIGNIFICANT * std) & (size > relevant)).sum())


def evidence_for_zeros(data: Data, stage: Stage, without: Stage, n_effective: float) -> float:
    """Return the dBIC of the zeros that moved: the others, as good as declared, cost nothing."""
    moved, count = moved_nuisance(data, stage, ZEROS), len(data.robot.body.cables)
    return evidence(without.fit, stage.fit) - moved * float(np.log(n_effective)) - 2.0 * float(np.log(max(count, 1)))


def zeros_are_evident(data: Data, stage: Stage, noise: Noise, n_effective: float) -> Stage | None:
    """Return the model without the zeros if it misses them, else None."""
    if not moved_nuisance(data, stage, ZEROS):
        return None
    try:
        without = keeping(data, stage, [n for n in stage.fit.hypothesis.names if n != ZEROS], noise)
    except FemsenseError:
        return None
    if evidence_for_zeros(data, stage, without, n_effective) <= EVIDENCE:
        return None
    fitted, declared = (beyond_mesh(data.held, s.held_residuals, noise) for s in (stage, without))
    if fitted >= declared:
        return None
    better, spread = sweeps_predicted(data.train, without.fit, stage.fit)
    held = held_chi2(data, without, noise) - held_chi2(data, stage, noise)
    sure = sure_beyond_mesh(better, spread, held, held_share(data) * evidence(without.fit, stage.fit))
    return without if moved_by(without, stage) > (ABOVE_MESH_IF_SURE if sure else ABOVE_MESH) * mesh_cost(data, without) else None


def in_place_of_zeros(
    data: Data, stage: Stage, names: Sequence[str], noise: Noise, n_effective: float, say: Progress
) -> InPlace | None:
    """Ask which effect explains what the zeros of a model explain; None where they explain nothing.

    Play of held cables does what zeros below those declared do. Of the two it is named where no zero is above: zeros err both ways.
    """
    without = zeros_are_evident(data, stage, noise, n_effective)
    if without is None:
        return None
    say("asking what else might be in the place of the cable zeros")
    worth = evidence_for_zeros(data, stage, without, n_effective)
    table = screen_stage(data, without.fit, noise, fields_of(data, without, names), n_effective)
    best: Refit | None = None
    records: list[dict[str, Any]] = []
    for candidate in shortlist(table, first=False):
        if candidate.score < 0.5 * worth - EVIDENCE:
            continue
        record: dict[str, Any] = {"name": candidate.effect.name, "seed": candidate.seed, "in_place_of": ZEROS}
        try:
            made = refit(data, without, candidate, noise)
        except FemsenseError:
            continue
        tried = judged(data, without, candidate, made, record, noise)
        records.append(record)
        if record["verdict"] == "passes" and (best is None or tried.score > best.score):
            best = tried
    if best is None:
        return InPlace(None, "", -np.inf, records)
    best = polished(data, without, best, noise, say)
    ahead = best.score - worth
    predicts = best.record["cv_gain"] - sweeps_predicted(data.train, without.fit, stage.fit)[0]
    takes = ahead > BETTER or (ahead > -EVIDENCE and ahead + predicts > BETTER)  # where evidence is close, what predicts better
    takes = takes or (
        best.candidate.effect.name == "cable_slack" and best.stage.fit.chi2 < stage.fit.chi2 + EVIDENCE
    )  # its mirror image
    if takes:
        best.record["verdict"] = "named"
    return InPlace(best.stage if takes else None, best.candidate.effect.name, ahead, records)
