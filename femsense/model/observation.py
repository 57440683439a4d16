"""From parameters to marker residuals: poses of the cameras, initial inputs and effects, over one or several recordings.

The residual of a marker is  T_robot_camera · y − p(x),  y the measured point (after the camera's depth law) and p its
place on the body in the state x. Where `rest.csv` measures the markers on the unloaded body, it determines their
placements T_robot_camera · y_rest. The distances of placements from the declared places constrain the pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import DataError
from femsense.core.pose import moved_poses
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import Embedding
from femsense.model.camera_frame import as_measured, in_robot_frame
from femsense.model.drive import DrivenRobot, drive_of, has_history, inputs_wanted
from femsense.model.effects import Effect, Entry, InRecording, Parameter, build_entry
from femsense.model.effects.base import part_in
from femsense.model.linear_answers import AtPoints
from femsense.model.path_solver import PathSolver
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.model.softening import path_energies, softened
from femsense.pointcloud.sheets import Crossings

POSE_STEP = np.array([1e-5, 1e-5, 1e-5, 1e-6, 1e-6, 1e-6])
"""Steps for derivatives by a pose [rad, m]."""
TENSION_STEP = 1e-4
"""Step for derivatives by a tension [N]."""


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """The markers of one recording that a fit uses."""

    recording: Recording
    frames: IntArray
    """Indices of the frames that are used, ascending, shape (f,)."""
    frame: IntArray
    """Frame index of each measured marker, shape (k,)."""
    marker: IntArray
    """Its index among the robot's markers, shape (k,)."""
    view: IntArray
    """The camera that saw it, shape (k,)."""
    points: FloatArray
    """Where it was measured [m], camera frame, shape (k, 3)."""
    rest_marker: IntArray
    """Markers that rest.csv has, as indices of the robot's markers, shape (r,)."""
    rest_view: IntArray
    """shape (r,)."""
    rest_points: FloatArray
    """[m], camera frame, shape (r, 3)."""
    crossings: Crossings | None = None
    """Where rows cross measured surfaces, camera frame; `points` are then their feet. None: points are markers."""

    def pick(self, frames: IntArray) -> Scene:
        """Return the scene of some of its frames."""
        return replace(self.of_rows(np.isin(self.frame, frames)), frames=np.intersect1d(self.frames, frames))

    def of_rows(self, rows: BoolArray) -> Scene:
        """Return the scene with some of its rows (k,) only, its frames as they are."""
        return replace(
            self,
            frame=self.frame[rows],
            marker=self.marker[rows],
            view=self.view[rows],
            points=self.points[rows],
            crossings=None if self.crossings is None else self.crossings.pick(rows),
        )


Term = tuple[Effect, Entry, tuple[Parameter, ...]]
"""An effect of a hypothesis, the fixed keys of its entry, and its fitted parameters."""


@dataclass(frozen=True, eq=False, slots=True)
class Hypothesis:
    """A robot with effects whose parameters are fitted."""

    robot: Robot
    terms: tuple[Term, ...] = ()
    settled: tuple[tuple[Effect, Entry], ...] = ()
    """Effects without parameters, which the robot has already."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(p for _, _, parameters in self.terms for p in parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, those without parameters first."""
        return tuple(effect.name for effect, _ in self.settled) + tuple(effect.name for effect, _, _ in self.terms)

    def entries(self, coordinates: FloatArray) -> list[Entry]:
        """Return the tables of the terms, name included, for coordinates of the fit, shape (p,)."""
        result, at = [], 0
        for effect, seed, parameters in self.terms:
            entry = build_entry(parameters, list(coordinates[at : at + len(parameters)]), seed)
            result.append({"name": effect.name, **entry})
            at += len(parameters)
        return result

    def robot_at(self, coordinates: FloatArray) -> Robot:
        """Return the robot with the effects at coordinates, shape (p,)."""
        robot, at = self.robot, 0
        for (effect, _, parameters), entry in zip(self.terms, self.entries(coordinates)):
            own = coordinates[at : at + len(parameters)]
            at += len(parameters)
            if parameters and not effect.discrete and all(c == p.null for p, c in zip(parameters, own)):
                continue
            robot = effect.apply(robot, {k: v for k, v in entry.items() if k != "name"})
        return robot


def make_scene(robot: Robot, recording: Recording, frames: IntArray) -> Scene:
    """Return the markers of some frames of a recording. Raises DataError where there are none."""
    known = {name: i for i, name in enumerate(robot.marker_names)}
    number = np.array([known.get(name, -1) for name in recording.marker_names], dtype=np.int64)
    marker = number[recording.marker_index] if len(recording.marker_index) else np.zeros(0, np.int64)
    rows = np.isin(recording.marker_frame, frames) & (marker >= 0)
    if not rows.any():
        raise DataError("the recording has no markers that the robot knows in the frames that can be used")
    used, none = np.intersect1d(frames, recording.marker_frame[rows]), np.zeros(0, np.int64)
    scene = Scene(
        recording,
        used,
        recording.marker_frame[rows],
        marker[rows],
        recording.marker_view[rows],
        recording.marker_xyz[rows],
        none,
        none,
        np.zeros((0, 3)),
    )
    return with_rest_markers(robot, scene)


def with_rest_markers(robot: Robot, scene: Scene) -> Scene:
    """Return a scene with the markers that rest.csv measures on the unloaded body."""
    rest = scene.recording.rest
    if rest is None:
        return scene
    known = {name: i for i, name in enumerate(robot.marker_names)}
    every = np.array([known.get(name, -1) for name in rest.names], dtype=np.int64)
    own = every >= 0
    return replace(scene, rest_marker=every[own], rest_view=rest.view[own], rest_points=rest.positions[own])


def placements(robot: Robot, scene: Scene, poses: Sequence[FloatArray]) -> FloatArray:
    """Return the marker positions at rest [m], shape (m, 3): measured in rest.csv, or as declared."""
    places = robot.marker_points.copy()
    if len(scene.rest_marker):
        places[scene.rest_marker] = in_robot_frame(scene.rest_points, scene.rest_view, poses, robot.observation)
    return places


def _ties(robot: Robot, scene: Scene, poses: Sequence[FloatArray]) -> Embedding:
    """Return the ties of the markers to the body, at their placements."""
    return robot.tie_markers(placements(robot, scene, poses)) if len(scene.rest_marker) else robot.markers


def _tied_alike(robot: Robot, other: Robot) -> bool:
    """Return whether the markers of two robots are embedded equally, by their declared positions and cameras."""
    same_placements = robot.marker_points is other.marker_points and robot.observation == other.observation
    return same_placements and robot.body.mesh is other.body.mesh and robot.marker_share is other.marker_share


def marker_residual(robot: Robot, scene: Scene, poses: Sequence[FloatArray], model: Mapping[int, FloatArray]) -> FloatArray:
    """Return measured minus modelled markers [m], shape (k, 3), along the axes of the robot; model: frame → markers (m, 3).

    They are compared in measured coordinates: correcting the measurements by a depth scale would shrink their noise too, which looks like
    a better model. For intersections with a measured surface: its distance outside of the model's points along its normal, shape (k, 1).
    """
    frames, number = np.unique(scene.frame, return_inverse=True)
    each_frame = [model[k] for k in frames.tolist()]
    predicted = np.stack(each_frame)[number, scene.marker] if each_frame else np.zeros((0, 3))
    expected = as_measured(predicted, scene.view, poses, robot.observation)
    if scene.crossings is not None:
        return -scene.crossings.distance(expected)[:, None]
    turns = np.array([T[:3, :3] for T in poses])[scene.view]
    return np.asarray(np.einsum("kij,kj->ki", turns, scene.points - expected))


def rest_residual(robot: Robot, scene: Scene, poses: Sequence[FloatArray]) -> FloatArray:
    """Return measured minus declared marker placements [m], shape (r, 3)."""
    return (placements(robot, scene, poses) - robot.marker_points)[scene.rest_marker]


@dataclass(frozen=True, eq=False, slots=True)
class SceneJet:
    """Marker residuals of a scene with their derivatives."""

    residual: FloatArray
    """[m], shape (k, c): c = 3 for markers, 1 for crossings of a measured surface; so in all that follows."""
    rest: FloatArray
    """Placement residual [m], shape (r, 3)."""
    by_pose: FloatArray
    """d residual / d pose step (rotation about the pivot, shift), shape (k, 3, 6 v)."""
    rest_by_pose: FloatArray
    """shape (r, 3, 6 v)."""
    rest_by_effect: FloatArray
    """d placement residual / d coordinate of the hypothesis, shape (r, 3, p)."""
    by_initial: FloatArray
    """d residual / d initial input, shape (k, 3, a or 0)."""
    by_effect: FloatArray
    """d residual / d coordinate of the hypothesis, shape (k, 3, p)."""
    states: dict[int, Equilibrium]
    """The equilibrium of each frame."""
    by_input: FloatArray
    """d residual / d tension of the same frame, truncated at 0 or not, shape (k, c, a); (k, c, 0) if not requested."""
    pulled: BoolArray
    """Whether the derivatives count the tension of a frame as not cut off, shape (F, a)."""


def evaluate_scene(
    hypothesis: Hypothesis,
    scene: Scene,
    coordinates: FloatArray,
    poses: Sequence[FloatArray],
    initial: FloatArray | None,
    *,
    derivative: bool,
    vary_initial: bool,
    pivot: FloatArray,
    starts: dict[int, Equilibrium] | None = None,
    known: dict[int, Equilibrium] | None = None,
    vary_inputs: bool = False,
    moves: FloatArray | None = None,
    answers: dict[int, AtPoints] | None = None,
    solver: PathSolver | None = None,
) -> SceneJet:
    """Evaluate marker residuals of a scene at a point of parameter space, and their derivatives by differences.

    Each pose is moved about `pivot` by its six `moves`, shape (6 v,), and derivatives are with respect to these; without them, to a first
    move. `starts` contains states of nearby evaluations and is updated; with a rough `solver`, a frame that Newton does not reach from
    there has no equilibrium. `known` are the states at this point of parameter space; they are used if no derivative with respect to
    parameters of the body is requested. `answers`, responses of an earlier evaluation at this point, are used for derivatives with
    respect to other parameters, and updated. `vary_inputs` adds derivatives with respect to the tension of each frame (of all frames, for
    a robot with history).

    Raises:
        DataError: a frame has no equilibrium.
    """
    robot = hypothesis.robot_at(coordinates).in_recording(scene.recording.label)
    begun, moves = poses, np.zeros(6 * len(poses)) if moves is None else moves
    poses = moved_poses(begun, moves, pivot)
    base = DrivenRobot(robot, drive_of(robot, scene.recording, initial=initial))
    steps, variants = _variants(hypothesis, scene, coordinates, initial, base, vary_initial) if derivative else ([], [])
    split, last = len(hypothesis.parameters) if derivative else 0, len(variants)
    pulling = _pulling(hypothesis, base, steps, variants, scene.recording.label) if derivative and vary_inputs else []
    if any(d.robot.softening for d in (base, *variants)):
        energies = path_energies(base, int(scene.frames.max(initial=0)), starts)
        base, variants = softened(base, energies), [softened(v, energies) for v in variants]
    places = {id(robot): _ties(robot, scene, poses)}
    for v in variants:
        if id(v.robot) not in places:
            places[id(v.robot)] = places[id(robot)] if _tied_alike(v.robot, robot) else _ties(v.robot, scene, poses)

    def ties(r: Robot) -> Embedding:
        return places.get(id(r), places[id(robot)])

    states: dict[int, Equilibrium] = {}
    model: dict[int, FloatArray] = {}
    shifted: list[dict[int, FloatArray]] = [{} for _ in variants]
    if known is not None and not variants:
        states, model = known, {k: ties(robot).positions(state.positions) for k, state in known.items()}
    frames = [] if model else scene.frames.tolist()
    for k, state, seen, varied in solve_path(base, frames, ties, variants, starts=starts, answers=answers, solver=solver):
        states[k], model[k] = state, seen
        for i in range(len(variants)):
            shifted[i][k] = varied[i]
    residual = marker_residual(robot, scene, poses, model)
    columns = [(marker_residual(v.robot, scene, poses, m) - residual) / h for v, m, h in zip(variants, shifted, steps)]
    by_pose, rest_by_pose = (
        _pose_derivative(robot, scene, begun, moves, states, residual, pivot)
        if derivative
        else (np.zeros((*residual.shape, 0)), np.zeros((0, 3, 0)))
    )
    rest = rest_residual(robot, scene, poses)
    rest_columns = [(rest_residual(v.robot, scene, poses) - rest) / h for v, h in zip(variants[:split], steps)]
    pulled, by_input = inputs_wanted(robot, scene.recording, initial) >= 0.0, [columns[j] for j in pulling]
    for i, j in ((i, j) for i, j in enumerate(pulling) if j < split):
        columns[j] = columns[j] * pulled[scene.frame, i][:, None]
    return SceneJet(
        residual,
        rest,
        by_pose,
        rest_by_pose,
        _stack(rest_columns, rest),
        _stack(columns[split:last], residual),
        _stack(columns[:split], residual),
        states,
        _stack(by_input, residual),
        pulled,
    )


def _stack(columns: list[FloatArray], residual: FloatArray) -> FloatArray:
    return np.stack(columns, axis=2) if columns else np.zeros((*residual.shape, 0))


def _variants(
    hypothesis: Hypothesis,
    scene: Scene,
    coordinates: FloatArray,
    initial: FloatArray | None,
    base: DrivenRobot,
    vary_initial: bool,
) -> tuple[list[float], list[DrivenRobot]]:
    """Return steps and variants: first one for each coordinate, then one for each initial input if they vary."""
    steps, variants, label = [], [], scene.recording.label
    for j, parameter in enumerate(hypothesis.parameters):
        h = parameter.step if coordinates[j] + parameter.step <= parameter.high else -parameter.step
        steps.append(h)
        if isinstance(parameter.part, InRecording) and parameter.part.recording != label:
            variants.append(base)
            continue
        moved = coordinates.copy()
        moved[j] += h
        robot = hypothesis.robot_at(moved).in_recording(label)
        variants.append(DrivenRobot(robot, drive_of(robot, scene.recording, initial=initial)))
    names = base.robot.body.cable_names if vary_initial else ()
    start = np.zeros(len(names)) if initial is None else initial
    for i in range(len(names)):
        h = TENSION_STEP if scene.recording.actuation == "tension" else 1e-6
        moved = start.copy()
        moved[i] += h
        steps.append(h)
        variants.append(DrivenRobot(base.robot, drive_of(base.robot, scene.recording, initial=moved)))
    return steps, variants


def _pulling(hypothesis: Hypothesis, base: DrivenRobot, steps: list[float], variants: list[DrivenRobot], label: str) -> list[int]:
    """Return the variants with a slightly larger tension of each cable in every frame; none if no parameter moves tensions.

    They are added; where nothing depends on other frames, they are put in the place of those of the cables' zeros,
    whose derivative is theirs wherever a tension is not cut off.
    """
    offsets = any(effect.calibrated is not None and effect.calibrated.of_inputs for effect, _, _ in hypothesis.terms)
    driving = offsets or len(variants) > len(hypothesis.parameters)
    if base.drive.control != "tension" or not driving:
        return []
    past = bool(base.robot.creep) or any(has_history(w.robot) for w in (base, *variants))
    own = ((j, p) for j, p in enumerate(hypothesis.parameters) if p.key == "tension_n")
    zeros = {} if past else {part_in(p, label): j for j, p in own}
    chosen = []
    for i, name in enumerate(base.robot.body.cable_names):
        inputs = base.drive.inputs.copy()
        inputs[:, i] += TENSION_STEP
        driven, at = DrivenRobot(base.robot, replace(base.drive, inputs=freeze(inputs))), zeros.get(name, len(variants))
        steps[at : at + 1], variants[at : at + 1] = [TENSION_STEP], [driven]
        chosen.append(at)
    return chosen


def _pose_derivative(
    robot: Robot,
    scene: Scene,
    begun: Sequence[FloatArray],
    moves: FloatArray,
    states: Mapping[int, Equilibrium],
    residual: FloatArray,
    pivot: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of marker and placement residuals by the move of each pose;
    only placements that move need the states again."""
    columns, rest_columns = [], []
    rest = rest_residual(robot, scene, moved_poses(begun, moves, pivot))
    still = {k: robot.markers.positions(s.positions) for k, s in states.items()} if not len(scene.rest_marker) else None
    for j, h in enumerate(np.tile(POSE_STEP, len(begun))):
        further = moves.copy()
        further[j] += h
        moved = moved_poses(begun, further, pivot)
        model = still
        if model is None:
            place = robot.tie_markers(placements(robot, scene, moved))
            model = {k: place.positions(s.positions) for k, s in states.items()}
        columns.append((marker_residual(robot, scene, moved, model) - residual) / h)
        rest_columns.append((rest_residual(robot, scene, moved) - rest) / h)
    return np.stack(columns, axis=2), np.stack(rest_columns, axis=2)
