"""Parts of the loop against closed forms and slow second ways: likelihood, whitening, left-out sweeps, the mesh's error, structure."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm, record, sweeps

from femsense.core.errors import DataError, FemsenseError
from femsense.fem.assembly import internal, reduced_matrix
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.linalg import refinement
from femsense.fem.mesh import Embedding, embed_points, to_linear
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.trial import Groups
from femsense.loop.fit.cross_validation import sweeps_predicted
from femsense.loop.fit.discretisation_error import (
    SHARE,
    TURNS,
    VARIES,
    _on_its_clamp,
    errs_alike,
    make_finer,
    mesh_errors,
    with_mesh_errors,
    without_mesh_error,
)
from femsense.loop.fit.fitted_model import FittedModel, fit_model, keeping, with_nuisance, with_seeds_still
from femsense.loop.fit.joint_fit import Prior
from femsense.loop.fit.noise_components import Noise, _Likelihood, whiten
from femsense.loop.improve import improve
from femsense.loop.search.acceptance import plainly_worse
from femsense.loop.search.calibration import as_far_as_held_out_states_converge
from femsense.loop.search.effect_fields import parts_of
from femsense.loop.search.screening import penalty
from femsense.loop.verdict.residual_diagnostics import structure_tests
from femsense.loop.verdict.verdict import excess_of, lacks_much
from femsense.model import finer_mesh as finer_path
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import apply_effects, find_effect
from femsense.model.finer_mesh import finer_state
from femsense.model.observation import Hypothesis, evaluate_scene, make_scene
from femsense.model.recording import Recording, make_recording
from femsense.model.remeshing import finer_mesh, robot_on_mesh
from femsense.model.variants import solve_frame

RNG = np.random.default_rng(11)


def some_groups(frames: int = 12, markers: int = 5) -> Groups:
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    return Groups(marker, frame, frame // 4, np.arange(frames * markers))


def test_the_gradient_of_the_likelihood_is_its_difference():
    groups = some_groups()
    k = len(groups.marker)
    likelihood = _Likelihood(
        ["white", "frame", "marker", "sweep"], [RNG.normal(size=(k, 3))], [RNG.normal(size=(k, 3, 4))], [groups]
    )
    at = np.log([1.0, 0.6, 0.4, 0.3])
    gradient = likelihood(at)[1]
    for i, step in enumerate(1e-5 * np.eye(4)):
        assert gradient[i] == pytest.approx((likelihood(at + step)[0] - likelihood(at - step)[0]) / 2e-5, rel=1e-5)


def test_whitening_takes_fields_that_count_as_noise():
    groups = some_groups(4, 3)
    noise = Noise({"white": 0.5, "frame": 0.3}, "")
    fields = RNG.normal(size=(12, 3, 2))
    W = whiten(noise.whitener(groups, fields), np.eye(36).reshape(12, 3, 36))
    E = fields.reshape(36, 2)
    sigma = np.kron(noise.covariance(groups), np.eye(3)) + E @ E.T
    np.testing.assert_allclose(W.T @ W, np.linalg.inv(sigma), rtol=1e-9, atol=1e-9)


def test_whitening_is_kept_for_the_same_noise_and_groups_alone():
    groups, other = some_groups(4, 3), some_groups(3, 4)
    noise, louder = Noise({"white": 0.5, "frame": 0.3}, ""), Noise({"white": 0.5, "frame": 0.6}, "")
    for n, g in ((noise, groups), (louder, groups), (noise, other), (noise, groups)):
        lower = n.whitener(g).lower
        np.testing.assert_allclose(lower @ lower.T, n.covariance(g), atol=1e-12)
        assert n.whitener(g).lower is lower and not lower.flags.writeable


def linear_fit(J: np.ndarray, r: np.ndarray, rest: int = 0) -> SimpleNamespace:
    """Return what `sweeps_predicted` asks of a fit, at the optimum of a linear problem."""
    at_optimum = r - J @ np.linalg.lstsq(J, r, rcond=None)[0]
    return SimpleNamespace(
        fit=SimpleNamespace(jacobian=J, residual=at_optimum),
        jets=[SimpleNamespace(rest=np.zeros((rest, 3)), residual=np.zeros((0, 3)))],
    )


def test_left_out_sweeps_are_predicted_as_by_fits_without_them():
    groups = some_groups()
    n = 3 * len(groups.marker)
    trial = SimpleNamespace(groups=groups, poses=(), together=False)
    J, r = RNG.normal(size=(n, 6)), RNG.normal(size=n)
    small, large = linear_fit(J[:, :3], r), linear_fit(J, r)
    got, spread = sweeps_predicted([trial], small, large)

    def density(columns: np.ndarray, rows: np.ndarray) -> float:
        others = np.setdiff1d(np.arange(n), rows)
        theta = np.linalg.lstsq(columns[others], r[others], rcond=None)[0]
        cov = np.eye(len(rows)) + columns[rows] @ np.linalg.inv(columns[others].T @ columns[others]) @ columns[rows].T
        error = r[rows] - columns[rows] @ theta
        return float(-error @ np.linalg.solve(cov, error) - np.linalg.slogdet(cov)[1])

    sweep = np.repeat(groups.sweep, 3)
    gains = [density(J, np.flatnonzero(sweep == s)) - density(J[:, :3], np.flatnonzero(sweep == s)) for s in range(3)]
    assert got == pytest.approx(sum(gains), rel=1e-8)
    assert spread == pytest.approx(np.sqrt(3) * np.std(gains, ddof=1), rel=1e-8)


def test_a_direction_that_one_sweep_alone_decides_says_nothing_where_that_is_left_out():
    groups = some_groups()
    n = 3 * len(groups.marker)
    trial = SimpleNamespace(groups=groups, poses=(), together=False)
    J, r = RNG.normal(size=(n, 6)), RNG.normal(size=n)
    only = np.where(np.repeat(groups.sweep, 3) == 1, RNG.normal(size=n), 0.0)
    J = np.column_stack([only, J])
    small, large = linear_fit(J[:, :4], r), linear_fit(J, r)
    large.fit.residual = large.fit.residual + 1e-3 * only  # a fit ends near its optimum
    assert abs(sweeps_predicted([trial], small, large)[0]) < 100.0


def leaving(train: float, held: float) -> SimpleNamespace:
    """Return what the verdict asks of a stage that leaves residuals of such sizes [m] at 5 markers in 12 frames."""
    values = [size * np.sign(RNG.normal(size=(60, 3))) for size in (train, held)]
    return SimpleNamespace(fit=SimpleNamespace(jets=[SimpleNamespace(residual=values[0])]), held_residuals=[values[1]])


def test_a_verdict_asks_what_the_robot_that_is_handed_back_leaves():
    noise = Noise({"white": 1e-4}, "")
    trial = SimpleNamespace(groups=some_groups(), mesh_error=None)
    data = SimpleNamespace(train=[trial], held=[trial])
    before, right = leaving(1e-3, 1e-3), leaving(1.2e-4, 1.2e-4)
    assert excess_of(data, before, right, right, noise).explained > 0.99
    assert excess_of(data, before, right, leaving(1e-3, 7e-4), noise).explained == pytest.approx((1.0 - 0.49) / 0.99)
    assert excess_of(data, before, leaving(7e-4, 1e-4), right, noise).explained == pytest.approx((1.0 - 0.49) / 0.99)
    assert not lacks_much(data, right, right, noise)
    assert not lacks_much(data, before, before, noise)  # whatever calibration may move leaves as much
    assert lacks_much(data, leaving(1.2e-4, 3e-4), right, noise) and lacks_much(data, leaving(3e-4, 1.2e-4), right, noise)


def test_the_plain_error_may_grow_where_fitted_if_that_on_held_out_data_falls():
    def errors(train: float, held: float) -> SimpleNamespace:
        return SimpleNamespace(fit=SimpleNamespace(rms=train), held_rms=held)

    before = errors(1.0, 1.0)
    assert plainly_worse(before, errors(1.3, 1.1))
    assert not plainly_worse(before, errors(1.3, 0.9)) and not plainly_worse(before, errors(1.2, 1.1))


def with_error_of_the_mesh(
    noise: Noise, *, linear: bool = False, tried: tuple[str, ...] = ()
) -> tuple[Recording, FittedModel, Data]:
    """Return a recording of a small arm, its calibrated stage, and the data with what the mesh costs there."""
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
    assert mesh_errors(with_error_of_the_mesh(noise, linear=True, tried=("cable_friction", "discretisation"))[2]) == []
    assert mesh_errors(with_error_of_the_mesh(noise, linear=True, tried=("cable_friction",))[2])


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
    np.testing.assert_allclose(by_sweep.sum(axis=2), VARIES * error)
    assert (by_sweep != 0).any(axis=1).sum(axis=1).max() == 1  # each row has the field of its own sweep
    matrix = np.random.default_rng(0).normal(0.0, 1.0, (3, 3))
    np.testing.assert_allclose(turned @ matrix.ravel(), TURNS * error @ matrix.T, atol=1e-12)


def test_springs_of_a_clamp_are_shared_out_over_the_finer_face():
    soft = arm((4, 2, 2))
    soft = soft.with_body(soft.body.with_clamp_stiffness(40.0))
    finer = robot_on_mesh(soft.with_body(soft.body.with_clamp_stiffness()), finer_mesh(soft.body.mesh, None, 1))
    body = _on_its_clamp(soft, finer).body
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


def test_the_middles_of_clamped_edges_follow_the_ends_that_have_springs():
    body = arm((4, 2, 2)).body
    corners = np.intersect1d(body.clamped, body.mesh.tets[:, :4])
    body = replace(body, clamp_nodes=corners)
    nearly = solve_equilibrium(body.with_clamp_stiffness(1e6), tension={NAMES[0]: 1.0})
    firm = solve_equilibrium(body, tension={NAMES[0]: 1.0})
    assert np.abs(nearly.positions - firm.positions).max() < 3e-3 * np.abs(firm.positions - body.mesh.nodes).max()
    soft, random = body.with_clamp_stiffness(40.0), np.random.default_rng(0)
    x = body.mesh.nodes + 1e-4 * random.normal(size=body.mesh.nodes.shape)
    step = 1e-8 * random.normal(size=x.shape)
    here, sides = internal(soft, x), [internal(soft, x + sign * step) for sign in (1.0, -1.0)]
    assert (here.forces * step).sum() == pytest.approx((sides[0].energy - sides[1].energy) / 2, rel=1e-5)
    change = ((sides[0].forces - sides[1].forces) / 2).reshape(-1)[soft.free_map.dofs]
    K = reduced_matrix(soft, here.blocks)
    np.testing.assert_allclose(K @ step.reshape(-1)[soft.free_map.dofs], change, atol=1e-6 * np.abs(change).max())


@pytest.mark.parametrize(
    "name, size, alike",
    [
        ("cable_friction", 0.01, True),
        ("cable_friction", 0.3, False),
        ("depth_scale", 1.03, True),
        ("gravity", 1.0, False),
        ("poisson", 0.4, False),
        ("base_compliance", 1e5, False),
    ],
)
def test_the_mesh_errs_in_another_way_where_the_body_is_another_or_goes_elsewhere(name: str, size: float, alike: bool):
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
    assert errs_alike(before, after) == alike


def on_both_meshes(
    inputs: list[float], actuation: str = "tension", effects: Sequence[dict[str, Any]] = ()
) -> tuple[DrivenRobot, DrivenRobot, int, Equilibrium, Embedding]:
    """Return what `finer_state` is asked with: an arm whose cables are driven so."""
    robot = apply_effects(arm((4, 2, 2)), effects)
    fine = robot_on_mesh(robot, finer_mesh(robot.body.mesh, None, 1))
    recording = make_recording(time_s=[0.0], cable_names=NAMES, inputs=[inputs], actuation=actuation)
    driven, fine_driven = (DrivenRobot(r, drive_of(r, recording)) for r in (robot, fine))
    return driven, fine_driven, 0, solve_frame(driven, 0), embed_points(robot.body.mesh, fine.body.mesh.nodes)


def beyond(asked: tuple[DrivenRobot, DrivenRobot, int, Equilibrium, Embedding], x: np.ndarray | None) -> np.ndarray:
    """Return how far nodes of the finer mesh lie from the state of the declared one [m]."""
    assert x is not None
    return x - asked[4].positions(asked[3].positions)


def test_a_finer_state_that_runs_away_says_nothing_though_its_forces_look_small(monkeypatch: pytest.MonkeyPatch):
    asked = on_both_meshes([2.0, 0.0, 0.0, 0.0])
    assert finer_state(*asked) is not None
    sizes = itertools.cycle([1.0, 1e-6])
    pulling = finer_path._pulling
    monkeypatch.setattr(finer_path, "_pulling", lambda *given: (*pulling(*given)[:2], next(sizes)))
    monkeypatch.setattr(finer_path, "rotated_step", lambda body, x, move: 1e3 * x)
    assert finer_state(*asked) is None


def test_a_finer_state_that_folds_is_sought_in_shorter_steps(monkeypatch: pytest.MonkeyPatch):
    asked = on_both_meshes([2.0, 0.0, 0.0, 0.0])
    whole, steps = beyond(asked, finer_state(*asked)), finer_path._stepped

    def folding(*given: Any) -> Any:
        if given[-1] == 1.0:
            raise FemsenseError("not positive definite")
        return steps(*given)

    monkeypatch.setattr(finer_path, "_stepped", folding)
    np.testing.assert_allclose(beyond(asked, finer_state(*asked)), whole, atol=0.06 * np.abs(whole).max())
    monkeypatch.setattr(finer_path, "PACES", (1.0,))
    with pytest.raises(FemsenseError):
        finer_state(*asked)


def test_held_cables_stretch_as_far_as_they_pull_on_the_finer_mesh():
    asked = on_both_meshes([0.004, 0.002, 0.0, 0.0], "displacement", [{"name": "cable_stretch", "stiffness_n_m": 300.0}])
    wanted = beyond(asked, solve_frame(asked[1], 0).positions)
    np.testing.assert_allclose(beyond(asked, finer_state(*asked)), wanted, atol=0.02 * np.abs(wanted).max())


def test_a_slack_cable_that_is_too_long_on_the_finer_mesh_goes_taut():
    asked = on_both_meshes([0.0045, 0.0064, 0.0029, 0.0051], "displacement")
    exact, base = solve_frame(asked[1], 0), asked[3]
    assert exact.held[2] and not base.held[2]
    wanted = beyond(asked, exact.positions)
    np.testing.assert_allclose(beyond(asked, finer_state(*asked)), wanted, atol=0.03 * np.abs(wanted).max())


def test_a_held_cable_that_would_push_on_the_finer_mesh_goes_slack():
    _, fine, frame, base, ties = on_both_meshes([0.004, 0.0, 0.002, 0.0], "displacement")
    x = ties.positions(base.positions)
    for push, slack in ((-2e-3, True), (-5e-4, False)):
        pushing = replace(base, held=np.ones(4, bool), tension={**dict.fromkeys(NAMES, 0.1), NAMES[2]: push})
        now = finer_path._retaut(fine, frame, pushing, x, 1e-4)
        assert now.held.tolist() == [True, True, not slack, True]
        assert now.tension[NAMES[2]] == (0.0 if slack else push)


@pytest.mark.parametrize("rough_from", [0, 10**6], ids=["conjugate gradients", "factor"])
def test_a_finer_state_that_is_bent_much_by_held_cables_settles_where_it_belongs(
    monkeypatch: pytest.MonkeyPatch, rough_from: int
):
    asked = on_both_meshes([0.012, 0.0, 0.0, 0.0], "displacement")
    exact = beyond(asked, solve_frame(asked[1], 0).positions)
    monkeypatch.setattr(refinement, "ROUGH_FROM", rough_from)
    monkeypatch.setattr(finer_path, "FINER_ENOUGH", 1e-3)  # what is solved roughly must not keep the steps from getting there
    np.testing.assert_allclose(beyond(asked, finer_state(*asked)), exact, atol=0.25 * np.abs(exact).max())


def test_one_share_of_the_mesh_error_in_all_sweeps_is_likelier_than_another_in_each():
    noise = Noise({"white": 1e-5}, "")
    data = with_error_of_the_mesh(noise)[2]
    trial, error = data.train[0], mesh_errors(data)[0]
    factor = noise.whitener(trial.groups, trial.mesh_error)
    sign = np.where(trial.groups.sweep % 2, 1.0, -1.0)[:, None]
    costs = [float((whiten(factor, r) ** 2).sum()) for r in (SHARE * error, SHARE * sign * error)]
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
        assert float((whiten(factor, TURNS * turned) ** 2).sum()) < 2.0 + 1e-6
        assert np.linalg.norm(without_mesh_error(trial, 0.1 * turned, noise)) < 0.05 * np.linalg.norm(0.1 * turned)


def test_calibration_goes_as_far_as_held_out_states_come_to_rest():
    def collapses_beyond(most: int):
        def fit(steps: int) -> int:
            if steps > most:
                raise DataError("no equilibrium in frame 3")
            return steps

        return fit

    assert [as_far_as_held_out_states_converge(collapses_beyond(most), 4) for most in (4, 3, 1, 0)] == [4, 2, 1, 0]
    with pytest.raises(DataError):
        as_far_as_held_out_states_converge(collapses_beyond(-1), 4)


def structure_of(values: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """Return the p-values for residuals (frames, markers, 3) over four sweeps of different inputs."""
    frames, markers, _ = values.shape
    inputs = RNG.uniform(0.1, 1.0, size=(frames, 4))
    labels = [f"s{i // (frames // 4)}" for i in range(frames)]
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    fake = SimpleNamespace(time_s=np.arange(frames) * 1.0, inputs=inputs)
    trial = SimpleNamespace(
        scene=SimpleNamespace(frame=frame, recording=fake, crossings=None),
        groups=Groups(marker, frame, np.unique(labels, return_inverse=True)[1][frame], frame),
    )
    monkeypatch.setattr("femsense.loop.verdict.residual_diagnostics.state_key", lambda recording, k: inputs[k].tobytes())
    return structure_tests([trial], [values.reshape(-1, 3)], rng=np.random.default_rng(0)).tests


def test_noise_alone_has_no_structure_and_a_pattern_has(monkeypatch: pytest.MonkeyPatch):
    noise = RNG.normal(size=(24, 6, 3))
    assert min(structure_of(noise, monkeypatch).values()) > 0.003
    pattern = np.zeros_like(noise)
    pattern[6:12] = 3.0 * RNG.normal(size=(6, 3))
    p = structure_of(noise + pattern, monkeypatch)
    assert p["pattern"] <= 0.002
    assert p["sweep"] <= 0.002


def test_a_scale_of_depth_neither_shrinks_the_noise_nor_holds_it_in_its_columns():
    inputs, labels = sweeps(each=1)
    robot = arm((4, 2, 2))
    effect = find_effect("depth_scale")
    hypothesis = Hypothesis(robot, ((effect, {}, effect.parameters(robot, "tension")),))
    scene = make_scene(robot, record(inputs, labels=labels, truth=robot, noise=0.0)[0], np.arange(3))
    noise = 3e-3 * RNG.normal(size=scene.points.shape)
    jets = [
        evaluate_scene(
            hypothesis,
            replace(scene, points=1.1 * scene.points + n),
            np.array([np.log(1.1), 0.0]),
            [T_ROBOT_CAMERA],
            None,
            derivative=True,
            vary_initial=False,
            pivot=robot.marker_points.mean(axis=0),
        )
        for n in (0.0, noise)
    ]
    np.testing.assert_allclose(jets[0].residual, 0.0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(jets[1].residual, axis=1), np.linalg.norm(noise, axis=1), rtol=1e-4)
    np.testing.assert_allclose(jets[0].by_effect, jets[1].by_effect, atol=1e-6)


def test_one_marker_that_sits_elsewhere_is_named_alone():
    inputs, labels = sweeps(1.5, each=1)
    robot = arm((4, 2, 2))
    recording, _ = record(
        inputs, labels=labels, truth=robot, noise=1e-4, effects=[{"name": "marker_offset", "offset_m": {"m5": [2e-3, 0.0, 1e-3]}}]
    )
    loop = improve(robot, [recording], effects=["marker_offset", "cable_gain", "payload"])
    effect = next(e for e in loop.effects if e.name == "marker_offset")
    assert list(effect.parameters["offset_m"].value) == ["m5"]
    np.testing.assert_allclose(effect.parameters["offset_m"].value["m5"], [2e-3, 0.0, 1e-3], atol=2.5e-4)


def test_parts_are_cables_markers_and_keys():
    robot = arm()
    assert [len(p) for p in parts_of(find_effect("cable_gain").parameters(robot, "tension"))] == [1] * 4
    assert [len(p) for p in parts_of(find_effect("marker_offset").parameters(robot, "tension"))] == [3] * 12
    assert [len(p) for p in parts_of(find_effect("depth_scale").parameters(robot, "tension"))] == [1, 1]
    assert len(parts_of(find_effect("payload").parameters(robot, "tension"))) == 1


def test_the_numbers_of_a_seed_cost_as_much_as_parameters():
    place = {"center_m": [0.0, 0.0, 0.0], "radius_m": 0.1}
    assert penalty(1, place, 1, 10, 1000.0) == pytest.approx(5 * np.log(1000.0) + 2 * np.log(10))
    assert penalty(0, {"law": "neo_hookean"}, 1, 10, 1000.0) == pytest.approx(2 * np.log(10))


def test_times_that_are_held_still_stay_where_the_fit_had_them():
    inputs, labels = sweeps(each=1)
    robot, noise, creep, seed = arm((4, 1, 1)), Noise({"white": 1e-4}, ""), find_effect("creep"), {"time_s": 2.0}
    hidden = [{"name": "creep", "fraction": 0.2, "time_s": 3.0}]
    recording, _ = record(inputs, labels=labels, truth=robot, effects=hidden)
    data = prepare(robot, [recording], [])
    parameters = (*creep.parameters(robot, "tension"), *creep.polish(robot, "tension", seed))
    start, flat = np.array([0.1, np.log(5.0)]), Prior(np.zeros(2), np.full(2, np.inf))
    fitted = fit_model(data, Hypothesis(robot, ((creep, seed, parameters),)), flat, noise, start, max_iterations=2)
    still = with_seeds_still(data, fitted)
    assert [p.key for p in still.fit.hypothesis.parameters] == ["fraction"]
    assert still.fit.hypothesis.entries(still.fit.coordinates) == fitted.fit.hypothesis.entries(fitted.fit.coordinates)
    again = keeping(data, still, ["creep"], noise)
    (_, held, _), time_s = again.fit.hypothesis.terms[0], fitted.fit.hypothesis.entries(fitted.fit.coordinates)[0]["time_s"]
    assert held["time_s"] == time_s != 2.0
    assert again.fit.std.shape == (1,) and again.fit.chi2 < 1.1 * fitted.fit.chi2
