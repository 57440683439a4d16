"""The search for effects: screen, refit, add the best, re-test the earlier ones, and repeat on the larger model until no candidate passes."""

from __future__ import annotations

from collections.abc import Sequence

from femsense.core.errors import FemsenseError
from femsense.io.checkpoint import Checkpoint
from femsense.loop.data.dataset import Data
from femsense.loop.fit.discretisation_error import same_mesh_error, with_mesh_errors
from femsense.loop.fit.fitted_model import FittedModel, mean_square
from femsense.loop.fit.marker_placement import with_errors_as_shown, with_turning_placements
from femsense.loop.fit.model_error import excess_of
from femsense.loop.fit.noise_components import Noise
from femsense.loop.fit.repeatability import repeatability
from femsense.loop.result.records import RefitRecord
from femsense.loop.search.acceptance import discretisation_rms, moved_by
from femsense.loop.search.calibration import Ready, calibrated_pose, fitted_again, matched
from femsense.loop.search.effect_fields import Fields, fields_of
from femsense.loop.search.forward_selection import hinted, select_next
from femsense.loop.search.richer_forms import with_all_parts
from femsense.loop.search.screening import Candidate, noise_of, screen_model
from femsense.loop.search.search_state import Progress, Refit, Search, SearchProgress, at_step
from femsense.loop.search.swaps import instead_of_offsets, simplest, swapped
from femsense.model.recording import state_key


def new_search(ready: Ready, names: Sequence[str], refits: list[RefitRecord], *, quadratic: bool) -> SearchProgress:
    """Return the initial state of a search that extends the last model of a history."""
    data, before, history = ready
    last = history[-1][1]
    return SearchProgress(data, data, before, list(history), len(history), last, last, list(names), quadratic, refits)


def search_effects(state: SearchProgress, checkpoint: Checkpoint, progress: Progress) -> tuple[Data, Search]:
    """Screen, refit and add effects until none passes; return the data prepared for the last model, and the search."""
    _seek(state, checkpoint, progress)
    if nothing_explains(state):
        progress("no effect fits the residual: repeating the search with weights that include the model error")
        weights = noise_of(state.data, state.fitted, None, state.noise)[0]
        state.begin_again(with_turning_placements(state.data, state.base), weights)
        _seek(state, checkpoint, progress)
    return state.data, _completed(state, progress)


def _completed(state: SearchProgress, progress: Progress) -> Search:
    """Return the search with its last tests: does a simpler effect suffice next to a model error, and does one fit better than the input offsets?"""
    setting, data, history, refits, before = state.setting(progress), state.data, state.history, state.refits, state.before
    if state.holds_error:
        history, refits = simplest(setting, history, refits, state.names)
    swap = instead_of_offsets(setting, history[-1][1], state.names) if _most_effects(data) else None
    if swap is not None:
        refits = [*refits, *at_step(swap.records, len(history))]
        history = history if swap.fitted is None else [*history, (swap.name, swap.fitted)]
    if len(history) > 1 and "clouds" in data.measured:
        before = calibrated_pose(data, data.robot_as_declared, setting.noise, before)  # before and after on the same rows
    tables = state.first, state.table, refits
    final, noise = history[-1][1], setting.noise
    return Search(before, history, state.base, final, noise, state.n_effective, *tables, swap, state.outweighed)


def _seek(state: SearchProgress, checkpoint: Checkpoint, progress: Progress) -> None:
    """Add effects until none passes."""
    while not state.over:
        checkpoint.keep(state)
        progress(f"screening effects ({state.found} found so far)")
        _take_step(state, progress)
    checkpoint.keep(state)


def nothing_explains(state: SearchProgress) -> bool:
    """Return whether the residual of the last model is dominated by model error.

    It is if its mean square exceeds `lacks` times the noise, or if it exceeds noise and discretisation error together. The noise of the richest
    linear model then underrates the residual: it weighs only differences between states, and pose and input offsets are free in their common part.
    """
    data, fitted, noise = state.data, state.fitted, state.noise
    if state.holds_error or noise is None or "clouds" in data.measured:
        return False
    if mean_square(data.train, [jet.residual for jet in fitted.fit.jets], noise) > data.thresholds.lacks:
        return True
    return excess_of(data, state.base, fitted, fitted, noise, repeatability(data, fitted, noise)).is_large


def _most_effects(data: Data) -> int:
    return data.effort.effects if distinguishes_effects(data) else 0


def _take_step(state: SearchProgress, progress: Progress) -> None:
    """Propose effects by their linear scores, fit the best ones, and add the one with the most evidence on fitted and held-out data; if none passes, end."""
    _screen(state)
    state.over = state.over or state.found >= _most_effects(state.data)
    if state.over:
        return
    best, tried = select_next(state.setting(progress), state.fitted, state.table)
    state.note(tried)
    if best is None:
        _tell_parts_apart(state, progress)
    else:
        _add(state, best, progress)


def _screen(state: SearchProgress) -> None:
    """Refit the current model with the noise of its own residual, and score the effects that it lacks. If it has no equilibrium, its last effect is taken
    back, and the search ends. The fields of the previous model are reused as long as they predict no gain."""
    data, fitted, fields = state.data, state.fitted, state.fields
    if state.found and "clouds" in data.measured:
        assert state.noise is not None
        fields = None
        data, fitted = matched(data, fitted, state.noise)
    try:
        fields = _fields(data, fitted, fields, state.names)
        estimated, n_effective = noise_of(data, fitted, fields, state.noise)
        noise = state.noise if state.noise is not None and state.holds_error else estimated
        fitted = fitted_again(data, fitted, noise, known=fitted.fit.jets)
        fields, table = scored(data, fitted, fields, noise, state.names, n_effective)
    except FemsenseError as error:
        if not state.found:
            raise
        state.take_back(error)
        return
    state.data, state.noise, state.n_effective, state.fields, state.table = data, noise, n_effective, fields, table
    state.replace_last(fitted)
    if not state.found:
        state.base, state.first = fitted, table


def _add(state: SearchProgress, best: Refit, progress: Progress) -> None:
    """Add an effect to the model; drop or exchange earlier ones that it makes unnecessary; recompute the discretisation error if that has changed."""
    data, before, after = state.data, state.fitted, best.fitted
    recompute = moved_by(before, after) > discretisation_rms(data, before) and not same_mesh_error(before, after)
    history = [*state.history, (best.candidate.effect.name, after)]
    state.history, state.refits = swapped(state.setting(progress), history, state.refits)
    last = state.history[-1][1]
    state.earlier, state.fitted = data, last
    if recompute:
        state.data = with_errors_as_shown(with_mesh_errors(data, last, state.names), last)
    else:
        state.data = with_turning_placements(data, last)


def _tell_parts_apart(state: SearchProgress, progress: Progress) -> None:
    """Give accepted effects one value per cable where these have evidence, and continue; otherwise end the search."""
    fitted, records = with_all_parts(state.setting(progress), state.fitted)
    state.note(records)
    state.over = fitted is state.fitted
    state.replace_last(fitted)


def _fields(data: Data, fitted: FittedModel, before: Fields | None, names: Sequence[str]) -> Fields:
    """Return the fields of the previous model if they apply to the current one, else newly computed ones."""
    hints = None if before is None else before.beside(fitted.fit)
    return fields_of(data, fitted, names) if hints is None else hints


def scored(
    data: Data, fitted: FittedModel, fields: Fields, noise: Noise, names: Sequence[str], n_effective: float
) -> tuple[Fields, list[Candidate]]:
    """Return fields and scores; if reused fields predict a gain, the fields of the fitted model itself."""
    table = screen_model(data, fitted.fit, noise, fields, n_effective)
    if fields.model is fitted.fit.hypothesis or not hinted(table, data.thresholds, data.effort):
        return fields, table
    fields = fields_of(data, fitted, names)
    return fields, screen_model(data, fitted.fit, noise, fields, n_effective)


def distinguishes_effects(data: Data) -> bool:
    """Return whether these data can distinguish effects: a held-out state is not fitted, or enough distinct states are fitted."""
    fitted = {state_key(t.scene.recording, int(k)) for t in data.train for k in t.scene.frames}
    fresh = any(state_key(t.scene.recording, int(k)) not in fitted for t in data.held for k in t.scene.frames)
    return fresh or len(fitted) >= data.thresholds.states
