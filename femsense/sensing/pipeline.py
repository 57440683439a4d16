"""Contacts and forces of a recording, frame by frame: each frame is the warm start of the next one if its status allows it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError, FemsenseError
from femsense.core.parallel import one_blas_thread
from femsense.io.checkpoint import Checkpoint
from femsense.model.drive import has_history
from femsense.model.linear_elements import warn_of_linear_elements
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.sensing.baseline.published_method import sense_as_published
from femsense.sensing.contact_free import learn
from femsense.sensing.estimate_frame import Clock, sense
from femsense.sensing.model import Candidates
from femsense.sensing.options import SensingMethod, SensingOptions
from femsense.sensing.places import near_places
from femsense.sensing.prepare import make_sensor
from femsense.sensing.states import free_state
from femsense.sensing.status import Status
from femsense.sensing.tracks import smoothed
from femsense.sensing.types import (
    ContactForce,
    Done,
    FrameReport,
    LoadComparison,
    Run,
    SensedFrame,
    Sensor,
    States,
)

CHECKPOINT_S = 10.0
"""Interval between checkpoints [s]."""


@one_blas_thread()
def estimate(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
    keep: tuple[str | Path, Mapping[str, Any]] | None = None,
    keep_every_s: float = CHECKPOINT_S,
) -> Run:
    """Estimate contacts and forces in every frame: from clouds, or from markers in recordings without clouds.

    A cloud is the set of points of a depth image, in metres; from clouds the contact points are found too. Known loads (loads.csv of the
    recording) act on the model. If a known load acts within a fifth of the body's size of a point of `at`, it is not applied: the force there is
    estimated, and `Run.known_loads` compares the two.

    Arguments:
        robot: the declared robot.
        recording: clouds or markers, and inputs.
        calibration: camera poses and initial inputs.
        at: known contact points on the body at rest, robot frame [m]: one point, shape (3,), or g points, shape (g, 3). One force is
            estimated at each point in each frame. Required if the recording has markers only. Default: contact points are found in the clouds.
        options: a `SensingOptions`: method, and assumptions on contacts, noise and smoothness. Default: `SensingOptions()`.
        progress: a function, called with (frames done, number of frames).
        keep: (path, inputs) of a checkpoint. An interrupted estimate resumes from it if the stored inputs are the same. It is removed at the
            end.
        keep_every_s: interval between checkpoints [s].

    Returns:
        the run: `contacts` lists one `ContactForce` per contact and frame, with force and standard deviation [N]; `frames` the status of each
        frame; `states` the deformed bodies.

    Raises:
        InputError: neither clouds nor `at`.
        DataError: no frame has a result.

    Example:
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> recording = fs.load_recording(fs.robot_names()["finger"] / "recordings" / "press")  # installed with femsense
        >>> run = fs.estimate(robot, recording, fs.calibrate(robot, recording), at=[[0.088, 0.0, 0.014]])
        >>> [(contact.frame, round(contact.force_n, 1)) for contact in run.contacts]  # force [N] at one point, pressed in three frames
        [(9, 0.1), (10, 0.3), (11, 0.2)]
        >>> round(run.contacts[2].std_n, 1)  # N: in frame 11 the standard deviation exceeds the force, which is not determined
        0.3
    """
    if robot.softening:
        warnings.warn(
            "the effect `softening` is not used in sensing: frames after a larger load come out as if nothing had softened",
            stacklevel=2,
        )
    warn_of_linear_elements(robot.body, where=robot.name)
    method = _method(robot, recording, calibration, at, options or SensingOptions())
    sensor, count = method.sensor, len(recording.time_s)
    with Checkpoint(keep) as checkpoint:
        done = checkpoint.kept(Done) or Done()
        if done.reports:
            method.candidates.state, method.candidates.answers = done.answered_at, None
        for k in range(len(done.reports), count):
            _sense_into(done, method, k)
            done.answered_at = method.candidates.state
            if progress is not None:
                progress(k + 1, count)
            checkpoint.keep(done, every=keep_every_s)
    if all(np.isnan(report.rms_before_m) for report in done.reports):
        raise DataError(f"not one of {count} frames gave a result; the first: {done.reports[0].status}")
    mesh = robot.body.mesh
    contacts = smoothed(done.contacts, sensor.options.smooth_s)
    return Run(
        contacts=tuple(contacts),
        frames=tuple(done.reports),
        states=States(recording.time_s, np.asarray(done.states, dtype=np.float32), mesh.tets, mesh.nodes),
        robot=robot,
        recording_folder=recording.folder,
        known_loads=_compare_loads(recording, sensor.places, contacts, sensor.size),
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Method:
    """The method of a recording: its function of a frame, and its constants."""

    sensor: Sensor
    sense: Callable[[int, SensedFrame | None], SensedFrame]
    """(index of a frame, previous frame) → the frame. Raises FemsenseError."""
    candidates: Candidates = field(default_factory=Candidates)


def _method(
    robot: Robot, recording: Recording, calibration: Calibration, at: npt.ArrayLike | None, options: SensingOptions
) -> _Method:
    sensor = make_sensor(robot, recording, calibration, at=at, options=options)
    if options.method == SensingMethod.paper:
        return _Method(sensor, partial(sense_as_published, sensor))
    model = learn(sensor)
    return _Method(model.sensor, partial(sense, model), model.candidates)


def _sense_into(done: Done, method: _Method, k: int) -> None:
    """Append frame k. A state that is not trusted is not the warm start of the next frame."""
    sensor = method.sensor
    try:
        if not _is_measured(sensor, k):
            _predict_into(done, sensor, k)
            return
        frame = method.sense(k, done.last)
        done.reports.append(frame.report)
        done.contacts.extend(_named(done, frame.contacts))
        done.states.append(frame.state.positions)
        named = tuple(done.contacts[len(done.contacts) - len(frame.contacts) :])
        done.last = replace(frame, contacts=named) if frame.trusted else under_inputs(frame)
    except (FemsenseError, np.linalg.LinAlgError) as error:
        done.reports.append(_failed(sensor, k, error))
        done.states.append(sensor.robot.body.mesh.nodes if done.last is None else done.last.free_state.positions)


def under_inputs(frame: SensedFrame) -> SensedFrame:
    """Return a frame reduced to its inputs: the warm start of the next frame if the forces are not trusted. Friction depends on it."""
    return replace(frame, touches=(), state=frame.free_state, forces=np.zeros((0, 3)), contacts=(), tau=np.zeros(0))


def _is_measured(sensor: Sensor, k: int) -> bool:
    """Return whether frame k has a cloud or a marker."""
    recording = sensor.recording
    return any(file is not None for file in recording.cloud_files[k]) or bool((recording.marker_frame == k).any())


def _predict_into(done: Done, sensor: Sensor, k: int) -> None:
    """Append frame k as predicted by the model, without a measurement."""
    clock, last = Clock(), done.last
    before = last.state.segment_tensions if last is not None and has_history(sensor.robot) else None
    state = free_state(sensor, k, None if last is None else last.free_state, before)
    number, stamp, nan = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k]), float("nan")
    done.reports.append(
        FrameReport(
            number, stamp, Status.PREDICTED.value, 0, 0, nan, nan, clock.total_ms, dict(state.tension), dict(state.pressure), {}
        )
    )
    done.states.append(state.positions)


def _named(done: Done, contacts: Sequence[ContactForce]) -> list[ContactForce]:
    """Return the contacts with numbers for new tracks."""
    result = []
    for contact in contacts:
        if contact.track < 0:
            contact = replace(contact, track=done.tracks)
            done.tracks += 1
        result.append(contact)
    return result


def _failed(sensor: Sensor, k: int, error: Exception) -> FrameReport:
    what = f"its equations have no solution: {error}" if isinstance(error, np.linalg.LinAlgError) else str(error)
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    nan = float("nan")
    body = sensor.robot.body
    return FrameReport(
        number,
        stamp,
        " ".join(what.split()),
        0,
        0,
        nan,
        nan,
        nan,
        dict.fromkeys(body.cable_names, nan),
        dict.fromkeys(body.chamber_names, nan),
    )


def _compare_loads(
    recording: Recording, places: FloatArray, contacts: Sequence[ContactForce], size: float
) -> tuple[LoadComparison, ...]:
    """Return declared and estimated resultants of the frames with known loads at the given contact points."""
    near = near_places(recording.load_points, places, size)
    result = []
    for k, number in enumerate(recording.frame_numbers):
        rows = near & (recording.load_frame == k)
        sensed = [c.force_n_xyz for c in contacts if c.frame == number]
        if rows.any() and sensed:
            declared = float(np.linalg.norm(recording.load_forces[rows].sum(axis=0)))
            found = float(np.linalg.norm(np.sum(sensed, axis=0)))
            result.append(LoadComparison(int(number), declared, found, 100 * (found / declared - 1)))
    return tuple(result)
