"""The parts of experiments: forms of effects, and the Gram matrices of a block of frames.

Columns of a block belong to its recording alone (pose, initial inputs), or are shared by all recordings (nuisance and effects).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.least_squares import FitResult
from femsense.loop.data.trial import States, Trial
from femsense.loop.design.candidate_experiments import MOST_EACH
from femsense.loop.fit.joint_fit import JointFit, JointProblem, Prior
from femsense.loop.search.effect_fields import effect_fields
from femsense.model.effects import EFFECTS, Effect, Entry, Parameter
from femsense.model.effects.base import range_units
from femsense.model.observation import Hypothesis, SceneJet
from femsense.model.robot import Robot
from femsense.rig.camera import measured_points, visible_points
from femsense.rig.scene import body_shape
from femsense.rig.script import SceneTable

# Forms


@dataclass(frozen=True, eq=False, slots=True)
class Form:
    """An effect with a seed and its columns."""

    label: str
    """Name of the effect in tables, with its form if there are several."""
    name: str
    effect: Effect
    seed: Entry
    parameters: tuple[Parameter, ...]
    size: FloatArray
    """Plausible size of each column, in coordinates."""
    at: int
    """Index of its first column."""
    known: FloatArray
    """Prior standard deviation of each column of a nuisance effect, in coordinates, shape (q,); empty for others."""

    @property
    def columns(self) -> slice:
        return slice(self.at, self.at + len(self.size))


def forms_of(robot: Robot, control: str, ranges: FloatArray, *, names: Sequence[str] | None = None) -> list[Form]:
    """Return the forms of effects to analyse.

    Arguments:
        robot: the declared robot.
        control: "tension" or "displacement".
        ranges: range of the input of each of a cables [N] or [m], shape (a,).
        names: effects to take; by default all.
    """
    result: list[Form] = []
    at = 0
    for effect, label in _kinds(robot):
        seeds = effect.seeds(robot)[:MOST_EACH]
        for seed in seeds if names is None or effect.name in names else []:
            parameters = effect.parameters(robot, control)
            if not parameters and not effect.discrete:
                continue
            size = np.ones(1) if effect.discrete else _plausible(parameters, robot, ranges)
            result.append(Form(label, effect.name, effect, seed, parameters, size, at, _known(effect, parameters, robot, ranges)))
            at += len(size)
    return result


def _kinds(robot: Robot) -> list[tuple[Effect, str]]:
    """Return the forms of the effects that planning uses, with their labels."""
    result = []
    for effect in EFFECTS:
        forms = [("", effect)] if effect.planned is None else effect.planned(robot)
        result += [(form, f"{effect.name} ({which})" if which else effect.name) for which, form in forms]
    return result


def _known(effect: Effect, parameters: Sequence[Parameter], robot: Robot, ranges: FloatArray) -> FloatArray:
    if effect.calibrated is None:
        return np.zeros(0)
    return np.maximum(effect.calibrated.planned_std * range_units(parameters, robot.body.cable_names, ranges), 1e-9)


def _plausible(parameters: Sequence[Parameter], robot: Robot, ranges: FloatArray) -> FloatArray:
    """Return plausible sizes of parameters, in coordinates, shape (q,)."""
    return np.array([p.usual_size for p in parameters]) * range_units(parameters, robot.body.cable_names, ranges)


# Blocks


@dataclass(frozen=True, eq=False, slots=True)
class Gram:
    """Products of whitened columns: w own ones of the recording and e shared ones."""

    own: FloatArray
    """Shape (w, w)."""
    cross: FloatArray
    """Shape (w, e)."""
    shared: FloatArray
    """Shape (e, e)."""


@dataclass(frozen=True, eq=False, slots=True)
class Block:
    """One part of an experiment."""

    recording: str
    """Blocks of one recording share its pose."""
    gram: Gram
    rested: Gram | None
    """The same with rest.csv; None if not requested."""
    placements: Gram
    """Rows of rest.csv, one set per recording."""
    states: int
    """Number of distinct states of markers."""


def make_block(
    trial: Trial,
    robot: Robot,
    forms: Sequence[Form],
    *,
    recording: str,
    noise: float,
    turns: FloatArray | None = None,
    see: bool = False,
    measured: bool = False,
    with_rest: bool = False,
) -> Block:
    """Return the Gram matrices of a block of frames.

    Arguments:
        trial: inputs, loads and camera; unless `measured`, its marker positions are replaced by those of the robot.
        robot: the declared robot.
        forms: forms of effects, one column per parameter.
        recording: its key.
        noise: standard deviation of a marker's coordinate [m].
        turns: rotation of the base in each frame, shape (F, 3, 3): gravity in the frame is the rotation times the declared gravity.
        see: exclude markers hidden from the camera.
        measured: the trial's markers are real.
        with_rest: also with rest.csv.

    Raises:
        DataError: a frame has no equilibrium.
    """
    trial, states = (trial, None) if measured else _as_expected(trial, robot)
    jet = _jet(trial, robot, states)
    rows = _seen(trial, robot, jet) if see else np.ones(len(jet.residual), dtype=bool)
    columns, rest_columns = _columns(trial, robot, jet, forms, turns, width=max((f.columns.stop for f in forms), default=0))
    distinct = len(np.unique(trial.groups.state[rows]))
    gram, placements = _gram(_own(jet)[rows], columns[rows], noise), _placements(jet, rest_columns, noise)
    if not with_rest:
        return Block(recording, gram, None, placements, distinct)
    placed = _with_rest(trial, robot)
    jet = _jet(placed, robot, jet.states)
    moved = [f for f in forms if f.effect.moves_rest]  # only these change the measured placements
    fresh, rest_columns = _columns(placed, robot, jet, moved, turns, width=columns.shape[2])
    for f in moved:
        columns[:, :, f.columns] = fresh[:, :, f.columns]
    rested = _gram(_own(jet)[rows], columns[rows], noise)
    return Block(recording, gram, rested, _placements(jet, rest_columns, noise), distinct)


def _own(jet: SceneJet) -> FloatArray:
    return np.concatenate([jet.by_pose, jet.by_initial], axis=2)


def _jet(trial: Trial, robot: Robot, known: States | None) -> SceneJet:
    probe = JointProblem(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), [trial], [], 1.0)
    return probe.jet(trial, _start(trial), np.zeros(0), True, known=known)


def _start(trial: Trial) -> FloatArray:
    return np.concatenate([np.zeros(6 * len(trial.poses)), np.zeros(0) if trial.initial is None else trial.initial])


def _as_expected(trial: Trial, robot: Robot) -> tuple[Trial, States]:
    """Return the trial with markers at the positions predicted by the declared robot, as measured by the camera, and the states of that robot."""
    probe = JointProblem(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), [trial], [], 1.0)
    states = probe.jet(trial, _start(trial), np.zeros(0), False).states
    places = {k: robot.markers.positions(state.positions) for k, state in states.items()}
    scene = trial.scene
    true = np.array([places[int(f)][m] for f, m in zip(scene.frame, scene.marker)])
    return replace(trial, scene=replace(scene, points=measured_points(trial.poses[0], true, robot.observation))), states


def _with_rest(trial: Trial, robot: Robot) -> Trial:
    every = np.arange(len(robot.marker_points))
    points = measured_points(trial.poses[0], robot.marker_points, robot.observation)
    return replace(trial, scene=replace(trial.scene, rest_marker=every, rest_view=np.zeros_like(every), rest_points=points))


def _seen(trial: Trial, robot: Robot, jet: SceneJet) -> BoolArray:
    """Return which rows are visible to the camera, shape (k,)."""
    camera, table, scene = trial.scene.recording.cameras[0], SceneTable.model_validate({}), trial.scene
    assert camera is not None
    visible = {}
    for k, state in jet.states.items():
        shapes = [body_shape(robot, state.positions, table)]
        visible[k] = visible_points(camera, trial.poses[0], shapes, robot.markers.positions(state.positions))
    return np.array([visible[int(f)][m] for f, m in zip(scene.frame, scene.marker)], dtype=bool)


def _columns(
    trial: Trial, robot: Robot, jet: SceneJet, forms: Sequence[Form], turns: FloatArray | None, *, width: int
) -> tuple[FloatArray, FloatArray]:
    """Return the columns of forms [m], of markers (k, c, e) and of measured placements (r, 3, e); zero if a form cannot act or has no
    equilibrium."""
    result, rest = np.zeros((*jet.residual.shape, width)), np.zeros((len(jet.rest), 3, width))
    if not forms:
        return result, rest
    theta = _start(trial)
    fit = FitResult(theta, np.zeros((0, 0)), np.zeros(0), np.zeros((0, 0)), (), "")
    base = JointFit(Hypothesis(robot), Prior(np.zeros(0), np.zeros(0)), fit, len(theta), 0.0, [jet])
    fields = effect_fields(base, [trial], [(f.effect, f.seed, f.parameters) for f in forms])
    where = {(id(f.effect), id(f.seed)): f for f in forms}
    for i, (effect, seed, _) in enumerate(fields.todo):
        form = where[id(effect), id(seed)]
        (own,), (placements,) = fields.of(i)
        if form.effect.turns_with_base and turns is not None:
            own = np.einsum("kci,kij->kcj", own, turns[trial.scene.frame])
        result[:, :, form.columns], rest[:, :, form.columns] = own, placements
    return result, rest


def _gram(own: FloatArray, shared: FloatArray, noise: float) -> Gram:
    A, B = own.reshape(-1, own.shape[2]) / noise, shared.reshape(-1, shared.shape[2]) / noise
    return Gram(A.T @ A, A.T @ B, B.T @ B)


def _placements(jet: SceneJet, shared: FloatArray, noise: float) -> Gram:
    """Return the Gram matrices of measured placements; their σ is that of markers, at least 0.1 mm."""
    r = len(jet.rest)
    own = np.concatenate(
        [jet.rest_by_pose.reshape(r, 3, jet.by_pose.shape[2]), np.zeros((r, 3, jet.by_initial.shape[2]))], axis=2
    )
    return _gram(own, shared, max(noise, 1e-4))


def turns_of(gravity: FloatArray | None, declared: FloatArray) -> FloatArray | None:
    """Return the smallest rotations from the declared gravity to that of each frame, shape (F, 3, 3); None if gravity is constant."""
    if gravity is None:
        return None
    first = declared if np.any(declared) else gravity[0]
    return np.array([Rotation.align_vectors(g[None], first[None])[0].as_matrix() for g in gravity])
