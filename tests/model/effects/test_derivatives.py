"""The sensitivity of the markers to every effect, as the loop uses it, against paths that are solved anew."""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter

import numpy as np
import pytest
from arm import NAMES, T_ROBOT_CAMERA, arm

from femsense.core.pose import invert_pose, transform_points
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects import FORMS, find_effect
from femsense.model.observation import Hypothesis, evaluate_scene, make_scene
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, MarkerRows, Timeline

INPUTS = {"tension": [[0.3, 0.2], [1.5, 0.4], [0.9, 1.2]], "displacement": [[1.0, 1.0], [5.0, 1.5], [3.0, 4.0]]}
"""Of two neighbouring cables [N] or [mm]; the others are slack."""


def scene_of(control):
    """Return an arm, and a scene in which the camera sees it exactly where the model has it."""
    robot = arm((3, 1, 1), gravity=(0.0, 0.0, -4.0))
    frames = range(len(INPUTS[control]))
    inputs = np.full((len(frames), 4), 0.0 if control == "tension" else -0.05)
    inputs[:, [0, 2]] = np.array(INPUTS[control]) * (1.0 if control == "tension" else 1e-3)
    timeline, drives = Timeline(np.arange(len(frames)) * 1.7), Drives(NAMES, inputs, control)
    driven = DrivenRobot(robot, drive_of(robot, make_recording(timeline, drives=drives)))
    seen = [points for *_, points, _ in solve_path(driven, frames, attrgetter("markers"))]
    markers = transform_points(invert_pose(T_ROBOT_CAMERA), np.vstack(seen))
    count = len(robot.marker_names)
    recording = make_recording(
        timeline,
        drives=drives,
        markers=MarkerRows(
            robot.marker_names, np.repeat(np.arange(len(frames)), count), np.tile(np.arange(count), len(frames)), markers
        ),
    )
    return robot, make_scene(robot, recording, np.arange(len(frames)))


SCENES = {control: scene_of(control) for control in INPUTS}
CASES = [
    (form, control, at)
    for form in FORMS
    for control, (robot, _) in SCENES.items()
    for at in ("null", "away")
    if (p := form.parameters(robot, control)) and (at == "away" or p[0].null <= p[0].low)
]
"""Where an effect is bounded by its null, there too."""


def title(case):
    form, control, at = case
    return f"{form.name}{FORMS.index(form)}-{control}-{at}"


def jet(hypothesis, scene, coordinates, starts, *, derivative=False):
    return evaluate_scene(
        hypothesis,
        scene,
        coordinates,
        [T_ROBOT_CAMERA],
        None,
        derivative=derivative,
        vary_initial=derivative,
        pivot=np.array([0.05, 0.0, 0.0]),
        starts=starts,
    )


def as_seen(hypothesis, scene, coordinates, starts):
    """Return the scene with the points where the model at the coordinates has the camera measure them."""
    residual = jet(hypothesis, scene, coordinates, starts).residual
    return replace(scene, points=scene.points - residual @ T_ROBOT_CAMERA[:3, :3])


def slope(residual, p, here, at):
    """Return d residual / d coordinate [m] by differences of fourth order, one-sided where the coordinate cannot go lower."""
    h = (4e-4 if at == "null" else 1e-3) * (p.high - p.low)
    if p.key == "stiffness_n_m" and p.high > 1e-3:  # a clamp's range is wide
        h *= 0.2
    if p.key == "point_m":  # states are solved to nanometres
        h *= 4.0
    if at == "null" or p.key == "tension_n":
        weights = {0: -25 / 12, 1: 4, 2: -3, 3: 4 / 3, 4: -1 / 4}
        if p.key == "rotation_stiffness_nm_rad":  # there the plate's ties are missing
            weights = {1: -77 / 12, 2: 107 / 6, 3: -39 / 2, 4: 61 / 6, 5: -25 / 12}
    else:
        weights = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    return sum(w * residual(i * h) for i, w in weights.items()) / h


@pytest.mark.parametrize("case", CASES, ids=title)
def test_the_sensitivity_to_an_effect_is_that_of_marches_solved_anew(case):
    form, control, at = case
    robot, scene = SCENES[control]
    seeds = form.seeds(robot)
    telling = {"cable_coupling": 1, "softening": -1}.get(form.name, 0)  # two cables that pull; an energy that matters here
    seed, starts = dict(seeds[telling]), dict(STARTS[control])
    parameters = (*form.parameters(robot, control), *(form.polish(robot, control, seed) if at == "away" else ()))
    hypothesis = Hypothesis(robot, ((form, seed, parameters),))
    away = [0.05 * (p.high - p.null) if at == "away" else 0.0 for p in parameters]
    coordinates = np.array([p.null for p in parameters]) + away
    scene = as_seen(hypothesis, scene, coordinates, starts)
    here = jet(hypothesis, scene, coordinates, starts, derivative=True)
    near = starts if at == "away" and form.name != "base_compliance" else {}  # a clamp's range is wide: nanometres would count
    nuisance = NUISANCE[control]
    for key in dict.fromkeys(p.key for p in parameters):
        j, parameter = next((j, p) for j, p in enumerate(parameters) if p.key == key)

        def residual(step, j=j):
            moved = coordinates.copy()
            moved[j] += step
            return jet(hypothesis, scene, moved, dict(near)).residual

        exact = slope(residual, parameter, coordinates[j], at)
        error = here.by_effect[:, :, j] - exact
        size = max(np.linalg.norm(here.by_effect[:, :, i]) for i, p in enumerate(parameters) if p.key == key)
        floor = 5e-8 if form.name == "softening" else 0.0  # it hardly moves what is held; states are solved to nanometres
        assert np.linalg.norm(error) < (1e-2 if form.name == "cable_friction" else 1e-4) * size + floor, parameter.label
        left = np.linalg.norm(
            nuisance(exact)
        )  # of what calibration leaves, where that is more than the noise of these differences
        assert np.linalg.norm(nuisance(error)) < 0.05 * left or left < 1e-4 * size, parameter.label


def projector(scene, robot, starts):
    """Return the map that takes out what pose, inputs and modulus can absorb."""
    stiffness = find_effect("stiffness")
    here = jet(
        Hypothesis(robot, ((stiffness, {}, stiffness.parameters(robot, "")),)), scene, np.zeros(1), starts, derivative=True
    )
    columns = np.concatenate([here.by_pose, here.by_initial, here.by_effect], axis=2).reshape(-1, 6 + 4 + 1)
    columns = columns[:, np.linalg.norm(columns, axis=0) > 0]
    Q = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))[0]
    return lambda field: field.ravel() - Q @ (Q.T @ field.ravel())


STARTS = {control: {} for control in SCENES}
NUISANCE = {control: projector(scene, robot, STARTS[control]) for control, (robot, scene) in SCENES.items()}


@pytest.mark.parametrize("name", ["geometry", "depth_scale"])
def test_measured_seats_know_of_size_and_depth(name):
    robot, scene = SCENES["tension"]
    rest = transform_points(invert_pose(T_ROBOT_CAMERA), robot.marker_points)
    count = len(rest)
    scene = replace(scene, rest_marker=np.arange(count), rest_view=np.zeros(count, dtype=int), rest_points=rest)
    effect = find_effect(name)
    parameters = effect.parameters(robot, "tension")
    hypothesis = Hypothesis(robot, ((effect, {}, parameters),))
    here = jet(hypothesis, scene, np.zeros(len(parameters)), {}, derivative=True)
    assert here.rest_by_effect.shape == (count, 3, len(parameters))
    for j in range(len(parameters)):
        step = 1e-5 * np.eye(len(parameters))[j]
        ahead, behind = (jet(hypothesis, scene, sign * step, {}).rest for sign in (1.0, -1.0))
        np.testing.assert_allclose(here.rest_by_effect[:, :, j], (ahead - behind) / 2e-5, atol=1e-6)
        assert np.abs(here.rest_by_effect[:, :, j]).max() > 0.01
