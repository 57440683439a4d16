"""What screening predicts of effects, against what they do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm
from fitted_arm import fitted_arm

from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import to_linear
from femsense.loop.data.dataset import Data
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.repeatability import repeatability
from femsense.loop.search.effect_fields import effect_fields
from femsense.loop.search.screening import noise_of, penalty
from femsense.model.effects import FORMS, find_effect
from femsense.model.observation import marker_residual, placements
from femsense.model.remeshing import robot_on_mesh
from femsense.model.robot import Robot


def whole_change(data: Data, fitted: FittedModel, other: Robot) -> np.ndarray:
    """Return by how much another robot changes the residual, each state solved for itself."""
    trial, jet = data.train[0], fitted.fit.jets[0]
    fixed = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    poses, _ = trial.place(fitted.fit.fit.theta[: fitted.fit.own], data.robot.marker_points.mean(axis=0))
    ties, model = other.tie_markers(placements(fixed, trial.scene, poses)), {}
    for k in jet.states:
        inputs = trial.scene.recording.inputs[k] + fixed.actuation.tension_offset
        tension = dict(zip(other.body.cable_names, np.maximum(fixed.actuation.gain * inputs, 0.0)))
        model[k] = ties.positions(solve_equilibrium(other.body, tension=tension).positions)
    return np.asarray(marker_residual(other, trial.scene, poses, model) - jet.residual)


@pytest.mark.parametrize("form", [f for f in FORMS if f.name == "hyperelastic"], ids=["neo_hookean", "gent"])
def test_another_law_is_screened_by_what_it_would_do(form) -> None:
    data, fitted = fitted_arm(arm((5, 2, 2)))
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    (seed,) = form.seeds(robot)
    parameters = form.parameters(robot, "tension")
    fields = effect_fields(fitted.fit, data.train, [(form, seed, parameters)])
    entry = {**seed, "jm": 1 / 0.3} if parameters else seed
    whole = whole_change(data, fitted, form.apply(robot, entry))
    assert np.linalg.norm(fields.raw[0][:, :, 0] - whole) < 1e-3 * np.linalg.norm(whole)
    assert np.abs(whole).max() > 1e-4


def test_another_mesh_is_screened_by_what_it_would_do() -> None:
    declared = arm((5, 2, 2))
    linear = to_linear(declared.body.mesh)
    effect = find_effect("discretisation")
    data, fitted = fitted_arm(robot_on_mesh(declared, linear), 1.0)
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    seed = {"element": "tet10"}
    fields = effect_fields(fitted.fit, data.train, [(effect, seed, ())])
    whole = whole_change(data, fitted, effect.apply(robot, seed))
    assert np.linalg.norm(fields.raw[0][:, :, 0] - whole) < 1e-3 * np.linalg.norm(whole)
    assert np.abs(whole).max() > 1e-3


def test_the_numbers_of_a_seed_cost_as_much_as_parameters():
    place = {"center_m": [0.0, 0.0, 0.0], "radius_m": 0.1}
    assert penalty(1, place, 1, 10, 1000.0) == pytest.approx(5 * np.log(1000.0) + 2 * np.log(10))
    assert penalty(0, {"law": "neo_hookean"}, 1, 10, 1000.0) == pytest.approx(2 * np.log(10))


def test_only_the_large_fields_of_the_meshs_error_take_freedom_from_the_noise() -> None:
    data, fitted = fitted_arm(arm((5, 2, 2)))
    (form,) = [f for f in FORMS if f.name == "hyperelastic"][:1]
    (seed,) = form.seeds(data.robot)
    fields = effect_fields(fitted.fit, data.train, [(form, seed, form.parameters(data.robot, "tension"))])
    (trial,) = data.train
    size, large = fitted.fit.jets[0].residual.shape, 1 + len(np.unique(trial.groups.sweep))
    errors = 1e-4 * np.random.default_rng(3).standard_normal((*size, large + 20))
    few, many = (replace(data, train=[replace(trial, mesh_error=e)]) for e in (errors[:, :, :large], errors))
    (noise, rows), (same, left) = (noise_of(d, fitted, fields) for d in (few, many))
    assert noise.std == same.std and rows == left


def test_where_nothing_explains_what_is_left_it_is_noise_to_the_fits_and_to_nothing_else() -> None:
    data, fitted = fitted_arm(arm((5, 2, 2)))
    (form,) = [f for f in FORMS if f.name == "hyperelastic"][:1]
    (seed,) = form.seeds(data.robot)
    fields = effect_fields(fitted.fit, data.train, [(form, seed, form.parameters(data.robot, "tension"))])
    off = fields.raw[0][:, :, 0]
    jets = [replace(fitted.fit.jets[0], residual=fitted.fit.jets[0].residual + 2e-2 * off / np.abs(off).max())]
    far = replace(fitted, fit=replace(fitted.fit, jets=jets))
    noise, _ = noise_of(data, far, fields)
    whole, _ = noise_of(data, far, None, noise)
    size = [np.sqrt(sum(v**2 for n, v in n_.std.items() if n != "marker")) for n_ in (noise, whole)]
    assert size[1] > 2.0 * size[0] and whole.std["marker"] <= data.placement_std
    assert whole.assumed == noise.std["white"] and repeatability(data, far, whole).std == repeatability(data, far, noise).std
    assert noise_of(data, far, None, whole)[0].assumed == whole.assumed
