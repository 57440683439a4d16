"""The loop on clouds: rows along normals, their derivatives, and effects found without any marker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record, sweeps

from femsense.core.errors import DataError, InputError
from femsense.core.pose import move_pose
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.ply import write_ply
from femsense.io.recording_folder import load_recording, save_recording
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.data.surface_rows import (
    ROUNDS,
    MeasuredSurface,
    crossings_of,
    in_camera,
    on_model,
    renewed_rows,
    sheet_of,
    surface_normals,
    with_surface,
)
from femsense.loop.data.trial import Groups, SurfaceRows, normals_of, spans_of, vectors_of
from femsense.loop.design.advice import next_element
from femsense.loop.fit.fitted_model import fit_model, own_of, rematched, with_nuisance
from femsense.loop.fit.noise_components import Noise, whiten
from femsense.loop.improve import ImproveOptions, improve
from femsense.loop.search.calibration import matched
from femsense.loop.thresholds import EFFORT
from femsense.model.camera import Camera
from femsense.model.effects import find_effect
from femsense.model.observation import Hypothesis, evaluate_scene
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.pointcloud.sheets import Sheets, fit_sheet, joined
from femsense.rig.camera import Shape, cloud_of, render
from femsense.rig.script import NoiseTable

LENS = Camera("", 240, 180, 600.0, 600.0, 119.5, 89.5, np.zeros(5), 1e-4)
NOISE = NoiseTable.model_validate({"subpixel_px": 0.05, "focal_px": 600.0, "correlated_share": 0.3, "correlation_px": 1.0})
TURNED = move_pose(T_ROBOT_CAMERA, np.array([3e-3, -2e-3, 2e-3, 3e-4, -3e-4, 4e-4]), pivot_a=np.array([0.05, 0.0, 0.0]))
"""What the recording says of the camera: a little off."""
FEW = ["cable_friction", "cable_gain", "creep"]
COARSE, FINE = (6, 1, 1), (7, 2, 2)


def film(folder: Path, *, markers: bool = True, pose: Any = TURNED, **options: Any) -> Recording:
    """Return a recording with clouds of the true arm, which has another mesh, written to a folder and read again."""
    truth = options.pop("truth", None) or arm(FINE)
    inputs, labels = sweeps()
    recording, states = record(inputs, labels=labels, truth=truth, **options)
    if not markers:
        none = {f"marker_{n}": getattr(recording, f"marker_{n}")[:0] for n in ("frame", "index", "view", "xyz")}
        recording = replace(recording, marker_names=(), **none)
    recording = replace(recording, T_robot_camera=(pose,))
    skin, rng = surface_triangles(truth.body.mesh), np.random.default_rng(7)

    def fill(place: Path) -> None:
        (place / "clouds").mkdir()
        for k, x in enumerate(states):
            image = render(LENS, T_ROBOT_CAMERA, [Shape(x, skin, np.array([0.2, 0.4, 0.8]))], noise=NOISE, rng=rng)
            write_ply(place / "clouds" / f"{k:06d}.ply", cloud_of(image, LENS))

    return load_recording(save_recording(recording, folder, fill=fill))


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Return a recording with markers and clouds of an arm whose cables rub."""
    hidden = [{"name": "cable_friction", "coefficient": 0.25}]
    return film(tmp_path_factory.mktemp("rubbing") / "r", effects=hidden)


@pytest.fixture(scope="module")
def both(rubbing: Recording) -> Data:
    return prepare(arm(COARSE), [rubbing], [], "both")


# Measured surfaces


def sphere(center: np.ndarray, radius: float, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (k, 3) that face a camera at the origin, and measured points (r, 3) of a ball."""
    rng = np.random.default_rng(3)
    out = rng.normal(size=(9000, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    out = out[out[:, 2] < -0.2]
    return out[out[:, 2] < -0.5][:40], center + radius * out + noise * rng.normal(size=out.shape)


CENTER, BALL = np.array([0.01, -0.02, 0.4]), 0.03


def ball(noise: float = 0.0) -> tuple[np.ndarray, Sheets]:
    """Return directions that face the camera, and the measured surface of a ball."""
    out, points = sphere(CENTER, BALL, noise)
    chosen = points[::20]
    return out, fit_sheet(points, chosen, chosen - CENTER, 0.006)


def off(sheets: Sheets, points: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return sheets.distance(points, np.zeros(len(points), dtype=np.int64), sides)


def test_the_distance_from_a_curved_surface_is_right_wherever_a_point_goes():
    out, sheets = ball()
    far = (
        CENTER
        + (BALL + np.linspace(-4e-3, 4e-3, len(out))[:, None]) * out
        + 4e-3 * np.random.default_rng(0).normal(size=out.shape)
    )
    way = far - CENTER
    exact = np.linalg.norm(way, axis=1) - BALL
    assert np.ptp(exact) > 0.015
    distance, normals = off(sheets, far, out)
    np.testing.assert_allclose(distance, exact, atol=5e-5)
    np.testing.assert_allclose(np.einsum("kc,kc->k", normals, way / np.linalg.norm(way, axis=1, keepdims=True)), 1.0, atol=1e-3)


def test_nothing_jumps_where_a_point_goes_along_the_surface():
    _, sheets = ball(noise=3e-4)
    turn = np.linspace(-0.7, 0.7, 4001)  # 42 mm along the surface, past some dozen of its fields
    sides = np.stack([np.sin(turn), 0.0 * turn, -np.cos(turn)], axis=1)
    distance, _ = off(sheets, CENTER + (BALL + 1e-3) * sides, sides)
    assert np.abs(distance - 1e-3).max() < 2.5e-4
    assert np.abs(np.diff(distance, 2)).max() < 1e-7  # of 0.01 mm steps


def test_a_field_hardly_feels_a_point_at_its_border_come_or_go():
    points = np.random.default_rng(2).normal(size=(4000, 3)) * (0.01, 0.01, 3e-4)
    centres = np.zeros((200, 3))
    centres[:, 0] = np.linspace(0.0, 2e-3, 200)  # some 100 points come and go on the way
    sheets = joined([fit_sheet(points, c[None], np.array([[0.0, 0.0, 1.0]]), 0.006) for c in centres])
    height, _ = sheets.distance(np.zeros((200, 3)), np.arange(200), np.tile([0.0, 0.0, 1.0], (200, 1)))
    assert np.ptp(height) > 1e-6
    assert np.abs(np.diff(height, 2)).max() < 4e-7


def test_a_surface_has_nothing_of_the_far_side_and_goes_on_as_a_plane_beyond_its_border():
    out, sheets = ball()
    assert np.isnan(off(sheets, CENTER - BALL * out, np.tile([0.0, 0.0, 1.0], (len(out), 1)))[0]).all()
    flat = np.random.default_rng(1).uniform((-0.02, -0.02, 0.3), (0.02, 0.02, 0.3), (3000, 3))
    up = np.tile([0.0, 0.0, -1.0], (len(flat), 1))
    beside = np.array([[0.03, 0.0, 0.301], [0.0, -0.028, 0.298]])
    distance, normals = off(joined([fit_sheet(flat, flat[::30], up[::30], 0.006)]), beside, up[:2])
    np.testing.assert_allclose(distance, [-1e-3, 2e-3], atol=1e-9)
    np.testing.assert_allclose(normals, up[:2], atol=1e-9)
    assert not len(fit_sheet(flat[:5], flat[:5], up[:5], 0.006).centres)


# Rows


def test_rows_are_what_the_true_pose_says_and_markers_and_clouds_share_it(both: Data):
    marked, cloudy = both.train
    assert both.measured == ("markers", "clouds")
    assert (marked.scene.crossings is None, cloudy.together, both.held[1].together) == (True, True, True)
    assert spans_of(both.train) == [slice(0, 6), slice(0, 6)]
    assert set(cloudy.groups.sweep) == set(marked.groups.sweep)
    first = cloudy.scene.frame == 0
    assert first.sum() > 12
    normals = normals_of(cloudy.scene, [T_ROBOT_CAMERA])[first]
    rest = both.robot.marker_points[cloudy.scene.marker[first]]
    side = rest[:, 1:] / 0.01  # the arm is 20 mm wide: its sides have the normals ± y and ± z
    side = np.where(np.abs(side) > 0.999, side, 0.0)
    away = np.einsum("kc,kc->k", normals[:, 1:], side)
    assert (away > 0.97).all()
    scene, pivot = cloudy.scene.pick(np.zeros(1, dtype=np.int64)), both.robot.marker_points.mean(axis=0)
    jet = evaluate_scene(
        Hypothesis(both.robot), scene, np.zeros(0), [T_ROBOT_CAMERA], None, derivative=False, vary_initial=False, pivot=pivot
    )
    assert np.sqrt((jet.residual**2).mean()) < 4e-4  # no cable pulls yet


def rest_state(robot: Robot) -> Equilibrium:
    return solve_equilibrium(robot.with_body(robot.body.with_gravity(np.zeros(3))).body)


def on_sides(robot: Robot, facing: tuple[float, ...]) -> np.ndarray:
    """Return points (r, 3) [m] all over the sides of a robot at rest that a camera sees from a direction."""
    nodes, triangles = robot.body.mesh.nodes, surface_triangles(robot.body.mesh)
    seen = triangles[triangle_normals(nodes, triangles) @ facing > 0.0]
    weights = np.random.default_rng(1).dirichlet(np.ones(3), (len(seen), 400))
    return np.einsum("tsi,tic->tsc", weights, nodes[seen]).reshape(-1, 3)


def seen_as(points: np.ndarray) -> MeasuredSurface:
    return MeasuredSurface({(0, 0): points}, joined([sheet_of(points, 6e-3)]), 2e-3)


def test_what_a_measured_surface_rounds_off_is_no_residual():
    robot = with_surface(arm(COARSE))
    places = robot.body.mesh.nodes[np.abs(robot.body.mesh.nodes[:, 1:]).max(axis=1) > 9e-3]
    robot = robot.with_surface_points(np.concatenate([places, places + np.array([4e-3, 0.0, 0.0])]))  # edges among them
    pose = np.eye(4)
    pose[:3, 3] = 0.05, 0.2, 0.3
    points = on_sides(robot, (0.0, 0.2, 0.3)) - pose[:3, 3]
    state = rest_state(robot)
    seen = seen_as(points)
    numbers, heights, crossings = crossings_of(robot, seen, 0, state, pose)
    assert len(numbers) > 8
    np.testing.assert_allclose(heights, 0.0, atol=1e-9)
    at = in_camera(robot, robot.marker_points[len(robot.glued_names) :][numbers], pose)
    np.testing.assert_allclose(crossings.distance(at), 0.0, atol=1e-9)
    plain, _ = seen.sheets.distance(at, crossings.sheet, crossings.sides)
    assert np.abs(plain).max() > 5e-4
    again, higher, _ = crossings_of(robot, seen_as(points + 1e-3 * np.array([0.0, 0.0, 1.0])), 0, state, pose)
    top = surface_normals(robot, state.positions)[again][:, 2] > 0.99
    assert top.sum() > 2
    np.testing.assert_allclose(higher[top], 1e-3, atol=2e-4)


def test_a_place_that_the_models_own_fields_do_not_cover_is_no_row():
    robot = with_surface(arm(COARSE))
    places = robot.body.mesh.nodes[np.abs(robot.body.mesh.nodes[:, 1:]).max(axis=1) > 9e-3]
    robot, state = robot.with_surface_points(np.concatenate([places, places + np.array([4e-3, 0.0, 0.0])])), rest_state(robot)
    pose = np.eye(4)
    pose[:3, 3] = 0.05, 0.2, 0.3
    seen = seen_as(on_sides(robot, (0.0, 0.2, 0.3)) - pose[:3, 3])
    for off in ([0.0, 0.0, 0.0], [5e-3, 0.0, 0.0]):  # there, beyond the end, fields are of points along its edge alone
        numbers, _, crossings = crossings_of(robot, seen, 0, state, move_pose(pose, np.r_[np.zeros(3), off]))
        assert len(numbers) > 50
        assert np.abs(crossings.rounded).max() < ROUNDS * seen.sheets.radius


def test_rows_are_made_again_until_the_fit_stays_where_it_is(rubbing: Recording):
    noise, off = Noise({}, "", {"white": 1e-4}), np.array([0.02, -0.02, 0.02, 4e-3, -4e-3, 4e-3])

    def to_gain(rounds: int) -> float:
        data = prepare(arm(COARSE), [rubbing], [], "clouds")  # anew: it remembers the states that were solved
        hypothesis, prior = with_nuisance(data)
        nothing, own = np.zeros(len(prior.mean)), np.r_[off, np.zeros(data.train[0].size - 6)]
        start = fit_model(data, hypothesis, prior, noise, nothing, own=own, max_iterations=0)
        data = rematched(data, start, noise, reselect=True)  # rows as they are found from there
        data = replace(data, effort=replace(EFFORT, matchings=rounds))
        found, fitted = matched(data, start, noise, reselect=True)
        again = fit_model(rematched(found, fitted, noise), hypothesis, prior, noise, fitted.fit.coordinates, own=own_of(fitted))
        return again.fit.fit.cost[0] - again.fit.chi2

    assert to_gain(1) > 50.0  # 99 on one machine
    assert to_gain(EFFORT.matchings) < 20.0  # 0 there; a row more or less is worth about ten


def test_rows_hardly_change_when_they_are_made_anew_elsewhere(both: Data):
    trial, robot = both.train[1], both.robot
    frames = trial.scene.frames[:4]
    scene, pivot = trial.scene.pick(frames), robot.marker_points.mean(axis=0)
    moved = [move_pose(trial.poses[0], np.array([0.0, 0.0, 0.0, 2e-3, -2e-3, 2e-3]), pivot_a=pivot)]
    assert trial.seen is not None
    states = evaluate_scene(
        Hypothesis(robot), scene, np.zeros(0), list(trial.poses), None, derivative=False, vary_initial=False, pivot=pivot
    ).states
    rows = renewed_rows(robot, scene, trial.seen, states, moved)
    assert rows.crossings is not None and scene.crossings is not None
    change = rows.crossings.rounded - scene.crossings.rounded
    assert np.sqrt((change**2).mean()) < 1e-4  # where the model went 3.5 mm
    first = np.flatnonzero(scene.frame == frames[0])
    numbers, _, made = crossings_of(robot, trial.seen, 0, states[int(frames[0])], moved[0])
    _, i, j = np.intersect1d(scene.marker[first] - len(robot.glued_names), numbers, return_indices=True)
    assert len(i) > 12
    np.testing.assert_allclose(rows.crossings.rounded[first][i], made.rounded[j], atol=2e-6)  # as rows made there have it


def test_only_sides_that_face_the_camera_stand_for_what_it_measured():
    robot = with_surface(arm(COARSE))
    pose = np.eye(4)
    pose[:3, 3] = 0.05, 0.0, 0.4
    deep = np.array([[0.05, 0.002, -0.009], [0.03, 0.001, -0.02]]) - pose[:3, 3]  # nearer to the side below
    np.testing.assert_allclose(on_model(robot, deep, rest_state(robot), pose)[:, 2], 0.01 - 0.4, atol=1e-9)


def test_derivatives_of_cloud_rows_are_those_of_finite_differences(both: Data):
    trial, robot = both.train[1], both.robot
    scene = trial.scene.pick(trial.scene.frames[[2, 5]])
    terms = [
        (find_effect(n), {}, find_effect(n).parameters(robot, "tension")) for n in ("stiffness", "depth_scale", "cable_gain")
    ]
    hypothesis, pivot = Hypothesis(robot, tuple(terms)), robot.marker_points.mean(axis=0)
    zero, initial = np.zeros(len(hypothesis.parameters)), np.full(4, 0.1)

    def residual(coordinates: np.ndarray, step: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        poses = [move_pose(trial.poses[0], step, pivot_a=pivot)]
        return evaluate_scene(
            hypothesis, scene, coordinates, poses, inputs, derivative=False, vary_initial=False, pivot=pivot
        ).residual

    jet = evaluate_scene(hypothesis, scene, zero, list(trial.poses), initial, derivative=True, vary_initial=True, pivot=pivot)
    assert jet.residual.shape == (len(scene.frame), 1)
    for j, h in ((0, 1e-3), (2, 1e-3), (4, 1e-4)):
        step = h * np.eye(6)[j]
        central = (residual(zero, step, initial) - residual(zero, -step, initial)) / (2 * h)
        np.testing.assert_allclose(jet.by_pose[:, :, j], central, atol=2e-2 * np.abs(central).max())
    for j in range(len(zero)):
        h = 5e-4 * np.eye(len(zero))[j]
        central = (residual(zero + h, np.zeros(6), initial) - residual(zero - h, np.zeros(6), initial)) / 1e-3
        assert np.abs(central).max() > 1e-4
        np.testing.assert_allclose(jet.by_effect[:, :, j], central, atol=2e-2 * np.abs(central).max())
    h = 1e-3 * np.eye(4)[0]
    central = (residual(zero, np.zeros(6), initial + h) - residual(zero, np.zeros(6), initial - h)) / 2e-3
    np.testing.assert_allclose(jet.by_initial[:, :, 0], central, atol=2e-2 * np.abs(central).max())


def test_a_row_is_positive_where_the_measured_surface_lies_outside(both: Data):
    trial = both.train[1]
    poses = [T.copy() for T in trial.poses]
    frame = trial.scene.frames[:1]
    scene, pivot = trial.scene.pick(frame), both.robot.marker_points.mean(axis=0)

    def residual() -> np.ndarray:
        return evaluate_scene(
            Hypothesis(both.robot), scene, np.zeros(0), poses, None, derivative=False, vary_initial=False, pivot=pivot
        ).residual

    before = residual()
    poses[0][:3, 3] += 1e-3 * T_ROBOT_CAMERA[:3, 2] * -1.0  # everything measured comes 1 mm nearer to the camera
    change = vectors_of(trial.part(frame), residual() - before)
    assert (change @ -T_ROBOT_CAMERA[:3, 2] > 0.0).all()
    assert (residual() > before).all()


def test_noise_of_clouds_is_shared_by_neighbours_along_their_normals():
    marker = np.array([0, 1, 0, 1])
    surface = SurfaceRows(
        points=np.array([[0.0, 0, 0], [0.01, 0, 0]] * 2),
        normals=np.array([[0.0, 0, 1], [0.6, 0, 0.8]] * 2),
        rest_normals=np.array([[0.0, 0, 1], [0, 0.8, 0.6]] * 2),
        states=np.array([0, 0, 1, 1]),
        length=0.01,
    )
    groups = Groups(marker, np.array([0, 0, 1, 1]), np.zeros(4, int), np.arange(4), surface)
    noise = Noise({}, "", {"white": 0.5, "marker": 0.3, "frame": 0.2, "state": 0.1})
    sigma, near = noise.covariance(groups), np.exp(-0.5)
    assert sigma[0, 0] == pytest.approx(0.25 + 0.09 + 0.04 + 0.01)
    assert sigma[0, 1] == pytest.approx(0.6 * near * (0.09 + 0.01) + 0.8 * 0.04)
    assert sigma[0, 2] == pytest.approx(0.09)
    assert sigma[0, 3] == pytest.approx(0.6 * near * 0.09)
    W = whiten(noise.whitener(groups), np.eye(4)[:, None, :])
    np.testing.assert_allclose(np.linalg.inv(W.T @ W), sigma, atol=1e-12)


# The loop


def check_friction(loop: Any) -> None:
    assert loop.verdict == "effects"
    effect = next(e for e in loop.effects if e.name == "cable_friction")
    value = effect.parameters["coefficient"].value
    value = value if isinstance(value, float) else float(np.mean(list(value.values())))
    assert value == pytest.approx(0.25, rel=0.2)
    assert {e.name for e in loop.effects} <= {"cable_friction", "stiffness", "cable_offset"}
    assert loop.after.validation_normal_rms_m < 0.6 * loop.before.validation_normal_rms_m


def test_friction_is_found_from_clouds_alone(rubbing: Recording):
    none = {f"marker_{n}": getattr(rubbing, f"marker_{n}")[:0] for n in ("frame", "index", "view", "xyz")}
    loop = improve(arm(COARSE), [replace(rubbing, marker_names=(), **none)], effects=FEW)
    check_friction(loop)
    assert loop.data.measured == ("clouds",)
    assert loop.after.validation_rms_m == loop.after.validation_normal_rms_m
    assert loop.robot.marker_names == arm(COARSE).marker_names
    assert "along the normals" in loop.sentence


def test_friction_is_found_from_markers_and_clouds_together(rubbing: Recording):
    loop = improve(arm(COARSE), [rubbing], effects=FEW, options=ImproveOptions(measured="both"))
    check_friction(loop)
    assert loop.after.validation_rms_m != loop.after.validation_normal_rms_m
    assert loop.after.validation_rms_m < 0.6 * loop.before.validation_rms_m


def test_a_model_that_lacks_nothing_is_told_so_from_clouds(tmp_path: Path):
    loop = improve(arm(COARSE), [film(tmp_path / "r", markers=False, truth=arm(COARSE))], effects=FEW)
    assert (loop.verdict, loop.effects) == ("none", ())


# What is missing


def test_clouds_without_a_pose_say_what_to_give(rubbing: Recording):
    none = {f"marker_{n}": getattr(rubbing, f"marker_{n}")[:0] for n in ("frame", "index", "view", "xyz")}
    with pytest.raises(InputError, match=r"T_robot_camera in recording\.toml"):
        prepare(arm(COARSE), [replace(rubbing, marker_names=(), T_robot_camera=(None,), **none)], [])


def test_a_recording_without_clouds_or_with_none_in_free_frames_says_so(rubbing: Recording):
    with pytest.raises(DataError, match="the recording has no clouds"):
        prepare(arm(COARSE), [record(sweeps()[0][:4])[0]], [], "clouds")
    with pytest.raises(DataError, match="no contact-free frame has clouds"):
        prepare(arm(COARSE), [replace(rubbing, free=np.zeros(len(rubbing.time_s), dtype=bool))], [], "clouds")
    with pytest.raises(InputError, match="auto, markers, clouds, both"):
        prepare(arm(COARSE), [rubbing], [], "images")


def test_a_camera_that_looks_past_the_robot_is_refused(rubbing: Recording):
    away = TURNED.copy()
    away[:3, 3] += 0.5
    none = {f"marker_{n}": getattr(rubbing, f"marker_{n}")[:0] for n in ("frame", "index", "view", "xyz")}
    with pytest.raises(DataError, match="no camera sees the robot"):
        prepare(arm(COARSE), [replace(rubbing, marker_names=(), T_robot_camera=(away,), **none)], [])


def test_what_to_record_next_is_told_from_markers_and_clouds_together(both: Data):
    hypothesis, prior = with_nuisance(both)
    noise = Noise({"white": 1e-4}, "")
    fitted = fit_model(both, hypothesis, prior, noise, np.zeros(len(prior.mean)))
    told = next_element(both, fitted.fit, noise, [("cable_gain", "poisson")], ["gravity"])
    assert told and all(after > before for _, _, before, after in told)
