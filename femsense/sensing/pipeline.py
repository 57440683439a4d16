"""Contacts and forces of a recording, frame by frame.

scan ─ rays on the surface under the inputs ─► rows ─► what objects touch, what the shape betrays ─► places
places ─► equilibrium ─ rays ─ compliance ─ QP, until the forces stop changing ─► judged ─► contacts with their tracks
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
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
from femsense.sensing import estimate_frame
from femsense.sensing.contact_free import learn
from femsense.sensing.false_alarms import with_gains_of_free_frames
from femsense.sensing.judge import (
    OK,
    behind_body,
    beside_markers,
    objects_known,
    seen_elsewhere,
    status_of,
    sure_forces,
    trusted,
)
from femsense.sensing.moved_camera import camera_status
from femsense.sensing.paper import sense_as_published
from femsense.sensing.places import away_from_scenery, near_places, object_touches, seen_objects
from femsense.sensing.prepare import first_sensor, prepare, scan_of
from femsense.sensing.run_arrays import sensed
from femsense.sensing.search import explain
from femsense.sensing.separation import segmented
from femsense.sensing.states import foretold, free_state
from femsense.sensing.tracks import contacts_of, smoothed
from femsense.sensing.types import (
    ContactForce,
    Done,
    FrameReport,
    LoadComparison,
    Run,
    SensedFrame,
    SensingOptions,
    Sensor,
    States,
)

CHECKPOINT_S = 10.0
"""Seconds of work that a killed estimate may lose, if nothing else is asked for."""


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
    """Find contacts and forces in every frame: from clouds, or from markers where there are none.

    Known loads (loads.csv) act on the model, except those within a fifth of the body's size of a given place: these are what
    is to be sensed, and `known_loads` compares.

    Arguments:
        robot: the robot.
        recording: clouds or markers, and inputs.
        calibration: pose and initial inputs.
        at: places of contact at rest [m], shape (g, 3); needed where there are only markers.
        options: assumptions.
        progress: called with (frames done, frames in all).
        keep: a file that holds the frames that are done, so that an estimate that is killed goes on there, and what it is made from: a file that
            says something else is not used. It is removed at the end.
        keep_every_s: seconds of work that a killed estimate may lose.

    Raises:
        InputError: no clouds and no places; DataError: not one frame gave a result.
    """
    if robot.softening:
        warnings.warn(
            "the effect `softening` is not used in sensing: frames after a larger load come out as if nothing had softened",
            stacklevel=2,
        )
    warn_of_linear_elements(robot.body, where=robot.name)
    sense, sensor = _senser(robot, recording, calibration, at, options or SensingOptions())
    count = len(recording.time_s)
    with Checkpoint(keep) as checkpoint:
        done = checkpoint.kept(Done) or Done()
        sensor.answers.state = done.answered_at
        for k in range(len(done.reports), count):
            _sense_into(done, sense, sensor, k)
            done.answered_at = sensor.answers.state
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


def _senser(
    robot: Robot, recording: Recording, calibration: Calibration, at: npt.ArrayLike | None, options: SensingOptions
) -> tuple[Callable[[Sensor, int, SensedFrame | None], SensedFrame], Sensor]:
    """Return what estimates one frame by the method that is asked for, and what stays the same over the frames."""
    if options.method == "evidence":
        model = learn(first_sensor(robot, recording, calibration, at=at, options=options))
        return lambda _, k, previous: estimate_frame.sense(model, k, previous), model.sensor
    prepared = prepare(robot, recording, calibration, at=at, options=options)
    if options.method == "paper":
        return sense_as_published, prepared.sensor
    return sense_frame, prepared.sensor if len(prepared.sensor.places) else with_gains_of_free_frames(prepared)


def sense_frame(sensor: Sensor, k: int, previous: SensedFrame | None) -> SensedFrame:
    """Return contacts and forces of frame k, starting from the frame before.

    Raises:
        FemsenseError: a broken file, nothing of the robot in view, or no equilibrium.
    """
    clock = _Clock()
    before = previous.state.segment_tensions if previous is not None and has_history(sensor.robot) else None
    alone = free_state(sensor, k, None if previous is None else previous.free_state, before)
    clock.lap("equilibrium")
    near = foretold(previous, alone)
    whole = scan_of(sensor, k, near)
    clock.lap("scan")
    scan, free = segmented(sensor, k, whole, alone, previous, before)
    clock.lap("rows")
    shapes = seen_objects(sensor, k, scan, near)
    clock.lap("places")
    scan, fit, free = explain(sensor, k, whole, scan, shapes, free, previous, before)
    clock.lap("forces")
    contacts = contacts_of(sensor, k, fit, alone, previous)
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    status = status_of(sensor, fit, free)
    if scan is not None and not len(sensor.places):
        status = camera_status(sensor, k, scan, fit, free, before, status)
    if status == OK and scan is not None and not scan.segmented:
        status = behind_body(sensor, scan, fit)
    if status == OK and fit.rows.of_clouds:
        status = beside_markers(sensor, k, fit)
    if status == OK and not len(sensor.places):
        all_seen = fit.touches and all(touch.source == "cloud" for touch in fit.touches)
        seen = [] if all_seen else object_touches(sensor, [s for s in shapes if s.kind != "points"], fit.state)
        touching = away_from_scenery(sensor, fit.touches or seen)
        status = objects_known(fit, touching, seen_elsewhere(sensor, fit, seen))
    report = FrameReport(
        number,
        stamp,
        status,
        len(sensed(contacts)),
        fit.rows.count,
        free.rows.rms,
        fit.rows.rms,
        clock.total(),
        dict(fit.state.tension),
        dict(fit.state.pressure),
        clock.stages,
    )
    sure = sure_forces(fit)
    return SensedFrame(
        fit.touches, fit.state, fit.forces, alone, report, contacts, sure, fit.response, free.response, trusted=trusted(status)
    )


class _Clock:
    """How long each stage takes."""

    def __init__(self) -> None:
        self.began = self.last = time.perf_counter()
        self.stages: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.stages[name], self.last = 1e3 * (now - self.last), now

    def total(self) -> float:
        return 1e3 * (time.perf_counter() - self.began)


def _sense_into(done: Done, sense: Callable[..., SensedFrame], sensor: Sensor, k: int) -> None:
    """Add a frame to those that are done; a wrong state is not handed on as the start of the next one."""
    try:
        if not _is_measured(sensor, k):
            _predict_into(done, sensor, k)
            return
        frame = sense(sensor, k, done.last)
        done.reports.append(frame.report)
        done.contacts.extend(_named(done, frame.contacts))
        done.states.append(frame.state.positions)
        named = tuple(done.contacts[len(done.contacts) - len(frame.contacts) :])
        done.last = replace(frame, contacts=named) if frame.trusted else _under_inputs(frame)
    except (FemsenseError, np.linalg.LinAlgError) as error:
        done.reports.append(_failed(sensor, k, error))
        done.states.append(sensor.robot.body.mesh.nodes if done.last is None else done.last.free_state.positions)


def _under_inputs(frame: SensedFrame) -> SensedFrame:
    """Return a frame as the inputs alone have it: what the next one starts from where its forces are not trusted (friction remembers it)."""
    forces, response = np.zeros((0, 3)), frame.free_response
    return replace(frame, touches=(), state=frame.free_state, forces=forces, contacts=(), sure=(), response=response)


PREDICTED = "no marker and no cloud: the model's prediction under the inputs"
"""Status of a frame without markers and cloud."""


def _is_measured(sensor: Sensor, k: int) -> bool:
    """Return whether frame k has a cloud or a marker."""
    recording = sensor.recording
    return any(file is not None for file in recording.cloud_files[k]) or bool((recording.marker_frame == k).any())


def _predict_into(done: Done, sensor: Sensor, k: int) -> None:
    """Add frame k as the model has it where nothing was measured."""
    clock, last = _Clock(), done.last
    before = last.state.segment_tensions if last is not None and has_history(sensor.robot) else None
    state = free_state(sensor, k, None if last is None else last.free_state, before)
    number, stamp, nan = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k]), float("nan")
    done.reports.append(
        FrameReport(number, stamp, PREDICTED, 0, 0, nan, nan, clock.total(), dict(state.tension), dict(state.pressure), {})
    )
    done.states.append(state.positions)


def _named(done: Done, contacts: Sequence[ContactForce]) -> list[ContactForce]:
    """Return contacts with numbers for those that begin a track."""
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
    """Return declared next to sensed resultants of the frames whose loads act at the given places."""
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
