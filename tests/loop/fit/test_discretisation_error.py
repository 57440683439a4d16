"""The discretisation error against the finer mesh, and how it counts as noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import arm, record, sweeps

from femsense.core.work import counting
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import to_linear
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit.discretisation_error import (
    as_shown,
    make_finer,
    mesh_errors,
    on_its_clamp,
    same_mesh_error,
    with_mesh_errors,
    with_mesh_errors_of,
    without_mesh_error,
)
from femsense.loop.fit.fitted_model import FittedModel, fit_model, with_nuisance
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.thresholds import DEFAULTS
from femsense.model.effects import find_effect
from femsense.model.observation import Hypothesis
from femsense.model.recording import Recording
from femsense.model.remeshing import finer_mesh, robot_on_mesh


def with_error_of_the_mesh(
    noise: Noise, *, linear: bool = False, tried: tuple[str, ...] = ()
) -> tuple[Recording, FittedModel, Data]:
    """Return a recording of a small arm, its calibrated model, and the data with the discretisation error there."""
    inputs, labels = sweeps(each=1)
    robot = arm((4, 2, 2))
    robot = robot_on_mesh(robot, to_linear(robot.body.mesh)) if linear else robot
    recording, _ = record(inputs, labels=labels, truth=robot)
    data = prepare(robot, [recording], [])
    hypothesis, prior = with_nuisance(data)
    fitted = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    return recording, fitted, with_mesh_errors(data, fitted, tried)


def test_a_linear_mesh_has_no_error_where_it_is_asked_about_as_an_effect():
    noise = Noise({"white": 1e-4}, "")
    asked = with_error_of_the_mesh(noise, linear=True, tried=("cable_friction", "discretisation"))[2]
    assert mesh_errors(asked) == [] and "compared with quadratic ones" in asked.mesh_note  # and it is said why
    other = with_error_of_the_mesh(noise, linear=True, tried=("cable_friction",))[2]
    assert mesh_errors(other) and other.mesh_note == ""


def test_what_is_made_of_the_finer_mesh_beforehand_serves_the_fitted_robot():
    robot = arm((4, 2, 2))
    make_finer(robot, [])
    ready = robot_on_mesh(robot, finer_mesh(robot.body.mesh, None, 1)).body.free_map
    assert ready.pattern.analyses and ready.laplacian
    softer = robot.with_body(robot.body.with_stiffness_scale(0.9))
    assert robot_on_mesh(softer, finer_mesh(robot.body.mesh, None, 1)).body.free_map is ready


@pytest.mark.parametrize("linear, finer", [(False, (None, 1)), (True, ("tet10", 0))], ids=["tet10", "tet4"])
def test_the_error_of_the_mesh_is_what_the_finer_mesh_adds(linear: bool, finer: tuple[str | None, int]):
    recording, fitted, data = with_error_of_the_mesh(Noise({"white": 1e-4}, ""), linear=linear)
    trial, error = data.train[0], mesh_errors(data)[0]
    fitted = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    fine = robot_on_mesh(fitted, finer_mesh(fitted.body.mesh, *finer))
    k = int(trial.scene.frames[2])
    tension = dict(zip(fitted.body.cable_names, recording.inputs[k] + fitted.actuation.tension_offset))
    tension = {name: max(t, 0.0) for name, t in tension.items()}
    places = [r.markers.positions(solve_equilibrium(r.body, tension=tension).positions) for r in (fitted, fine)]
    wanted = (places[1] - places[0])[trial.scene.marker[trial.scene.frame == k]]
    np.testing.assert_allclose(error[trial.scene.frame == k], wanted, atol=0.15 * np.abs(wanted).max())
    assert np.abs(wanted).max() > 1e-4
    by_sweep, turned = trial.mesh_error[:, :, 1:-9], trial.mesh_error[:, :, -9:]
    np.testing.assert_array_equal(trial.error_by_sweep, trial.mesh_error[:, :, :-9])  # what the noise is estimated beside
    np.testing.assert_allclose(by_sweep.sum(axis=2), DEFAULTS.mesh_varies * error)
    assert (by_sweep != 0).any(axis=1).sum(axis=1).max() == 1  # each row has the field of its own sweep
    matrix = np.random.default_rng(0).normal(0.0, 1.0, (3, 3))
    np.testing.assert_allclose(turned @ matrix.ravel(), DEFAULTS.mesh_turns * error @ matrix.T, atol=1e-12)


def test_springs_of_a_clamp_are_shared_out_over_the_finer_face():
    soft = arm((4, 2, 2))
    soft = soft.with_body(soft.body.with_clamp_stiffness(40.0))
    finer = robot_on_mesh(soft.with_body(soft.body.with_clamp_stiffness()), finer_mesh(soft.body.mesh, None, 1))
    body = on_its_clamp(soft, finer).body
    moments = [b.clamp_stiffness * ((b.mesh.nodes[b.clamp_nodes] - soft.body.clamp_center) ** 2).sum() for b in (soft.body, body)]
    assert len(body.clamp_nodes) == len(body.clamped) > 2 * len(soft.body.clamp_nodes)
    assert moments[1] == pytest.approx(moments[0])
    recording, _ = record(sweeps(each=1)[0], labels=sweeps(each=1)[1], truth=soft)
    noise, data = Noise({"white": 1e-4}, ""), prepare(soft, [recording], [])
    fitted = fit_model(data, Hypothesis(data.robot), Prior(np.zeros(0), np.zeros(0)), noise, np.zeros(0))
    trial, error = data.train[0], mesh_errors(with_mesh_errors(data, fitted, []))[0]
    firm = mesh_errors(with_error_of_the_mesh(noise)[2])[0]
    nearest = np.isin(trial.scene.marker, np.unique(trial.scene.marker)[:4])  # beside the clamp, which does not give alike there
    assert np.abs(error[nearest]).max() > 3.0 * np.abs(firm[nearest]).max()


@pytest.mark.parametrize(
    "name, size, alike",
    [
        ("cable_friction", 0.01, True),
        ("cable_friction", 0.3, True),
        ("depth_scale", 1.03, True),
        ("gravity", 1.0, False),
        ("poisson", 0.4, False),
        ("base_compliance", 1e5, False),
    ],
)
def test_the_mesh_errs_in_another_way_where_the_body_is_another(name: str, size: float, alike: bool):
    robot = arm((4, 1, 1))
    recording, _ = record(sweeps(each=1)[0], labels=sweeps(each=1)[1], truth=robot)
    noise, data = Noise({"white": 1e-4}, ""), prepare(robot, [recording], [])
    hypothesis, prior = with_nuisance(data)
    before = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    effect = find_effect(name)
    own = effect.parameters(robot, "tension")
    coordinates = np.concatenate([before.fit.coordinates, [p.coordinate(size) for p in own]])
    wider = Prior(np.append(prior.mean, np.zeros(len(own))), np.append(prior.std, np.full(len(own), np.inf)))
    after = fit_model(
        data, Hypothesis(data.robot, (*hypothesis.terms, (effect, {}, own))), wider, noise, coordinates, max_iterations=0
    )
    assert same_mesh_error(before, after) == alike


def test_one_share_of_the_mesh_error_in_all_sweeps_is_likelier_than_another_in_each():
    noise = Noise({"white": 1e-5}, "")
    data = with_error_of_the_mesh(noise)[2]
    trial, error = data.train[0], mesh_errors(data)[0]
    factor = noise.whitener(trial.groups, trial.mesh_error)
    sign = np.where(trial.groups.sweep % 2, 1.0, -1.0)[:, None]
    costs = [float((whiten(factor, r) ** 2).sum()) for r in (DEFAULTS.mesh_share * error, DEFAULTS.mesh_share * sign * error)]
    assert costs[0] < 1.0 + 1e-6  # one standard deviation
    assert costs[1] > 5 * costs[0]
    alike = without_mesh_error(trial, 0.5 * error, noise)
    assert np.linalg.norm(alike) < 0.05 * np.linalg.norm(0.5 * error)


def test_the_mesh_error_may_turn_a_little_in_all_sweeps_whatever_the_axes():
    noise = Noise({"white": 1e-5}, "")
    data = with_error_of_the_mesh(noise)[2]
    trial, error = data.train[0], mesh_errors(data)[0]
    factor = noise.whitener(trial.groups, trial.mesh_error)
    for axis in np.vstack([np.eye(3), [0.6, 0.0, 0.8]]):
        turned = np.cross(axis, error)  # by a radian, √2 entries of one
        assert float((whiten(factor, DEFAULTS.mesh_turns * turned) ** 2).sum()) < 2.0 + 1e-6
        assert np.linalg.norm(without_mesh_error(trial, 0.1 * turned, noise)) < 0.05 * np.linalg.norm(0.1 * turned)


def test_states_that_two_recordings_share_are_continued_on_the_finer_mesh_once():
    robot = arm((4, 1, 1))
    recording, _ = record(sweeps(each=1)[0], labels=sweeps(each=1)[1], truth=robot)
    noise, data = Noise({"white": 1e-4}, ""), prepare(robot, [recording], [recording])
    fitted = fit_model(data, Hypothesis(data.robot), Prior(np.zeros(0), np.zeros(0)), noise, np.zeros(0))
    with counting() as work:
        data = with_mesh_errors(data, fitted, [])
    assert work.refined == len(np.unique(recording.inputs, axis=0))
    np.testing.assert_allclose(data.train[0].mesh_error[:, :, 0], data.held[0].mesh_error[:, :, 0], atol=1e-9)


def test_errors_of_some_states_serve_in_all_of_them():
    noise, frames = Noise({"white": 1e-4}, ""), np.array([0, 1, 3, 5, 6, 7])
    _, fitted, data = with_error_of_the_mesh(noise)
    whole = mesh_errors(data)[0]
    some = replace(data, train=[data.train[0].part(data.train[0].scene.frames[frames % len(data.train[0].scene.frames)])])
    bare = replace(data, train=[replace(data.train[0], mesh_error=None, mesh_moves=None)])
    with counting() as work:
        handed_on = with_mesh_errors_of(bare, some, fitted)
    assert work.refined == 0
    np.testing.assert_allclose(mesh_errors(handed_on)[0], whole, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.7])
def test_the_error_of_the_mesh_counts_by_what_the_data_show_of_it_where_that_is_asked(share: float):
    noise = Noise({"white": 1e-4}, "")
    _, fitted, data = with_error_of_the_mesh(noise)
    error = mesh_errors(data)[0]
    jet = fitted.fit.jets[0]
    shown = replace(fitted, fit=replace(fitted.fit, jets=[replace(jet, residual=share * error)]))
    assert as_shown(data, shown) is data
    scaled = as_shown(replace(data, mesh_as_shown=True), shown)
    expected = share / DEFAULTS.mesh_share
    np.testing.assert_allclose(scaled.train[0].mesh_error, expected * data.train[0].mesh_error, atol=2e-3 * np.abs(error).max())
