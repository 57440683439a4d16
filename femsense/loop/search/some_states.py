"""Recordings with many distinct states: the search runs in representative states, and its result must hold in all of them.

The representative states differ as much as possible. The models of the search are then fitted to all states, each effect must pass the
acceptance test there, and the search continues in all states from the last model that passes. No effect is accepted or reported that
was not fitted to all states.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.errors import FemsenseError
from femsense.loop.data.dataset import Data
from femsense.loop.data.representative_states import spread_states
from femsense.loop.fit.discretisation_error import with_mesh_errors_of
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.marker_placement import with_errors_as_shown, with_turning_placements
from femsense.loop.result.records import NAMED, RefitRecord
from femsense.loop.search.acceptance import acceptance_test
from femsense.loop.search.calibration import START, calibrated_pose, fitted_again, without_outliers_of
from femsense.loop.search.effect_fields import fields_of
from femsense.loop.search.screening import Candidate, screen_model
from femsense.loop.search.search_state import Progress, Search, SearchProgress, no_equilibrium
from femsense.model.drive import has_history

SPARED = 0.5
"""Largest share of representative states; beyond it the search runs in all states."""


def some_states(data: Data) -> Data | None:
    """Return the data in representative states of each recording, fitted and held out (`Effort.work`, at least FEWEST states). None if that saves
    little, if states depend on earlier ones, and for clouds, whose rows are already thinned out by frames."""
    if "clouds" in data.measured or has_history(data.robot):
        return None
    most = data.effort.work // len(data.robot.body.mesh.tets)
    if float(np.mean([spread_states(t, most)[1] for t in data.train])) > SPARED:
        return None
    return data.with_trials(lambda t: t.part(spread_states(t, most)[0]))


def in_all_states(every: Data, state: SearchProgress, search: Search, progress: Progress) -> SearchProgress:
    """Return the state of the search in all states: its models refitted to all of them, with the effects that pass there.

    Arguments:
        every: the data with all states, none of which is solved yet.
        state: the completed search in representative states.
        search: its record.
        progress: called with the name of each step.

    Raises:
        DataError: the model without effects has no equilibrium in some state.
    """
    progress(f"fitting to all states (effects found: {len(search.history) - state.given})")
    noise, given = search.noise, state.given
    fitted = [fitted_again(every, model, noise) for _, model in search.history[:given]]
    data = every
    while (fewer := without_outliers_of(data, fitted[-1])) is not data:
        data, fitted = fewer, [fitted_again(fewer, model, noise) for model in fitted]
    before = calibrated_pose(data, data.robot_as_declared, START)
    data = with_errors_as_shown(with_mesh_errors_of(data, state.data, fitted[-1]), fitted[-1])
    base = fitted_again(data, fitted[-1], noise, known=fitted[-1].fit.jets)
    history = [(name, model) for (name, _), model in zip(search.history, [*fitted[:-1], base])]
    refits = list(search.refits)
    for name, model in search.history[given:]:
        progress(f"fitting {name} to all states")
        if not _added(data, history, name, model, search, refits):
            break
    last, first = history[-1][1], list[Candidate]()
    n_effective = float(sum(t.groups.observations for t in data.train))
    if len(history) > given:  # otherwise the search screens all states next
        first = screen_model(data, base.fit, noise, fields_of(data, base, state.names), n_effective)
        data = with_turning_placements(data, last)
    models = replace(state, data=data, earlier=data, before=before, history=history, fitted=last, base=base, refits=refits)
    return replace(models, noise=noise, n_effective=n_effective, fields=None, first=first, table=first, over=False)


def _added(
    data: Data,
    history: list[tuple[str, FittedModel]],
    name: str,
    model: FittedModel,
    search: Search,
    refits: list[RefitRecord],
) -> bool:
    """Return whether an effect passes in all states; if so, append its model, fitted to them, to the history. Its record gets the verdict."""
    at = next((i for i, r in reversed(list(enumerate(refits))) if r.name == name and r.is_named), None)
    candidate = _candidate(search, name, model)
    if (
        at is None or candidate is None
    ):  # an effect that replaced another one has no record of its own: the search in all states tests it
        return False
    try:
        made = fitted_again(data, model, search.noise)
        record = acceptance_test(data, history[-1][1], candidate, made, refits[at], search.noise).record
    except FemsenseError as error:
        refits[at] = replace(refits[at], verdict=no_equilibrium(error))
        return False
    refits[at] = replace(record, verdict=NAMED) if record.passes else record
    if record.passes:
        history.append((name, made))
    return record.passes


def _candidate(search: Search, name: str, model: FittedModel) -> Candidate | None:
    """Return the candidate of an effect with its current parameters; None if the effect was not screened."""
    known = next((c for c in (*search.first, *search.last) if c.effect.name == name), None)
    if known is None:
        return None
    parameters = next((p for effect, _, p in model.fit.hypothesis.terms if effect.name == name), ())
    return replace(known, parameters=parameters)
