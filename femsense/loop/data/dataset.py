"""The data of the loop: recordings, checked, split by sweeps, with a first calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.calibrate import calibrated_start, usable_frames
from femsense.calib.first_poses import first_poses
from femsense.calib.inputs import first_inputs, input_bounds
from femsense.core.arrays import FloatArray, IntArray, diagonal, spread_evenly
from femsense.core.errors import DataError, InputError
from femsense.loop.data.holdout import hold_out, sweeps_of
from femsense.loop.data.surface_rows import (
    SMOOTH,
    SURFACE_POINTS,
    cloud_frames,
    make_rows,
    read_clouds,
    surface_normals,
    with_surface,
)
from femsense.loop.data.trial import Groups, States, SurfaceRows, Trial, normals_of
from femsense.loop.options import Measured
from femsense.loop.thresholds import DEFAULTS, EFFORT, Effort, Thresholds
from femsense.model.as_it_is import evaluate_robot
from femsense.model.effects import CALIBRATED, EFFECTS, FORMS, Effect, Entry
from femsense.model.observation import Scene, make_scene, rest_residual, with_rest_markers
from femsense.model.recording import Recording, state_key
from femsense.model.recording_checks import camera_text, check_against
from femsense.model.remeshing import robot_on_mesh
from femsense.model.robot import Robot

MAX_ROWS = 3000
"""Maximum number of marker rows per recording, and of cloud rows; beyond it whole frames are left out."""
MESH = next(effect for effect in EFFECTS if effect.remeshes)
"""The effect that refines the mesh."""
QUADRATIC: Entry = {"element": "tet10"}
"""The element order of the search if linear elements are declared (see `search/element_order.py`)."""


@dataclass(frozen=True, eq=False, slots=True)
class Data:
    """Recordings, split. If both markers and clouds of a recording are used, they are two consecutive trials."""

    robot: Robot
    """The declared robot, or the same on quadratic elements during the search; with surface points after its markers if clouds are used."""
    control: str
    train: list[Trial]
    held: list[Trial]
    held_of: list[int | None]
    """Index of the training trial whose pose a held-out trial shares; None: it gets its own."""
    split: list[str]
    placement_std: float
    input_scale: FloatArray
    """Typical range of each cable's input [N] or [m], shape (a,)."""
    declared: Robot
    """The robot as passed in."""
    forms: tuple[Effect, ...] = FORMS
    """Effects that may be tried, including user-defined ones."""
    outliers: tuple[tuple[int, str], ...] = ()
    """Frame numbers and marker names of the removed outliers."""
    mesh_note: str = ""
    """Why the discretisation error is unknown; empty if it is known."""
    mesh_as_shown: bool = False
    """Whether the discretisation error is scaled to the share that the data show, after they have shown that the declared mesh suffices."""
    relative: bool = False
    """Whether the residuals of a reference are subtracted from the markers. They were computed with the declared modulus and inputs, so these are not
    fitted."""
    thresholds: Thresholds = DEFAULTS
    """Decision thresholds."""
    effort: Effort = EFFORT
    """Limits of the computational effort."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Kinds of measurements: "markers", "clouds" or both."""
        kinds = {"markers" if t.scene.crossings is None else "clouds" for t in self.train}
        return tuple(sorted(kinds, reverse=True))

    def with_trials(self, of: Callable[[Trial], Trial]) -> Data:
        """Return the data with a function applied to each trial, fitted and held out."""
        return replace(self, train=[of(t) for t in self.train], held=[of(t) for t in self.held])

    @property
    def settled(self) -> tuple[tuple[Effect, Entry], ...]:
        """Effects that the search assumes and that are not declared: quadratic elements."""
        return ((MESH, QUADRATIC),) if self.robot.body.mesh.is_quadratic != self.declared.body.mesh.is_quadratic else ()

    @property
    def robot_as_declared(self) -> Robot:
        """The robot on its declared mesh."""
        return robot_on_mesh(self.robot, self.declared.body.mesh) if self.settled else self.robot


def prepare(
    robot: Robot, recordings: Sequence[Recording], validation: Sequence[Recording], measured: Measured = Measured.auto
) -> Data:
    """Check the recordings, split them, and calibrate each for starting values.

    Arguments:
        robot: the declared robot.
        recordings: to fit.
        validation: to hold out.
        measured: which measurements are fitted, see `Measured`.

    Raises:
        InputError: invalid arguments.
        DataError: the data do not allow a fit.
    """
    if not recordings:
        raise InputError("no recording", where="recordings", expected="at least one recording")
    if measured not in list(Measured):
        raise InputError("unknown kind of measurements", where="measured", found=measured, expected=", ".join(Measured))
    recordings = [check_against(robot, r) for r in recordings]
    validation = [check_against(robot, r) for r in validation]
    control = recordings[0].actuation
    if any(r.actuation != control for r in [*recordings, *validation]):
        raise InputError(
            "recordings differ in actuation",
            where="recordings",
            found=[r.actuation for r in [*recordings, *validation]],
            expected="all tension or all displacement",
        )
    used = [_frames_of(r, measured) for r in [*recordings, *validation]]
    declared, robot = robot, with_surface(robot) if any(len(clouds) for _, clouds in used) else robot
    train: list[Trial] = []
    held: list[Trial] = []
    held_of: list[int | None] = []
    words: list[str] = []
    for recording, kinds in zip(recordings, used):
        frames = np.union1d(*kinds)
        fitted, kept, description = (
            (frames, frames[:0], "all frames fitted; held out: other recordings") if validation else hold_out(recording, frames)
        )
        if not len(kept) and not validation:
            raise DataError("one frame is too few to hold anything out: record more frames, or give --validation")
        first = len(train)
        for one, later in _trials(robot, declared, recording, kinds, fitted, kept):
            train.append(one)
            if later is not None:
                held.append(replace(later, together=bool(held) and later.together and held_of[-1] == first))
                held_of.append(first)
        words.append(description)
    for recording, kinds in zip(validation, used[len(recordings) :]):
        frames = np.union1d(*kinds)
        for one, _ in _trials(robot, declared, recording, kinds, frames, frames[:0], first_only=True):
            held.append(one)
            held_of.append(None)
        words.append("validation recording")
    rest = [r for t in train for r in [_rest_std(robot, t)] if r is not None]
    scale = np.max([np.ptp(r.inputs, axis=0) if r.inputs.size else np.zeros(len(robot.body.cables)) for r in recordings], axis=0)
    placement_std = float(np.sqrt(np.mean(np.square(rest)))) if rest else 1e-3
    return Data(robot, control, train, held, held_of, words, placement_std, scale, declared)


def _frames_of(recording: Recording, measured: Measured) -> tuple[IntArray, IntArray]:
    """Return the frames with used markers, and those with used clouds. Raises DataError if there are none."""
    usable = usable_frames(recording)
    none = usable[:0]
    marked = none if measured == Measured.clouds else usable[np.isin(usable, recording.marker_frame)]
    cloudy = none if measured == Measured.markers else np.intersect1d(usable, cloud_frames(recording))
    if len(marked) and measured == Measured.auto:
        cloudy = none
    if not len(marked) and not len(cloudy):
        raise DataError(_nothing(recording, measured))
    rows = int(np.isin(recording.marker_frame, marked).sum())
    thinned = marked[:: max(1, int(np.ceil(rows / MAX_ROWS)))]
    return thinned, cloudy[spread_evenly(len(cloudy), 2 * MAX_ROWS // SURFACE_POINTS)]


def _nothing(recording: Recording, measured: Measured) -> str:
    wanted = measured if measured in (Measured.markers, Measured.clouds) else "markers or clouds"
    has = {"markers": bool(len(recording.marker_frame)), "clouds": recording.has_clouds}
    if not any(has[kind] for kind in has if kind in wanted):
        return f"the recording has no {wanted}: the loop needs markers.csv, clouds/ or depth/ in contact-free frames (or frames with declared loads)"
    return f"no contact-free frame has {wanted}: the loop needs {wanted} in contact-free frames (or frames with declared loads)"


def marked_frames(recording: Recording) -> IntArray:
    """Return the frames whose markers are fitted, thinned out. Raises DataError if there are none."""
    return _frames_of(recording, Measured.markers)[0]


def _trials(
    robot: Robot,
    declared: Robot,
    recording: Recording,
    kinds: tuple[IntArray, IntArray],
    fitted: IntArray,
    kept: IntArray,
    *,
    first_only: bool = False,
) -> list[tuple[Trial, Trial | None]]:
    """Return the (fitted, held out) trials of a recording: its markers and its clouds, with a calibration as starting values.

    `first_only` fits the pose on the first frames.
    """
    marked, cloudy = kinds
    cases = fitted[: max(1, round(0.2 * len(fitted)))] if first_only else fitted
    poses, initial, states = _start(declared, recording, cases)
    low, high = input_bounds(robot, recording)
    every = np.union1d(fitted, kept)
    mesh = declared.body.mesh
    starts = {id(mesh.tets): (mesh, states)} if states else {}

    def trial(scene: Scene, frames: IntArray) -> Trial:
        return Trial(
            scene, groups_of(scene, frames, surface_of(robot, scene, poses)), poses, initial, low, high, starts, frames=frames
        )

    result: list[tuple[Trial, Trial | None]] = []
    if len(np.intersect1d(marked, fitted)):
        later = np.intersect1d(marked, kept)
        result.append(
            (
                trial(make_scene(robot, recording, np.intersect1d(marked, fitted)), fitted),
                trial(make_scene(robot, recording, later), kept) if len(later) else None,
            )
        )
    if not len(np.intersect1d(cloudy, fitted)):
        return result
    empty = _bare_scene(robot, recording, np.intersect1d(cloudy, every), with_rest=not result)
    states = evaluate_robot(robot, empty, poses, initial).states
    seen = read_clouds(robot, recording, states, poses)
    pair: list[Trial | None] = []
    for frames in (fitted, kept):
        own = {k: s for k, s in states.items() if k in frames}
        scene = make_rows(robot, empty, seen, own, list(poses)) if own else None
        pair.append(None if scene is None else replace(trial(scene, frames), together=bool(result), seen=seen))
    assert pair[0] is not None
    result.append((pair[0], pair[1]))
    return result


def _start(robot: Robot, recording: Recording, frames: IntArray) -> tuple[tuple[FloatArray, ...], FloatArray | None, States]:
    """Return poses, initial inputs and states as starting values: from a calibration if there are markers, else as declared.

    Raises:
        InputError: neither markers, nor a declared pose.
    """
    unknown = recording.actuation_zero == "unknown" and bool(robot.body.cables)
    if np.isin(recording.marker_frame, frames).any():
        poses, inputs, states = calibrated_start(robot, recording, frames)
        return poses, inputs if unknown else None, states
    initial = first_inputs(robot, recording)
    if recording.rest is not None:
        return tuple(first_poses(robot, _bare_scene(robot, recording, frames, with_rest=True))), initial, {}
    missing = [camera_text(name) for name, T in zip(recording.camera_names, recording.T_robot_camera) if T is None]
    if missing:
        raise InputError(
            "without markers, clouds need a known camera pose",
            where=recording.folder,
            found=f"no T_robot_camera of {', '.join(missing)}, no markers.csv, no rest.csv",
            expected="T_robot_camera in recording.toml (maps camera coordinates to robot coordinates; accurate to a few millimetres and degrees)",
            hint="or record three markers in one frame, or measure markers at rest (rest.csv)",
        )
    return tuple(T for T in recording.T_robot_camera if T is not None), initial, {}


def _bare_scene(robot: Robot, recording: Recording, frames: IntArray, *, with_rest: bool) -> Scene:
    """Return a scene of some frames, without rows."""
    none, nowhere = np.zeros(0, np.int64), np.zeros((0, 3))
    scene = Scene(recording, frames, none, none, none, nowhere, none, none, nowhere)
    return with_rest_markers(robot, scene) if with_rest else scene


def surface_of(robot: Robot, scene: Scene, poses: Sequence[FloatArray]) -> SurfaceRows | None:
    """Return the position and the normals of the rows of a scene on the body; None for markers."""
    if scene.crossings is None:
        return None
    keys = {k: state_key(scene.recording, int(k)).hex() for k in np.unique(scene.frame)}
    states = np.unique([keys[f] for f in scene.frame], return_inverse=True)[1]
    at_rest = surface_normals(robot, robot.body.mesh.nodes)[scene.marker - len(robot.glued_names)]
    return SurfaceRows(
        robot.marker_points[scene.marker], normals_of(scene, poses), at_rest, states, SMOOTH * diagonal(robot.body.mesh.nodes)
    )


def groups_of(scene: Scene, frames: IntArray | None = None, surface: SurfaceRows | None = None) -> Groups:
    """Return the grouping of the rows of a scene by marker, frame, sweep and state; sweeps are counted among `frames`, by default those of the scene.

    `surface`: position of the rows on the body if they are of clouds.
    """
    recording = scene.recording
    frames = scene.frames if frames is None else frames
    keys = {k: state_key(recording, int(k)) for k in np.unique(scene.frame)}
    sweep = dict(zip(frames.tolist(), sweeps_of(recording, frames)))
    state = np.unique([f"{m}:{keys[f].hex()}" for m, f in zip(scene.marker, scene.frame)], return_inverse=True)[1]
    return Groups(
        np.unique(scene.marker, return_inverse=True)[1],
        np.unique(scene.frame, return_inverse=True)[1],
        np.array([sweep[int(f)] for f in scene.frame], dtype=np.int64),
        state,
        surface,
    )


def _rest_std(robot: Robot, trial: Trial) -> float | None:
    if not len(trial.scene.rest_marker):
        return None
    return max(float(np.sqrt((rest_residual(robot, trial.scene, trial.poses) ** 2).mean())), 1e-4)


NUISANCE = CALIBRATED
"""Effects that every fit includes, because calibration may adjust them: the modulus and the input offsets."""
