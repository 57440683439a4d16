"""Places of markers: their errors turn with the body, in the noise as in the data; one that is far off is no noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record, sweeps
from scipy.spatial.transform import Rotation

from femsense.fem.equilibrium import solve_equilibrium
from femsense.loop.data.dataset import prepare
from femsense.loop.data.trial import Groups
from femsense.loop.fit.fitted_model import fit_model, problem_of, with_nuisance
from femsense.loop.fit.marker_placement import placement_turns, with_turning_placements
from femsense.loop.fit.noise_components import Likelihood, Noise, estimate_noise, whiten
from femsense.loop.improve import improve
from femsense.model.effects import apply_effects

HEIGHT = 3.0
"""Tension that bends the arm by 60° [N]."""


def turning_groups(frames: int = 20, markers: int = 8) -> Groups:
    """Return groups of markers along a body that bends about y, the last by 1.5 rad at the end."""
    frame, marker = np.repeat(np.arange(frames), markers), np.tile(np.arange(markers), frames)
    angle = 1.5 * frame / (frames - 1) * marker / (markers - 1)
    turns = Rotation.from_rotvec(np.outer(angle, [0.0, 1.0, 0.0])).as_matrix()
    return Groups(marker, frame, frame // 5, np.arange(frames * markers), turns=turns)


def covariance(noise: Noise, groups: Groups) -> np.ndarray:
    fields = noise.placements(groups).reshape(3 * len(groups.marker), -1)
    return np.kron(noise.covariance(groups), np.eye(3)) + fields @ fields.T


def test_a_marker_moves_with_its_place_as_its_ties_say():
    robot = arm((5, 2, 2))
    state = solve_equilibrium(robot.body, tension={"up": HEIGHT})
    places = np.array([[0.033, 0.004, 0.003], [0.071, -0.006, 0.002], [0.0951, 0.0013, -0.007]])
    robot = robot.with_marker_points(np.vstack([places, robot.marker_points[3:]]))
    turns = placement_turns(robot, robot.marker_points, state.positions)[:3]
    step = 1e-6 * np.eye(3)
    for a in range(3):
        ahead, behind = (robot.tie_markers(robot.marker_points + s * step[a]).positions(state.positions)[:3] for s in (1, -1))
        np.testing.assert_allclose(turns[:, :, a], (ahead - behind) / 2e-6, atol=1e-6)
    assert np.linalg.norm(turns[2] - np.eye(3)) > 0.5


def test_markers_on_the_clamp_keep_their_errors_as_they_are():
    robot = arm((5, 2, 2))
    stays = apply_effects(robot, [{"name": "clamped_marker", "markers": ["m0"], "share": 0.25}])
    state = solve_equilibrium(robot.body, tension={"up": HEIGHT})
    whole, part = (placement_turns(r, r.marker_points, state.positions) for r in (robot, stays))
    np.testing.assert_allclose(part[0], 0.25 * whole[0] + 0.75 * np.eye(3))
    np.testing.assert_allclose(part[1:], whole[1:])


def test_whitening_inverts_the_covariance_of_seats_that_turn():
    groups, noise = turning_groups(5, 4), Noise({"white": 0.5, "frame": 0.3, "marker": 0.7}, "")
    mesh = np.random.default_rng(2).normal(size=(20, 3, 2))
    for error in (None, mesh):
        W = whiten(noise.whitener(groups, error), np.eye(60).reshape(20, 3, 60))
        sigma = covariance(noise, groups) + (0.0 if error is None else mesh.reshape(60, 2) @ mesh.reshape(60, 2).T)
        np.testing.assert_allclose(W.T @ W @ sigma, np.eye(60), atol=1e-9)
        assert noise.whitener(groups, error) is noise.whitener(groups, error)


def test_the_likelihood_of_seats_that_turn_is_that_of_their_covariance():
    rng, groups = np.random.default_rng(3), turning_groups(6, 4)
    names, k = ["white", "frame", "marker", "sweep"], 24
    basis = np.linalg.qr(rng.normal(size=(3 * k, 4)))[0]
    residual = rng.normal(size=(k, 3))
    likelihood = Likelihood(names, [residual], [basis.reshape(k, 3, 4)], [groups])

    def slowly(log_std: np.ndarray) -> float:
        inverse = np.linalg.inv(covariance(Noise(dict(zip(names, np.exp(log_std))), ""), groups))
        inner, r = basis.T @ inverse @ basis, residual.ravel()
        P = inverse - inverse @ basis @ np.linalg.solve(inner, basis.T @ inverse)
        return 0.5 * float(-np.linalg.slogdet(inverse)[1] + np.linalg.slogdet(inner)[1] + r @ P @ r)

    at = np.log([1.0, 0.6, 0.4, 0.3])
    value, gradient = likelihood(at)
    assert value == pytest.approx(slowly(at), rel=1e-9)
    for i, step in enumerate(1e-5 * np.eye(4)):
        assert gradient[i] == pytest.approx((slowly(at + step) - slowly(at - step)) / 2e-5, rel=1e-5)


def test_the_noise_of_seats_that_turn_is_told_from_the_rest():
    rng, groups = np.random.default_rng(4), turning_groups(40, 12)
    placement = 3e-4 * rng.normal(size=(12, 3))
    residual = np.einsum("kij,kj->ki", groups.turns, placement[groups.marker]) + 1e-4 * rng.normal(size=(480, 3))
    std = estimate_noise([residual], [np.full((480, 3, 1), 1e-6)], [np.zeros((480, 3, 0))], [groups]).std
    assert std["marker"] == pytest.approx(float(placement.std()), rel=0.15) and std["white"] == pytest.approx(1e-4, rel=0.05)


def test_seats_that_could_not_be_seen_beside_what_was_not_explained_yet_are_seen_later():
    rng, groups = np.random.default_rng(5), turning_groups(20, 17)
    placement = 5e-5 * rng.normal(size=(17, 3))
    residual = np.einsum("kij,kj->ki", groups.turns, placement[groups.marker]) + 1e-4 * rng.normal(size=(340, 3))
    before = {"white": 6e-4, "frame": 2e-4, "marker": 0.0, "sweep": 0.0}
    std = estimate_noise([residual], [np.full((340, 3, 1), 1e-6)], [np.zeros((340, 3, 0))], [groups], before).std
    assert std["marker"] == pytest.approx(float(placement.std()), rel=0.2) and std["white"] == pytest.approx(1e-4, rel=0.1)


def test_both_what_is_fitted_and_what_is_held_out_knows_how_its_seats_turn():
    inputs, labels = sweeps(HEIGHT)
    data = prepare(arm((4, 1, 1)), [record(inputs, labels=labels, truth=arm((4, 1, 1)))[0]], [])
    hypothesis, prior = with_nuisance(data)
    fitted = fit_model(data, hypothesis, prior, Noise({"white": 1e-4}, ""), np.zeros(len(prior.mean)), max_iterations=1)
    turned = with_turning_placements(data, fitted)
    for trial, jet in zip((*turned.train, *turned.held), (*fitted.fit.jets, *(h.jet for h in fitted.held))):
        frame = int(trial.scene.frames[-1])
        rows = trial.scene.frame == frame
        expected = placement_turns(data.robot, data.robot.marker_points, jet.states[frame].positions)[trial.scene.marker[rows]]
        np.testing.assert_allclose(trial.groups.turns[rows], expected, atol=1e-9)


def test_a_declared_pose_is_trusted_to_a_millimetre_and_ten_milliradians_beside_markers():
    inputs, labels = sweeps(HEIGHT)
    recording, _ = record(inputs, labels=labels, truth=arm((4, 1, 1)))
    data = prepare(arm((4, 1, 1)), [replace(recording, T_robot_camera=(T_ROBOT_CAMERA,))], [])
    hypothesis, prior = with_nuisance(data)
    noise = Noise({"white": 1e-4}, "")
    fitted = fit_model(data, hypothesis, prior, noise, np.zeros(len(prior.mean)), max_iterations=0)
    rows = 3 * len(data.train[0].scene.frame)
    pulls = problem_of(data, fitted.fit, noise).rows_of(fitted.fit.jets, fitted.fit.fit.theta, True)[1]
    assert pulls is not None
    np.testing.assert_allclose(pulls[rows : rows + 6, :6], np.diag([1e2] * 3 + [1e3] * 3))


def test_seats_that_scatter_on_an_arm_that_bends_are_no_effect():
    """Taken for the same vector in all frames they were named as the offsets of two markers."""
    inputs, labels = sweeps(HEIGHT)
    placements = 4e-4 * np.random.default_rng(5).normal(size=(12, 3))
    recording, _ = record(inputs, labels=labels, truth=arm((8, 3, 3)), noise=1e-4, placements=placements)
    loop = improve(arm(), [recording])
    assert loop.verdict == "none" and not loop.effects
    assert loop.data.noise_components_m["marker"] == pytest.approx(4e-4, rel=0.4)


def test_several_markers_that_sit_elsewhere_are_named_and_are_no_noise():
    inputs, labels = sweeps(HEIGHT)
    placements = 1e-4 * np.random.default_rng(6).normal(size=(12, 3))
    placements[10] += [3e-3, 0.0, 0.0]
    placements[7] += [0.0, 0.0, 2.5e-3]
    recording, _ = record(inputs, labels=labels, truth=arm((8, 3, 3)), noise=1e-4, placements=placements)
    loop = improve(arm(), [recording])
    effect = next(e for e in loop.effects if e.name == "marker_offset")
    offsets = effect.parameters["offset_m"].value
    assert set(offsets) == {"m7", "m10"}
    for name, placement in (("m7", placements[7]), ("m10", placements[10])):
        np.testing.assert_allclose(offsets[name], placement, atol=5e-4)
    assert loop.data.noise_components_m["marker"] < 3e-4
