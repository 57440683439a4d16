"""The verdict in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from femsense.loop.data.dataset import MESH, Data
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.discretisation_error import mesh_errors
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.loop_result import EFFECTS, NONE, UNEXPLAINED
from femsense.loop.result.records import NamedEffect, Value
from femsense.loop.search.search_state import Search
from femsense.loop.verdict.returned_model import NOT_WORSE, has_effects, held_beyond_mesh

ROUNDED = 1e-6
"""What is so small beside the largest component of a vector is said as 0."""


BEYOND_NOISE = 1.2
"""Held-out errors that are so many times the noise need another reason."""


GROSS = 0.03
"""Noise of more than this share of the body's reach is said to be suspicious."""


def verdict_in_words(
    verdict: str,
    effects: Sequence[NamedEffect],
    found: list[str],
    before: FittedModel,
    after: FittedModel,
    noise: Noise,
    mesh: float | None,
) -> str:
    """Return the sentence on top; `mesh` is the discretisation error [m], where that is known."""
    error = f"held-out error {1e3 * before.held_rms:.2f} mm"
    if not noise.std:
        error += " along the normals of the surface"
    if verdict == NONE and before.held_rms > BEYOND_NOISE * np.hypot(noise.total, mesh or 0.0):
        costs = f"; the discretisation error is {1e3 * mesh:.2f} mm" if mesh else ""
        return f"Nothing that was tried explains more of the data: {error}; their noise is {1e3 * noise.total:.2f} mm{costs}."
    if verdict == NONE:
        known = f"to their noise ({1e3 * noise.total:.2f} mm)"
        if mesh and before.held_rms > BEYOND_NOISE * noise.total:
            known += f" and to its discretisation error ({1e3 * mesh:.2f} mm; a finer mesh would show more)"
        return f"The model explains the data {known}: {error}."
    if verdict == UNEXPLAINED and not effects:
        explains = "nothing that may be handed back" if found else "no effect of the list"
        small = ", though it is no larger than the noise" if before.held_rms <= noise.total else ""
        return f"A residual is left that {explains} explains{small}: {error}, noise {1e3 * noise.total:.2f} mm."
    what = ", ".join(f"{e.name} ({values_in_words(e.parameters)})" for e in effects)
    tail = "" if verdict == EFFECTS else " A residual is left that no effect explains."
    where = "" if noise.std else " along the normals of the surface"
    return f"The model lacks {what}; held-out error{where} {1e3 * before.held_rms:.2f} mm before, {1e3 * after.held_rms:.2f} mm after.{tail}"


def by_mesh(data: Data, search: Search, back: FittedModel) -> str:
    """Return a sentence on what the held-out error is beyond the mesh's own, where that is what makes it larger; nothing where it is not larger."""
    if back.held_rms <= NOT_WORSE * search.before.held_rms or not mesh_errors(data):
        return ""
    before, after = held_beyond_mesh(data, search, back)
    return f" Less the likeliest share of the discretisation error, that is {1e3 * before:.2f} mm before, {1e3 * after:.2f} mm after."


def on_linear(data: Data, back: FittedModel) -> str:
    """Return a sentence on what effects that are named on a linear mesh may stand for; nothing elsewhere, or where that is an effect itself."""
    mesh = mesh_error_rms(data)
    if not mesh or back.fit.hypothesis.robot.body.mesh.is_quadratic or not has_effects(back.fit.hypothesis.names):
        return ""
    return f" Linear elements have a discretisation error of {1e3 * mesh:.2f} mm, which other effects may stand for: try {MESH.name} too."


def evidence_for(data: Data, found: list[str]) -> str:
    """Return a sentence on effects that were found and are not handed back; nothing where there are none."""
    if not found:
        return ""
    mesh = mesh_error_rms(data)
    finer = f"; the discretisation error is {1e3 * mesh:.2f} mm, and a finer mesh may tell" if mesh else ""
    return (
        f" There is evidence for {', '.join(found)}, but the held-out error would grow with it or a value be implausible{finer}."
    )


def by_noise(data: Data, noise: Noise) -> str:
    """Return in words that the noise is beyond what cameras have."""
    reach = data.robot.body.reach
    if noise.total < GROSS * reach:
        return ""
    return (
        f" Noise of {1e3 * noise.total:.1f} mm on a body of {1e3 * reach:.0f} mm is no camera's: frames that should be alike are not."
        " Look whether inputs belong to their frames and names to their markers and cables."
    )


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


def mesh_error_rms(data: Data) -> float | None:
    """Return how far a finer mesh would move the markers, root mean square [m]; None where it was not computed."""
    errors = mesh_errors(data)
    return rms_of(errors) if errors else None
