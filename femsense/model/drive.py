"""The drive of a robot in a recording: true inputs (after zero, gain, play and creep), pressures, gravity and known loads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.fem.body import BodyModel
from femsense.fem.mesh import Embedding, TetMesh, embed_points
from femsense.model.recording import Recording
from femsense.model.robot import Robot


@dataclass(frozen=True, eq=False, slots=True)
class Drive:
    """The true inputs of the robot in each frame: recorded inputs after offset, gain, play and creep."""

    control: str
    """"tension" or "displacement"."""
    inputs: FloatArray
    """[N] or [m], shape (F, a), in the order of the body's cables."""
    gravity: FloatArray | None
    """[m/s²], shape (F, 3); None: that of the body."""
    load_frame: IntArray
    """Frame index of each known load, shape (L,)."""
    load_points: FloatArray
    """Where it acts, at rest [m], shape (L, 3)."""
    load_forces: FloatArray
    """[N], shape (L, 3), creep included."""
    pressures: FloatArray
    """[Pa], shape (F, c), in the order of the body's chambers, creep included."""
    load_ties: Embedding
    """Where the mesh carries each known load."""
    softness: FloatArray | None = None
    """Share of its modulus that each element has in each frame [1], shape (F, m); None: all of it."""


def drive_of(robot: Robot, recording: Recording, *, initial: FloatArray | None = None) -> Drive:
    """Return the drive of a robot in a recording.

    Arguments:
        robot: the robot with its effects.
        recording: inputs, loads and gravity of each frame.
        initial: initial inputs [N] or [m], shape (a,), added to the recorded ones (for `actuation_zero = "unknown"`).

    Returns:
        the drive.
    """
    robot = robot.in_recording(recording.label)
    inputs = inputs_wanted(robot, recording, initial)
    if recording.actuation == "tension":
        inputs = _creep(np.maximum(inputs, 0.0), recording.time_s, robot.creep)
    frame, points, forces = _creep_loads(recording, robot.creep)
    order = [recording.chamber_names.index(name) for name in robot.body.chamber_names] if recording.chamber_names else []
    pressures = recording.pressures[:, order] if order else np.zeros((len(recording.time_s), len(robot.body.chambers)))
    act = robot.actuation
    pressures = _creep(act.pressure_gain * pressures + act.pressure_offset, recording.time_s, robot.creep)
    ties = _load_ties(robot.body.mesh, points)
    return Drive(recording.actuation, freeze(inputs), recording.gravity, frame, points, forces, freeze(pressures), ties)


def inputs_wanted(robot: Robot, recording: Recording, initial: FloatArray | None = None) -> FloatArray:
    """Return recorded inputs after zero, gain and play [N] or [m], shape (F, a); a tension below zero pulls like none."""
    names, act = robot.body.cable_names, robot.in_recording(recording.label).actuation
    order = [recording.cable_names.index(name) for name in names] if recording.cable_names else []
    recorded = recording.inputs[:, order] if order else np.zeros((len(recording.time_s), len(names)))
    recorded = recorded + (0.0 if initial is None else initial)
    if recording.actuation == "tension":
        return np.asarray(act.scaled(recorded) + act.tension_offset)
    return np.asarray(act.scaled(recorded) + act.displacement_offset - act.slack)


def creep_response(robot: Robot, recording: Recording) -> FloatArray:
    """Return the matrix from commanded to effective inputs of all frames, shape (F, F)."""
    return _creep(np.eye(len(recording.time_s)), recording.time_s, robot.creep)


def _load_ties(mesh: TetMesh, points: FloatArray) -> Embedding:
    """Return the ties of loads to the mesh; each place is looked up once, because all variants need the same ones."""
    return _ties_at(mesh, points.tobytes())


@lru_cache(maxsize=4)
def _ties_at(mesh: TetMesh, points: bytes) -> Embedding:
    places, number = np.unique(np.frombuffer(points).reshape(-1, 3), axis=0, return_inverse=True)
    return embed_points(mesh, places)[number.ravel()]


def _creep(values: FloatArray, time_s: FloatArray, terms: tuple[tuple[float, float], ...]) -> FloatArray:
    """Return values (F, k) with J(t) = 1 + Σ f (1 − exp(−t/τ)) on every change; linear between frames,
    crept out before the first."""
    result = values.copy()
    for fraction, tau in terms:
        flow = values[0].copy()
        result[0] += fraction * flow
        for k in range(1, len(values)):
            dt = time_s[k] - time_s[k - 1]
            decay = np.exp(-dt / tau)
            slope = (values[k] - values[k - 1]) / dt
            flow = values[k] - slope * tau * (1.0 - decay) + (flow - values[k - 1]) * decay
            result[k] += fraction * flow
    return result


def _creep_loads(recording: Recording, terms: tuple[tuple[float, float], ...]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return frame, place and force of the known loads with creep;
    a load that is taken off goes on acting while it creeps back."""
    if not terms or not len(recording.load_frame):
        return recording.load_frame, recording.load_points, recording.load_forces
    places, number = np.unique(recording.load_points, axis=0, return_inverse=True)
    table = np.zeros((len(recording.time_s), len(places), 3))
    np.add.at(table, (recording.load_frame, number.ravel()), recording.load_forces)
    crept = _creep(table.reshape(len(table), -1), recording.time_s, terms).reshape(table.shape)
    frame, place = np.nonzero(np.abs(crept).max(axis=2) > 0)
    return frame, places[place], crept[frame, place]


@dataclass(frozen=True, eq=False, slots=True)
class DrivenRobot:
    """A robot and its drive: the input of a quasi-static path."""

    robot: Robot
    drive: Drive


def body_in(driven: DrivenRobot, frame: int) -> BodyModel:
    """Return the body in a frame: under the gravity of that frame, and softened by its load history."""
    body, drive = driven.robot.body, driven.drive
    body = body if drive.gravity is None else body.with_gravity(drive.gravity[frame])
    return body if drive.softness is None else body.with_stiffness_scale(drive.softness[frame])


def has_history(robot: Robot) -> bool:
    """Return whether the state depends on the history (friction along a cable)."""
    return any(cable.friction > 0 for cable in robot.body.cables)


def frame_loads(driven: DrivenRobot, frame: int) -> FloatArray | None:
    """Return the nodal forces of the known loads of a frame [N], shape (n, 3); None where there are none."""
    rows = np.flatnonzero(driven.drive.load_frame == frame)
    if not len(rows):
        return None
    return driven.drive.load_ties[rows].spread(driven.drive.load_forces[rows], len(driven.robot.body.mesh.nodes))


def frame_key(driven: DrivenRobot, frame: int) -> bytes:
    """Return a key by which the drives of two frames are compared."""
    drive = driven.drive
    rows = drive.load_frame == frame
    parts = [drive.inputs[frame], drive.pressures[frame], drive.load_points[rows].ravel(), drive.load_forces[rows].ravel()]
    parts += [table[frame] for table in (drive.gravity, drive.softness) if table is not None]
    return np.concatenate([np.asarray(p, dtype=float) for p in parts]).tobytes()
