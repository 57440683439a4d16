"""The data of the loop: recordings, checked, split by sweeps, and calibrated for a start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.arrays import FloatArray, IntArray
from femsense.calib.calibrate import calibrate, input_bounds, usable_frames
from femsense.calib.forward import Scene, make_scene, rest_residual
from femsense.effects import FORMS, Effect
from femsense.errors import DataError, InputError
from femsense.loop.joint import Trial
from femsense.loop.noise import Groups
from femsense.loop.split import hold_out, sweeps_of
from femsense.model import Robot
from femsense.recording import Recording, check_against, state_key

MAX_ROWS = 3000
"""Marker rows a recording at most; more are thinned out by whole frames."""


@dataclass(frozen=True, eq=False, slots=True)
class Data:
    """Recordings, split."""

    robot: Robot
    control: str
    train: list[Trial]
    held: list[Trial]
    held_of: list[int | None]
    """The training trial whose pose a held-out trial shares; None: it gets its own."""
    split: list[str]
    seat_std: float
    input_scale: FloatArray
    """Typical range of each cable's input [N] or [m], shape (a,)."""
    forms: tuple[Effect, ...] = FORMS
    """What may be tried, a user's effects among it."""


def prepare(robot: Robot, recordings: Sequence[Recording], validation: Sequence[Recording]) -> Data:
    """Check the recordings, split them, and calibrate each for a start. Raises InputError or DataError."""
    if not recordings:
        raise InputError("nothing to learn from", where="recordings", expected="at least one recording")
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
    train: list[Trial] = []
    held: list[Trial] = []
    held_of: list[int | None] = []
    words: list[str] = []
    for i, recording in enumerate(recordings):
        frames = marked_frames(recording)
        fitted, kept, how = (
            (frames, frames[:0], "all frames fitted; held out: other recordings") if validation else hold_out(recording, frames)
        )
        if not len(kept) and not validation:
            raise DataError("one frame is too few to hold anything out: record more frames, or give --validation")
        trial = _trial(robot, recording, fitted)
        train.append(trial)
        words.append(how)
        if len(kept):
            scene = make_scene(robot, recording, kept)
            held.append(replace(trial, scene=scene, groups=groups_of(scene), starts={}))
            held_of.append(i)
    for recording in validation:
        held.append(_trial(robot, recording, marked_frames(recording), first_only=True))
        held_of.append(None)
        words.append("validation recording")
    rest = [r for t in train for r in [_rest_spread(robot, t)] if r is not None]
    scale = np.max([np.ptp(r.inputs, axis=0) if r.inputs.size else np.zeros(len(robot.body.cables)) for r in recordings], axis=0)
    return Data(robot, control, train, held, held_of, words, float(np.sqrt(np.mean(np.square(rest)))) if rest else 1e-3, scale)


def marked_frames(recording: Recording) -> IntArray:
    frames = usable_frames(recording)
    frames = frames[np.isin(frames, recording.marker_frame)]
    if not len(frames):
        raise DataError(
            "no frame with markers is free of undeclared contact: the loop needs markers in free frames (or declared loads)"
        )
    rows = int(np.isin(recording.marker_frame, frames).sum())
    return frames[:: max(1, int(np.ceil(rows / MAX_ROWS)))]


def _trial(robot: Robot, recording: Recording, frames: IntArray, *, first_only: bool = False) -> Trial:
    """Return a recording with a calibration to start from; `first_only` fits its pose on its first frames."""
    few = frames[: max(1, round(0.2 * len(frames)))] if first_only else frames
    calibration = calibrate(robot, recording, frames=few.tolist())
    scene = make_scene(robot, recording, frames)
    initial = None
    if recording.actuation_zero == "unknown" and robot.body.cables:
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        initial = np.array([table[name] for name in robot.body.cable_names])
    low, high = input_bounds(robot, recording)
    return Trial(scene, groups_of(scene), calibration.poses, initial, low, high, {})


def groups_of(scene: Scene) -> Groups:
    """Return what the rows of a scene have in common."""
    recording = scene.recording
    keys = {k: state_key(recording, int(k)) for k in np.unique(scene.frame)}
    sweep = dict(zip(scene.frames.tolist(), sweeps_of(recording, scene.frames)))
    state = np.unique([f"{m}:{keys[f].hex()}" for m, f in zip(scene.marker, scene.frame)], return_inverse=True)[1]
    return Groups(
        np.unique(scene.marker, return_inverse=True)[1],
        np.unique(scene.frame, return_inverse=True)[1],
        np.unique([sweep[int(f)] for f in scene.frame], return_inverse=True)[1],
        state,
    )


def _rest_spread(robot: Robot, trial: Trial) -> float | None:
    if not len(trial.scene.rest_marker):
        return None
    return max(float(np.sqrt((rest_residual(robot, trial.scene, trial.poses) ** 2).mean())), 1e-4)
