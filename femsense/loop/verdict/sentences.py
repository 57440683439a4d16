"""The verdict in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from femsense.loop.data.dataset import MESH, Data
from femsense.loop.fit.discretisation_error import mesh_error_rms, mesh_errors
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.repeatability import Repeatability
from femsense.loop.result.loop_result import Verdict
from femsense.loop.result.records import AllRecordings, ConfoundedPair, ModelError, NamedEffect, Value, alternatives
from femsense.loop.search.search_state import Search
from femsense.loop.thresholds import Thresholds
from femsense.loop.verdict.returned_model import has_effects, held_beyond_mesh

MOST_LISTED = 3
"""Maximum number of effects that are listed."""
AT_NOISE = 1.15
"""Ratio of the held-out error to the noise up to which the sentence calls the model a fit to the noise."""
ROUNDED = 1e-6
"""Components below this share of the largest one of a vector, or of their standard deviation, are written as 0."""


def verdict_in_words(
    verdict: str,
    effects: Sequence[NamedEffect],
    found: list[str],
    before: FittedModel,
    after: FittedModel,
    budget: ModelError,
    pairs: Sequence[ConfoundedPair] = (),
) -> str:
    """Return the verdict as a sentence, with the held-out error and the share of model error in it. An effect that these data do not distinguish from others
    is followed by these."""
    error = f"held-out error {1e3 * before.held_rms:.2f} mm"
    known = float(np.hypot(budget.noise_m, budget.placement_m))
    mesh = budget.discretisation_m or 0.0
    if verdict == Verdict.NONE and before.held_rms <= AT_NOISE * np.hypot(known, mesh):
        finer = f" and to its discretisation error ({1e3 * mesh:.2f} mm; a finer mesh would show more)"
        own = finer if mesh and before.held_rms > AT_NOISE * known else ""
        return f"The model fits the data to their noise ({_noise_in_words(budget)}){own}: {error}." + _mesh_in_words(budget)
    of_it = f"of which {1e3 * budget.held_out_m:.2f} mm is model error and {_noise_in_words(budget)} noise"
    if verdict == Verdict.NONE:
        costs = f"; the discretisation error is {1e3 * mesh:.2f} mm" if mesh else ""
        return f"No effect that was tried improves the fit: {error}, {of_it}{costs}." + _mesh_in_words(budget)
    where = "" if after.held_residuals and after.held_residuals[0].shape[1] == 3 else " along the normals of the surface"
    if verdict == Verdict.UNEXPLAINED and not effects:
        explains = "no effect that passes the tests fits" if found else "no known effect fits"
        return f"A residual remains that {explains}: {error}{where}, {of_it}." + _mesh_in_words(budget)
    of_it += "".join(
        f", {1e3 * size:.2f} mm {name}"
        for name, size in ((MESH.name, mesh), ("places of markers", budget.placement_m))
        if size > 5e-6
    )
    names = [e.name for e in effects]
    same = alternatives([pair for pair in pairs if not pair.is_by_model_error], names)
    instead = alternatives([pair for pair in pairs if pair.is_by_model_error], names)
    what = ", ".join(
        f"{e.name} ({values_in_words(e.parameters)}{_or('not distinguished from', same.get(e.name, ()))}"
        f"{_or('by the model error may stand for', instead.get(e.name, ()))})"
        for e in effects
    )
    tail = "" if verdict == Verdict.FOUND else " A residual remains that no effect fits."
    fell = f"held-out error{where} {1e3 * before.held_rms:.2f} mm before, {1e3 * after.held_rms:.2f} mm after"
    return f"The model lacks {what}; {fell}, {of_it}.{tail}" + _mesh_in_words(budget)


def _or(relation: str, others: Sequence[str]) -> str:
    """Return the effects that have a relation to an accepted one, in words."""
    return f"; {relation} {' or '.join(others)}" if others else ""


def _noise_in_words(budget: ModelError) -> str:
    """Return the size of the noise, with a note if it is assumed."""
    size = f"{1e3 * budget.noise_m:.2f} mm"
    return size if budget.noise_is_measured else f"about {size} (assumed: no state repeats)"


def _mesh_in_words(budget: ModelError) -> str:
    """Return a sentence on why the discretisation error is unknown; empty if it is known."""
    return f" The discretisation error is unknown: {budget.discretisation_note}." if budget.discretisation_note else ""


def by_mesh(data: Data, search: Search, back: FittedModel) -> str:
    """Return a sentence with the held-out errors without discretisation error, if the held-out error has grown; else empty."""
    if back.held_rms <= data.thresholds.not_worse * search.before.held_rms or not mesh_errors(data):
        return ""
    before, after = held_beyond_mesh(data, search, back)
    return f" Without the most likely discretisation error it is {1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after."


def on_linear(data: Data, back: FittedModel, names: Sequence[str], noise_m: float) -> str:
    """Return a sentence on effects that may compensate for the discretisation error of a linear mesh; empty for quadratic elements or without such effects.

    A modulus alone counts if the discretisation error exceeds the noise: it compensates most easily.
    """
    mesh = mesh_error_rms(data)
    if not mesh or back.fit.hypothesis.robot.body.mesh.is_quadratic:
        return ""
    if not has_effects(back.fit.hypothesis.names) and (not names or mesh <= noise_m):
        return ""
    return (
        f" The effects may compensate for the discretisation error of the linear elements ({1e3 * mesh:.2f} mm):"
        f' declare mesh.element = "tet10" and repeat, or also try {MESH.name}.'
    )


def evidence_for(data: Data, found: list[str], insignificant: list[str]) -> str:
    """Return a sentence on effects that were found and are not returned; values of `insignificant` ones do not differ significantly from their null."""
    said = ""
    others = [n for n in found if n not in insignificant]
    if insignificant:
        said = f" {', '.join(insignificant)} would improve the fit, but no value is significant (three standard deviations)."
    if not others:
        return said
    mesh = mesh_error_rms(data)
    finer = f"; the discretisation error is {1e3 * mesh:.2f} mm, and a finer mesh may decide" if mesh else ""
    return (
        said
        + f" There is evidence for {', '.join(others)}, but with it the held-out error grows or a value is implausible{finer}."
    )


def by_noise(data: Data, measured: Repeatability) -> str:
    """Return a sentence if the noise exceeds that of any camera; else empty."""
    reach = data.robot.body.reach
    if measured.total < data.thresholds.relevant * reach:
        return ""
    return (
        f" Noise of {1e3 * measured.total:.1f} mm on a body of {1e3 * reach:.0f} mm is larger than that of any camera: repeated frames differ."
        " Check that inputs belong to their frames, and names to their markers and cables."
    )


def everywhere_in_words(seen: AllRecordings | None, thresholds: Thresholds) -> str:
    """Return the results in all recordings of a model that was searched for in some; empty if all were searched."""
    if seen is None:
        return ""
    before, after = 1e3 * seen.before_validation_rms_m, 1e3 * seen.after_validation_rms_m
    said = (
        f" {seen.searched} of {seen.recordings} recordings were searched, and the model was fitted to all: held-out error in all {before:.2f} mm "
        f"before, {after:.2f} mm after."
    )
    more = [name for name, score in sorted(seen.dbic.items(), key=lambda item: -item[1]) if score > thresholds.evidence]
    return said + (f" In all recordings there is linear evidence for more: {', '.join(more[:MOST_LISTED])}." if more else "")


def values_in_words(parameters: Mapping[str, Value]) -> str:
    def show(value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.3g}"
        if isinstance(value, list):
            largest = max((abs(v) for v in value if isinstance(v, float)), default=0.0)
            return "[" + ", ".join(show(0.0 if isinstance(v, float) and abs(v) <= ROUNDED * largest else v) for v in value) + "]"
        return ", ".join(f"{k} {show(v)}" for k, v in value.items()) if isinstance(value, dict) else str(value)

    said = {k: p for k, p in parameters.items() if k != "file"}
    return ", ".join(f"{k} {show(p.value)}" + ("" if p.unit == "1" else f" {p.unit}") for k, p in said.items())
