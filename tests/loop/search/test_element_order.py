"""Whether the data need quadratic elements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from arm import arm, record, sweeps

from femsense.fem.mesh import to_linear
from femsense.loop.data.dataset import prepare
from femsense.loop.fit.fitted_model import fit_model, with_nuisance
from femsense.loop.fit.noise_components import Noise
from femsense.loop.improve import improve
from femsense.loop.search.element_order import need_quadratic, with_quadratic
from femsense.loop.search.search_state import Search
from femsense.model.remeshing import robot_on_mesh


def test_a_linear_mesh_is_asked_for_quadratic_elements_whatever_else_makes_up_for_it() -> None:
    """Calibration makes the locking arm so soft that quadratic elements of that softness fold: screening cannot see them."""
    inputs, labels = sweeps(2.0)
    declared = arm((7, 2, 2), law="neo_hookean")
    recording, _ = record(inputs, labels=labels, truth=declared)  # a finer truth is softer by 1 %, which is named beside it
    linear = robot_on_mesh(declared, to_linear(declared.body.mesh))
    found = improve(linear, [recording], effects=["discretisation", "poisson", "cable_gain"])
    assert [e.name for e in found.effects] == ["discretisation"]
    assert found.after.validation_rms_m < 0.2 * found.before.validation_rms_m
    row = next(c for c in found.candidates if c.name == "discretisation")
    assert row.verdict == "named" and row.dbic > 10.0
    assert {str(r.seed) for r in row.refits} == {"{'element': 'tet10'}", "{'refinements': 1}"}


def test_linear_elements_stay_where_the_data_do_not_miss_quadratic_ones() -> None:
    inputs, labels = sweeps(0.005)  # it hardly moves
    declared = arm((7, 2, 2))
    declared = declared.with_body(declared.body.with_gravity([0.0, 0.0, 0.0]))
    recording, _ = record(inputs, labels=labels, truth=declared)
    linear = robot_on_mesh(declared, to_linear(declared.body.mesh))
    found = improve(linear, [recording], effects=["discretisation", "cable_gain"])
    assert found.verdict == "none" and not found.effects
    row = next(c for c in found.candidates if c.name == "discretisation")
    assert row.refits[0].verdict.startswith("too little evidence")


def test_what_is_asked_beside_the_whole_model_is_compared_with_nothing_that_was_asked_before_it() -> None:
    inputs, labels = sweeps(each=1)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)))
    linear = robot_on_mesh(arm((2, 1, 1)), to_linear(arm((2, 1, 1)).body.mesh))
    data = prepare(with_quadratic(linear), [recording], [])
    hypothesis, prior = with_nuisance(data)
    noise = Noise({"white": 1e-3}, "")
    fitted = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    history = [("", fitted), ("cable_gain", fitted), ("creep", fitted)]
    search = Search(fitted, history, fitted, fitted, noise, 100.0, [], [], [], None)
    _, (record_of_mesh, *_) = need_quadratic(replace(data, declared=linear), search, ["discretisation"])
    assert record_of_mesh.step == 3  # the first effect was tried on model 1, the second on model 2
