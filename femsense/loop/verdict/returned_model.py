"""The robot that is handed back: which of the effects that were found, and with which sizes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray
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
from femsense.loop.search.input_offset import OFFSETS, moved_nuisance, offsets_are_evident
from femsense.loop.search.search_state import Search
from femsense.loop.thresholds import Thresholds
from femsense.model.as_it_is import evaluate_robot
from femsense.model.effects import OF_BODY, Effect, Entry, Parameter
from femsense.model.robot import Robot

(MODULUS,) = OF_BODY
"""What calibration may move of the body."""


COMPARED = 3
"""Frames of each held-out recording in which the robot that is handed back is asked for what the fitted model says."""


def promoted_nuisances(data: Data, search: Search) -> list[str]:
    """Return the nuisances that the data moved significantly away from what is declared; of the input offsets, those that are missed."""
    names = [n for n in search.final.fit.hypothesis.names if n in NUISANCE and moved_nuisance(data, search.final, n)]
    return [n for n in names if n in OF_BODY or offsets_are_evident(data, search.final, search.noise, search.n_effective)]


def is_sure(fitted: FittedModel, name: str, std: FloatArray, decides: Thresholds) -> bool:
    """Return whether a value of a nuisance differs from what is declared by more than `significant` of the standard deviations that are reported."""
    return bool((np.abs(fitted.fit.coordinates[span_of(fitted.fit, name)]) > decides.significant * std).any())


def sure_effects(data: Data, fitted: FittedModel, names: Iterable[str], std: Mapping[str, FloatArray]) -> list[str]:
    """Return the effects with a value of their own that is away from what is declared by more than `significant` of the standard deviations that are
    reported, and those that have none (a law, a mesh). Places and times are no such values, nor is a weight that no robot can be without."""
    terms = {effect.name: (effect, parameters) for effect, _, parameters in fitted.fit.hypothesis.terms}
    return [name for name in names if name not in terms or _is_away(data, fitted, *terms[name], std[name])]


def _is_away(data: Data, fitted: FittedModel, effect: Effect, parameters: Sequence[Parameter], std: FloatArray) -> bool:
    own = {p.key for p in effect.parameters(data.robot, data.control)}
    sized = np.array([p.key in own for p in parameters], dtype=bool)
    if effect.discrete or effect.expected(data.declared) or not sized.any():
        return True
    off = np.abs(fitted.fit.coordinates[span_of(fitted.fit, effect.name)] - np.array([p.null for p in parameters]))
    return bool((off > data.thresholds.significant * std)[sized].any())


def worth_handing_back(data: Data, search: Search, promoted: list[str], names: list[str]) -> tuple[list[str], FittedModel]:
    """Return the names that are handed back with their model: with all that was fitted along or, where held-out data speak against that, fitted again
    without the nuisances that are not named. Nuisances that are as declared there are not named, and from the last one on neither is what would make
    the error on held-out data larger than it was, or goes to the edge of what is plausible."""
    while names:
        models = [_inside(data, search, kept) for kept in ([*NUISANCE, *names], names)]
        back = next((m for m in models if m is not None and _may_be_handed_back(data, search, m)), None)
        idle = [] if back is None else [n for n in promoted if n in names and not moved_nuisance(data, back, n)]
        if back is not None and not idle:
            return names, back
        names = [n for n in names if n not in idle] if idle else names[:-1]
    return [], search.before


def surely_handed_back(
    data: Data, search: Search, promoted: list[str], sure: list[str], seed_std: dict[str, FloatArray]
) -> tuple[list[str], FittedModel, list[str]]:
    """Return the names that are handed back with their model, and the names that are sure beside what is not handed back, but not without it.

    Where something that was found is gone, the others are fitted again, and asked again whether they are sure.
    """
    unsure = list[str]()
    while True:
        names, back = worth_handing_back(data, search, promoted, [*promoted, *sure])
        if not names or back is search.final:
            return names, back, unsure
        std = parameter_std(data, back, search.noise, seed_std)
        kept = [n for n in names if n in promoted and is_sure(back, n, std[n], data.thresholds)]
        kept += sure_effects(data, back, [n for n in names if n not in promoted], std)
        if len(kept) == len(names):
            return names, back, unsure
        unsure += [n for n in names if n not in kept]
        promoted, sure = [n for n in promoted if n in kept], [n for n in sure if n in kept]


def _inside(data: Data, search: Search, names: Sequence[str]) -> FittedModel | None:
    """Return the model of some names, with places and times still where one of them would go to the edge of its range; None where it has no equilibrium."""
    back = _handed_back(data, search.final, names, search.noise)
    if back is None or not at_edge(back.fit):
        return back
    return _handed_back(data, with_seeds_still(data, search.final), names, search.noise)


def _may_be_handed_back(data: Data, search: Search, back: FittedModel) -> bool:
    return not at_edge(back.fit) and not set(OF_BODY) & set(at_edge(back.fit, nuisance=True)) and holds_out(data, search, back)


def has_effects(names: Iterable[str]) -> bool:
    return any(name not in NUISANCE for name in names)


@dataclass(frozen=True, slots=True)
class HeldOutComparison:
    """A model beside the declared one, on held-out data."""

    error: float
    """Its error, in that of the declared model."""
    gain: float
    """By how much χ² falls."""
    beyond_mesh: float
    """Its error less the likeliest share of the discretisation error, in that of the declared model."""
    error_to_base: float
    """Its error, in that of the model with all that calibration may move."""
    only_calibrated: bool
    """Whether it has no effect but what calibration may move."""
    with_offsets: bool = False
    """Whether input offsets are among that."""

    def holds(self, decides: Thresholds) -> bool:
        """Return whether the model is no worse in millimetres; or else better by the noise that these data have, where it is calibrated only and
        within reason, or where the mesh's own error is all that is larger: then it must be no worse beyond that, nor in millimetres than the model
        with all that calibration may move, and not be input offsets alone."""
        if self.error <= decides.not_worse:
            return True
        if self.gain <= (decides.evidence if self.only_calibrated else 0.0):  # effects have been judged by held-out data before
            return False
        if self.only_calibrated and self.error <= decides.noisy:
            return True
        only_offsets = self.only_calibrated and self.with_offsets  # much else looks like them
        shown = not only_offsets and self.error_to_base <= decides.not_worse
        return shown and self.beyond_mesh <= decides.not_worse


def holds_out(data: Data, search: Search, back: FittedModel) -> bool:
    """Return whether a model holds on held-out data beside the declared one."""
    names = back.fit.hypothesis.names
    before, after = held_beyond_mesh(data, search, back)
    compared = HeldOutComparison(
        error=back.held_rms / search.before.held_rms,
        gain=held_chi2(data, search.before, search.noise) - held_chi2(data, back, search.noise),
        beyond_mesh=after / before,
        error_to_base=back.held_rms / search.base.held_rms,
        only_calibrated=not has_effects(names),
        with_offsets=OFFSETS in names,
    )
    return compared.holds(data.thresholds)


def held_beyond_mesh(data: Data, search: Search, back: FittedModel) -> tuple[float, float]:
    """Return the held-out errors before and after [m] less the likeliest share of the discretisation error."""
    before, after = (beyond_mesh(data.held, s.held_residuals, search.noise) for s in (search.before, back))
    return before, after


def _handed_back(data: Data, final: FittedModel, names: Sequence[str], noise: Noise) -> FittedModel | None:
    """Return the model of some names alone, fitted again where others are gone; None where it has no equilibrium."""
    if {effect.name for effect, _, _ in final.fit.hypothesis.terms} <= set(names):
        return final
    try:
        return keeping(data, final, names, noise)
    except FemsenseError:
        return None


def entries_of(fitted: FittedModel, names: list[str]) -> list[Entry]:
    """Return the tables of `[[effects]]`: those that change the mesh or the law first, then in the order in which they were found, then what was
    fitted along and is not named."""
    settled = [{"name": effect.name, **seed} for effect, seed in fitted.fit.hypothesis.settled]
    tables = {e["name"]: e for e in fitted.fit.hypothesis.entries(fitted.fit.coordinates)}
    order = [*(name for name in names if name in tables), *(name for name in tables if name not in names)]
    return [rounded(entry, 9) for entry in (*settled, *(tables[name] for name in order))]


def prediction_gap(data: Data, robot: Robot, back: FittedModel, noise: Noise) -> float:
    """Return how far markers are between a robot and the fitted model that it should be [m], root mean square, in some of the held-out states.

    Arguments:
        data: what was held out; clouds are not asked.
        robot: the declared robot with the effects that are handed back, as whoever loads its file has it.
        back: the fitted model.
        noise: with which poses of other recordings are fitted.

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
        some = frames[np.unique(np.linspace(0, len(frames) - 1, COMPARED).round().astype(int))]
        scene, starts = trial.scene.pick(some), dict(held.jet.states)
        jet = evaluate_robot(robot, scene, held.poses, initial, starts)
        gaps.append(jet.residual - held.jet.residual[np.isin(trial.scene.frame, some)])
    return rms_of(gaps) if gaps else 0.0
