"""Where many states do not repeat, effects are sought in some of them, and must hold in all."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.io.checkpoint import Checkpoint
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.representative_states import FEWEST
from femsense.loop.search.calibration import calibrated, with_discretisation_error
from femsense.loop.search.search import new_search, search_effects
from femsense.loop.search.search_state import Search, SearchProgress
from femsense.loop.search.some_states import in_all_states, some_states

GAIN = ({"name": "cable_gain", "scale": {"up": 0.8}},)


@cache
def measured(hidden: bool) -> Data:
    """Return data whose states do not repeat, but for those at rest."""
    inputs, labels = sweeps(3.0, each=5)
    inputs = inputs * np.random.default_rng(3).uniform(0.6, 1.0, (len(inputs), 1))
    truth = arm((5, 2, 2), law="neo_hookean")
    recording, _ = record(inputs, labels=labels, effects=GAIN if hidden else (), truth=truth)
    return prepare(arm((4, 1, 1)), [recording], [])


@cache
def sought() -> tuple[Data, SearchProgress, Search]:
    """Return some states of a recording with a gain, and the search in them at its end."""
    every = measured(True)
    some = some_states(replace(every, effort=replace(every.effort, work=0)))
    assert some is not None
    data, before, start = calibrated(some, lambda text: None)
    data = with_discretisation_error(data, start[-1][1], ["cable_gain"], lambda text: None)
    course = new_search((data, before, start), ["cable_gain"], [], quadratic=False)
    return some, course, search_effects(course, Checkpoint(None), lambda text: None)[1]


def test_some_states_are_fewest_that_differ_and_none_where_all_are_little_work() -> None:
    every, (some, _, _) = measured(True), sought()
    for part, whole in zip((*some.train, *some.held), (*every.train, *every.held)):
        inputs = whole.scene.recording.inputs
        assert set(part.scene.frames) <= set(whole.scene.frames)
        assert len(np.unique(inputs[part.scene.frames], axis=0)) == min(
            FEWEST, len(np.unique(inputs[whole.scene.frames], axis=0))
        )
    assert some_states(every) is None


def test_what_is_found_in_some_states_is_fitted_and_judged_in_all() -> None:
    every, (_, course, search) = measured(True), sought()
    assert [name for name, _ in search.history[course.given :]] == ["cable_gain"]
    whole = in_all_states(every, course, search, lambda text: None)
    assert whole.found == 1 and len(whole.fitted.fit.jets[0].residual) == len(every.train[0].scene.frame)
    assert {len(c.columns) for c in whole.first} == {
        len(whole.base.fit.fit.residual)
    }  # what calibration absorbs is told by all states
    named = [next(r for r in refits if r.is_named) for refits in (search.refits, whole.refits)]
    assert named[1].dchi2 > 1.2 * named[0].dchi2
    gain = whole.fitted.fit.hypothesis.entries(whole.fitted.fit.coordinates)[-1]["scale"]
    assert gain == pytest.approx({"up": 0.8}, abs=0.03)


def test_what_does_not_pass_in_all_states_is_taken_back() -> None:
    _, course, search = sought()
    whole = in_all_states(measured(False), course, search, lambda text: None)
    assert whole.found == 0 and not any(r.is_named for r in whole.refits) and whole.fitted is whole.base
    last = search_effects(whole, Checkpoint(None), lambda text: None)[1]
    assert len(last.history) == course.given
