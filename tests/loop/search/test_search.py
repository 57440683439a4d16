"""When a search asks again with weights that hold the error of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import fit_model, mean_square, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.loop.result.records import NAMED, PASSES, RefitRecord
from femsense.loop.search.search import nothing_explains
from femsense.loop.search.search_state import Search, SearchProgress
from femsense.loop.thresholds import DEFAULTS
from femsense.loop.verdict.confounding import confounded
from femsense.loop.verdict.summary import REMOVED, tried_effects


@pytest.fixture(scope="module")
def off():
    """Return data whose markers are 4 mm from what any effect explains, in a way that differs from state to state, and the fit to them."""
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)))
    wave = 4e-3 * np.sin(1.7 * recording.marker_frame + recording.marker_index)
    moved = recording.marker_xyz + wave[:, None] * np.array([0.0, 0.6, 0.8])
    data = prepare(arm((4, 1, 1)), [replace(recording, marker_xyz=moved, marker_noise_m=1e-4)], [])
    hypothesis, prior = with_nuisance(data)
    return data, fit_model(data, hypothesis, prior, Noise({"white": 1e-4}, ""), np.zeros(len(prior.mean)))


def course(data, fitted, noise: Noise) -> SearchProgress:
    return SearchProgress(data, data, fitted, [("", fitted)], 1, fitted, fitted, [], False, [], noise=noise, over=True)


def test_weights_as_large_as_what_is_left_do_not_hide_what_the_model_leaves(off):
    data, fitted = off
    swallows = Noise({"white": 4e-3}, "")  # so that the residual looks like noise to the weights
    assert mean_square(data.train, [jet.residual for jet in fitted.fit.jets], swallows) < data.thresholds.lacks
    assert nothing_explains(course(data, fitted, swallows))


def test_what_is_left_at_the_size_of_what_repeats_is_not_asked_again(off):
    data, fitted = off
    trials = [replace(t, scene=replace(t.scene, recording=replace(t.scene.recording, marker_noise_m=8e-3))) for t in data.train]
    calm = replace(data, train=trials)
    assert not nothing_explains(course(calm, fitted, Noise({"white": 5e-3}, "")))


def test_weights_that_hold_the_error_are_not_asked_for_twice(off):
    data, fitted = off
    assert not nothing_explains(replace(course(data, fitted, Noise({"white": 1e-4}, "")), holds_error=True))


def test_evidence_by_weights_that_were_given_up_is_compared_with_none_by_those_of_now(off):
    data, fitted = off
    weights = Noise({"white": 1e-4}, "", assumed=1e-4)
    asked = course(data, fitted, weights)
    asked.refits = [RefitRecord("payload", {}, NAMED, step=1, dbic=300.0), RefitRecord("density", {}, PASSES, step=1, dbic=240.0)]
    asked.begin_again(data, weights)
    asked.refits += [
        RefitRecord("payload", {}, NAMED, step=1, dbic=90.0),
        RefitRecord("density", {}, "too little", step=1, dbic=5.0),
    ]
    search = Search(fitted, asked.history, fitted, fitted, weights, 100.0, [], [], asked.refits, None, asked.outweighed)
    assert not confounded(search, ["payload"], DEFAULTS)  # by the weights of now, 85 lie between the two
    every = tried_effects([], [], [*search.outweighed, *search.refits], ["payload"], DEFAULTS)
    assert {c.name: (c.verdict, len(c.refits)) for c in every} == {"payload": (NAMED, 2), "density": ("too little", 2)}
    _, removed = tried_effects([], [], [*search.outweighed, *search.refits], [], DEFAULTS)
    assert (removed.name, removed.verdict) == ("payload", REMOVED)
