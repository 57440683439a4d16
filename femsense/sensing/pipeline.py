"""Contacts and forces of a recording, frame by frame.

cloud ─ pose ─ filter ─ segment ─► robot points, surroundings ─ detect ─► places
equilibrium under the inputs ─ match along normals (or markers) ─► rows ─ compliance ─ QP ─► forces ─┐ repeat until still
                               ▲─────────────────────────────────────────────────────────────────────┘
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray, as_points
from femsense.core.errors import DataError, FemsenseError, InputError
from femsense.core.parallel import one_blas_thread
from femsense.fem.equilibrium import Equilibrium
from femsense.io.checkpoint import Checkpoint
from femsense.model.contact_patch import ContactPatch, body_surface
from femsense.model.drive import DrivenRobot, drive_of, has_history
from femsense.model.recording import Recording, check_against
from femsense.model.robot import Robot
from femsense.qp.forces import ForceEstimate
from femsense.sensing.forces import _fit_forces, _normal, _reach, _solve
from femsense.sensing.measurement import _has_clouds, _measure, _probes, _robot_and_surroundings, _root
from femsense.sensing.places import _check_places, _find_contacts, _near_places, _same_places, _wandered
from femsense.sensing.types import ContactForce, Done, FrameReport, Run, SensedFrame, SensingOptions, Sensor, States

CHECKPOINT_S = 10.0
"""Seconds of work that a killed estimate may lose."""


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
) -> Run:
    """Find contacts and forces in every frame: from clouds, or from markers where there are none.

    Known loads (loads.csv) act on the model, except those within a fifth of the body's size of a given place: these are what
    is to be sensed, and `known_loads` compares.

    Arguments:
        robot: the robot.
        recording: clouds or markers, and inputs.
        calibration: pose and initial inputs.
        at: places of contact at rest [m], shape (g, 3); needed where there are only markers.
        options: thresholds and assumptions.
        progress: called with (frames done, frames in all).
        keep: a file that holds the frames that are done, so that an estimate that is killed goes on there, and what it is made from: a file that
            says something else is not used. It is removed at the end.

    Raises:
        InputError: no clouds and no places; DataError: not one frame gave a result.
    """
    sensor = make_sensor(robot, recording, calibration, at=at, options=options)
    count = len(recording.time_s)
    with Checkpoint(keep) as checkpoint:
        done = checkpoint.kept(Done) or Done()
        for k in range(len(done.reports), count):
            try:
                done.last = sense_frame(sensor, k, done.last)
                done.reports.append(done.last.report)
                done.contacts.extend(done.last.contacts)
            except FemsenseError as error:
                done.reports.append(_failed(sensor, k, error))
            done.states.append(robot.body.mesh.nodes if done.last is None else done.last.state.positions)
            if progress is not None:
                progress(k + 1, count)
            checkpoint.keep(done, every=CHECKPOINT_S)
    if done.last is None:
        raise DataError(f"not one of {count} frames gave a result; the first: {done.reports[0].status}")
    mesh = robot.body.mesh
    return Run(
        contacts=tuple(done.contacts),
        frames=tuple(done.reports),
        states=States(recording.time_s, np.asarray(done.states, dtype=np.float32), mesh.tets, mesh.nodes),
        robot=robot,
        recording_folder=recording.folder,
        known_loads=_compare_loads(recording, sensor.places, done.contacts, sensor.size),
    )


def make_sensor(
    robot: Robot,
    recording: Recording,
    calibration: Calibration,
    *,
    at: npt.ArrayLike | None = None,
    options: SensingOptions | None = None,
) -> Sensor:
    """Prepare what stays the same from frame to frame. Raises InputError where nothing says where to look for forces."""
    recording = check_against(robot, recording)
    places = as_points(at if at is not None else np.zeros((0, 3)), "at")
    size = float(np.linalg.norm(np.ptp(robot.body.mesh.nodes, axis=0)))
    surface = body_surface(robot.body.mesh)
    _check_places(places, surface, robot, size)
    if not _has_clouds(recording) and not len(places):
        raise InputError(
            "no clouds, and no place of contact is given",
            where=recording.folder,
            expected="clouds/, depth/, or --at X,Y,Z",
            hint="name the place at rest in metres, robot frame: --at 0.1,0,0.015",
        )
    if calibration.placements_m:
        points = robot.marker_points.copy()
        for name, placement in calibration.placements_m.items():
            if name in robot.marker_names:
                points[robot.marker_names.index(name)] = placement
        robot = robot.with_marker_points(points)
    initial = None
    if recording.actuation_zero == "unknown":
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        initial = np.array([table[name] for name in robot.body.cable_names])
    drive = drive_of(robot, recording, initial=initial)
    sensed_here = _near_places(drive.load_points, places, size)
    drive = replace(
        drive,
        load_frame=drive.load_frame[~sensed_here],
        load_points=drive.load_points[~sensed_here],
        load_forces=drive.load_forces[~sensed_here],
        load_ties=drive.load_ties[~sensed_here],
    )
    return Sensor(
        robot,
        recording,
        calibration,
        DrivenRobot(robot, drive),
        surface,
        options or SensingOptions(),
        places,
        _probes(robot, surface, options or SensingOptions()),
        _root(calibration.pose_covariance),
        size,
    )


def sense_frame(sensor: Sensor, k: int, previous: SensedFrame | None) -> SensedFrame:
    """Return contacts and forces of frame k, starting from the frame before.

    Raises:
        FemsenseError: a broken file, nothing of the robot in view, or no equilibrium.
    """
    began = time.perf_counter()
    before = previous.state.segment_tensions if previous is not None and has_history(sensor.robot) else None
    free_state = _solve(sensor, k, None, None if previous is None else previous.free_state, before)
    expected = free_state if previous is None else previous.state
    clouds = _robot_and_surroundings(sensor, k, expected) if _has_clouds(sensor.recording) else None
    if clouds is None and not (sensor.recording.marker_frame == k).any():
        return _predicted(sensor, k, free_state, began)
    patches, source = _find_contacts(sensor, k, clouds, expected)
    rows = _measure(sensor, k, clouds, free_state)
    rows = rows if clouds is None else _measure(sensor, k, clouds, free_state, _reach(sensor, rows))
    state, forces, at_end = free_state, np.zeros(0), rows
    contacts: tuple[ContactForce, ...] = ()
    if patches:
        same = previous is not None and (source == "given" or _same_places(previous, patches, expected))
        start = (previous.state, previous.forces) if previous is not None and same else None
        state, estimate, at_end = _fit_forces(sensor, k, clouds, patches, source, free_state, start, before)
        if source == "cloud":  # where it touches is clearer once the model has come near
            again, _ = _find_contacts(sensor, k, clouds, state)
            if len(again) == len(patches) and _wandered(patches, again, state) > 0.5 * sensor.surface.edge:
                patches = again
                near = (state, estimate.forces)
                state, estimate, at_end = _fit_forces(sensor, k, clouds, patches, source, free_state, near, before)
        forces = estimate.forces
        contacts = _contacts(sensor, k, patches, estimate, state, source)
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    report = FrameReport(
        number,
        stamp,
        "ok",
        len(contacts),
        at_end.count,
        rows.rms,
        at_end.rms,
        1e3 * (time.perf_counter() - began),
        dict(state.tension),
        dict(state.pressure),
    )
    return SensedFrame(state, free_state, forces, report, contacts)


PREDICTED = "no marker and no cloud: the model's prediction under the inputs"
"""Status of a frame without markers and cloud."""


def _predicted(sensor: Sensor, k: int, state: Equilibrium, began: float) -> SensedFrame:
    """Return frame k as the model has it where nothing was measured."""
    number, stamp, nan = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k]), float("nan")
    elapsed = 1e3 * (time.perf_counter() - began)
    report = FrameReport(number, stamp, PREDICTED, 0, 0, nan, nan, elapsed, dict(state.tension), dict(state.pressure))
    return SensedFrame(state, state, np.zeros(0), report, ())


# --- results -------------------------------------------------------------------------------------------------------------


def _contacts(
    sensor: Sensor, k: int, patches: Sequence[ContactPatch], estimate: ForceEstimate | None, state: Equilibrium, source: str
) -> tuple[ContactForce, ...]:
    if estimate is None:
        return ()
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    result = []
    for i, patch in enumerate(patches):
        force = estimate.forces[3 * i : 3 * i + 3]
        size = float(np.linalg.norm(force))
        normal = _normal(sensor, patch, state)
        along = force / size if size > 0 else -normal
        std = float(np.sqrt(max(float(along @ estimate.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] @ along), 0.0)))
        result.append(ContactForce(number, stamp, i, patch.mean(state.positions), normal, force, size, std, source))
    return tuple(result)


def _failed(sensor: Sensor, k: int, error: FemsenseError) -> FrameReport:
    number, stamp = int(sensor.recording.frame_numbers[k]), float(sensor.recording.time_s[k])
    nan = float("nan")
    body = sensor.robot.body
    return FrameReport(
        number,
        stamp,
        " ".join(str(error).split()),
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
) -> tuple[dict[str, float], ...]:
    """Return declared next to sensed resultants of the frames whose loads act at the given places."""
    near = _near_places(recording.load_points, places, size)
    result = []
    for k, number in enumerate(recording.frame_numbers):
        rows = near & (recording.load_frame == k)
        sensed = [c.force_n_xyz for c in contacts if c.frame == number]
        if rows.any() and sensed:
            declared = np.linalg.norm(recording.load_forces[rows].sum(axis=0))
            found = np.linalg.norm(np.sum(sensed, axis=0))
            result.append(
                {
                    "frame": int(number),
                    "declared_n": float(declared),
                    "sensed_n": float(found),
                    "error_percent": float(100 * (found / declared - 1)),
                }
            )
    return tuple(result)
