"""The returned robot: which of the effects that were found it has, and their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, spread_evenly
from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.trial import rms_of
from femsense.loop.fit.covariance import parameter_std
from femsense.loop.fit.discretisation_error import beyond_mesh
from femsense.loop.fit.fitted_model import (
    FittedModel,
    held_chi2,
    held_poses_and_inputs,
    keeping,
    span_of,
    with_seeds_still,
)
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.loop_result import rounded
from femsense.loop.search.acceptance import at_edge
from femsense.loop.search.input_offset import moved_nuisance, offsets_are_evident
from femsense.loop.search.search_state import Search
from femsense.loop.thresholds import Thresholds
from femsense.model.as_it_is import evaluate_robot
from femsense.model.effects import OF_BODY, Effect, Entry, Parameter
from femsense.model.robot import Robot

(MODULUS,) = OF_BODY
"""The nuisance effect of the body: its modulus."""


COMPARED = 3
"""Number of frames of each held-out recording in which the returned robot is compared with the fitted model."""


@dataclass(frozen=True, eq=False, slots=True)
class Returned:
    """The returned part of a search."""

    names: list[str]
    """Of the returned effects, nuisance effects first."""
    back: FittedModel
    """The model of these."""
    std: dict[str, FloatArray]
    """Standard deviations in the last model of the search, by effect."""
    insignificant: list[str]
    """Effects that were found, and whose values do not differ significantly from their null."""
    drifted: bool
    """Whether the modulus is significant and not returned: a reduction of the residual by an implausible modulus explains nothing."""


def returned_part(data: Data, search: Search) -> Returned:
    """Return the effects of a search that are significant and that held-out data accept, with their model."""
    final = search.final
    seed_std = {r.name: np.array(r.seed_std) for r in search.refits if r.is_named and r.seed_std is not None}
    std = parameter_std(data, final, search.noise, seed_std)
    promoted = [n for n in promoted_nuisances(data, search) if is_significant(final, n, std[n], data.thresholds)]
    added = [n for n, _ in search.history[1:] if n in final.fit.hypothesis.names]
    significant = significant_effects(data, final, added, std)
    names, back, insignificant = returned_effects(data, search, promoted, significant, seed_std)
    doubtful = [n for n in added if n not in significant or n in insignificant]
    return Returned(names, back, std, doubtful, MODULUS in promoted and MODULUS not in names)


def promoted_nuisances(data: Data, search: Search) -> list[str]:
    """Return the nuisance effects with a significant deviation from the declared values; input offsets only if the data need them."""
    names = [n for n in search.final.fit.hypothesis.names if n in NUISANCE and moved_nuisance(data, search.final, n)]
    return [n for n in names if n in OF_BODY or offsets_are_evident(data, search.final, search.noise, search.n_effective)]


def is_significant(fitted: FittedModel, name: str, std: FloatArray, thresholds: Thresholds) -> bool:
    """Return whether a value of a nuisance effect deviates from the declared one by more than `significant` reported standard deviations."""
    return bool((np.abs(fitted.fit.coordinates[span_of(fitted.fit, name)]) > thresholds.significant * std).any())


def significant_effects(data: Data, fitted: FittedModel, names: Iterable[str], std: Mapping[str, FloatArray]) -> list[str]:
    """Return the effects with a value that deviates from its null by more than `significant` reported standard deviations, and those without such a value
    (a law, a mesh). Places and times do not count, nor does a weight, which every robot has."""
    terms = {effect.name: (effect, parameters) for effect, _, parameters in fitted.fit.hypothesis.terms}
    return [name for name in names if name not in terms or _is_away(data, fitted, *terms[name], std[name])]


def _is_away(data: Data, fitted: FittedModel, effect: Effect, parameters: Sequence[Parameter], std: FloatArray) -> bool:
    own = {p.key for p in effect.parameters(data.robot, data.control)}
    sized = np.array([p.key in own for p in parameters], dtype=bool)
    if effect.discrete or effect.expected(data.declared) or not sized.any():
        return True
    off = np.abs(fitted.fit.coordinates[span_of(fitted.fit, effect.name)] - np.array([p.null for p in parameters]))
    return bool((off > data.thresholds.significant * std)[sized].any())


def returnable_effects(data: Data, search: Search, promoted: list[str], names: list[str]) -> tuple[list[str], FittedModel]:
    """Return the names of the returned effects and their model: with all nuisance effects or, if held-out data reject that, refitted without those that are
    not accepted. A nuisance effect that equals its declared value in that model is removed; then, from the last one on, effects that enlarge the
    held-out error or reach a bound of their plausible range."""
    while names:
        models = [_inside(data, search, kept) for kept in ([*NUISANCE, *names], names)]
        back = next((m for m in models if m is not None and _is_returnable(data, search, m)), None)
        idle = [] if back is None else [n for n in promoted if n in names and not moved_nuisance(data, back, n)]
        if back is not None and not idle:
            return names, back
        names = [n for n in names if n not in idle] if idle else names[:-1]
    return [], search.before


def returned_effects(
    data: Data, search: Search, promoted: list[str], significant: list[str], seed_std: dict[str, FloatArray]
) -> tuple[list[str], FittedModel, list[str]]:
    """Return the names of the returned effects, their model, and the effects that are significant only together with removed ones.

    After an effect is removed, the others are refitted and tested for significance again.
    """
    insignificant = list[str]()
    while True:
        names, back = returnable_effects(data, search, promoted, [*promoted, *significant])
        if not names or back is search.final:
            return names, back, insignificant
        std = parameter_std(data, back, search.noise, seed_std)
        kept = [n for n in names if n in promoted and is_significant(back, n, std[n], data.thresholds)]
        kept += significant_effects(data, back, [n for n in names if n not in promoted], std)
        if len(kept) == len(names):
            return names, back, insignificant
        insignificant += [n for n in names if n not in kept]
        promoted, significant = [n for n in promoted if n in kept], [n for n in significant if n in kept]


def _inside(data: Data, search: Search, names: Sequence[str]) -> FittedModel | None:
    """Return the model of some effects; if one reaches a bound, with places and times fixed. None without equilibrium."""
    back = _returned_model(data, search.final, names, search.noise)
    if back is None or not at_edge(back.fit):
        return back
    return _returned_model(data, with_seeds_still(data, search.final), names, search.noise)


def _is_returnable(data: Data, search: Search, back: FittedModel) -> bool:
    return not at_edge(back.fit) and not set(OF_BODY) & set(at_edge(back.fit, nuisance=True)) and holds_out(data, search, back)


def has_effects(names: Iterable[str]) -> bool:
    return any(name not in NUISANCE for name in names)


@dataclass(frozen=True, slots=True)
class HeldOutComparison:
    """A model compared with the declared one, on held-out data."""

    error: float
    """Ratio of the errors."""
    gain: float
    """Decrease of χ²."""
    beyond_mesh: float
    """Ratio of the errors after the most likely discretisation error is subtracted."""
    only_calibrated: bool
    """Whether it contains nuisance effects only."""

    def holds(self, thresholds: Thresholds) -> bool:
        """Return whether the held-out data accept the model: its error does not exceed the declared model's by more than `not_worse`; or, if only the
        discretisation error makes it larger, the error without that does not, and χ² falls (by `evidence` for calibration alone)."""
        least = thresholds.evidence if self.only_calibrated else 0.0  # effects have already passed a held-out test
        return self.error <= thresholds.not_worse or (self.gain > least and self.beyond_mesh <= thresholds.not_worse)


def holds_out(data: Data, search: Search, back: FittedModel) -> bool:
    """Return whether a model is accepted by held-out data, compared with the declared one."""
    names = back.fit.hypothesis.names
    before, after = held_beyond_mesh(data, search, back)
    compared = HeldOutComparison(
        error=back.held_rms / search.before.held_rms,
        gain=held_chi2(data, search.before, search.noise) - held_chi2(data, back, search.noise),
        beyond_mesh=after / before,
        only_calibrated=not has_effects(names),
    )
    return compared.holds(data.thresholds)


def held_beyond_mesh(data: Data, search: Search, back: FittedModel) -> tuple[float, float]:
    """Return the held-out errors before and after [m], with the most likely discretisation error subtracted."""
    before, after = (beyond_mesh(data.held, s.held_residuals, search.noise) for s in (search.before, back))
    return before, after


def _returned_model(data: Data, final: FittedModel, names: Sequence[str], noise: Noise) -> FittedModel | None:
    """Return the model of some effects, refitted if others are removed; None without equilibrium."""
    if {effect.name for effect, _, _ in final.fit.hypothesis.terms} <= set(names):
        return final
    try:
        return keeping(data, final, names, noise)
    except FemsenseError:
        return None


def entries_of(fitted: FittedModel, names: list[str]) -> list[Entry]:
    """Return the tables of `[[effects]]`: those that change the mesh or the law first, then in the order in which they were found, then nuisance effects
    that are not listed as effects."""
    settled = [{"name": effect.name, **seed} for effect, seed in fitted.fit.hypothesis.settled]
    tables = {e["name"]: e for e in fitted.fit.hypothesis.entries(fitted.fit.coordinates)}
    order = [*(name for name in names if name in tables), *(name for name in tables if name not in names)]
    return [rounded(entry, 9) for entry in (*settled, *(tables[name] for name in order))]


def prediction_gap(data: Data, robot: Robot, back: FittedModel, noise: Noise) -> float:
    """Return the rms distance of markers between a robot and the fitted model that it represents [m], in some of the held-out states.

    Arguments:
        data: held-out data; clouds are skipped.
        robot: the declared robot with the returned effects, as loaded from its file.
        back: the fitted model.
        noise: weights for the poses of held-out recordings.

    Raises:
        DataError: the robot has no equilibrium there.
    """
    unknown = any(t.initial is not None for t in data.held)
    inputs = [initial for _, initial in held_poses_and_inputs(data, back.fit, noise)] if unknown else [None] * len(data.held)
    gaps = list[FloatArray]()
    for trial, held, initial in zip(data.held, back.held, inputs):
        if trial.scene.crossings is not None:
            continue
        frames = trial.scene.frames
        some = frames[spread_evenly(len(frames), COMPARED)]
        scene, starts = trial.scene.pick(some), dict(held.jet.states)
        jet = evaluate_robot(robot, scene, held.poses, initial, starts)
        gaps.append(jet.residual - held.jet.residual[np.isin(trial.scene.frame, some)])
    return rms_of(gaps) if gaps else 0.0
