"""What the mesh itself costs: how far a mesh of half the size would move the markers, in every state.

A residual of that shape says nothing of the robot, whatever its size: how much of it a body shows is not known (a cable that is tied to points
sinks the deeper the finer the mesh is), but it is the same share in all sweeps. So it counts as noise, once its size as standard deviation for
all sweeps together and `VARIES` times for each by itself, so that no effect is named for what a finer mesh would explain. A Newton step or two
from the state on the declared mesh, which the finer one holds exactly, give it (a hierarchical estimate: Bank & Smith 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from femsense.arrays import FloatArray
from femsense.calib.forward import Hypothesis, evaluate_scene, seats
from femsense.effects.shape import finer_mesh, robot_on_mesh
from femsense.errors import DataError, FemsenseError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import embed_points
from femsense.loop.data import Data
from femsense.loop.joint import Trial, normals_of
from femsense.loop.stages import Stage, placed
from femsense.march import Walk, drive_of, finer_state
from femsense.model import Robot
from femsense.parallel import each

MOST_TETS = 24000
"""A finer mesh than this takes too long in every state."""
MOST_WORK = 300_000
"""Tetrahedra × states; beyond it the nearest state that was computed stands for others."""
VARIES = 0.25
"""The share of the error that a body shows differs by this between sweeps (standard deviation)."""


def with_mesh_errors(data: Data, stage: Stage) -> Data:
    """Return the data with the error of a quadratic mesh at a stage; without it where the mesh is linear (it is an effect then) or huge."""
    robot = stage.fit.hypothesis.robot_at(stage.fit.coordinates)
    mesh = robot.body.mesh
    if not mesh.is_quadratic or 8 * len(mesh.tets) > MOST_TETS:
        return data
    try:
        fine = robot_on_mesh(robot, finer_mesh(mesh, None, 1))
        train = [_with_error(robot, fine, t, *p) for t, p in zip(data.train, placed(data, stage.fit))]
        fitted = placed(data, stage.fit)
        own = [fitted[of] if of is not None else (t.poses, t.initial) for t, of in zip(data.held, data.held_of)]
        held = [_with_error(robot, fine, t, *p) for t, p in zip(data.held, own)]
    except FemsenseError:
        return data
    return replace(data, train=train, held=held)


def _with_error(robot: Robot, fine: Robot, trial: Trial, poses: Sequence[FloatArray], initial: FloatArray | None) -> Trial:
    places = seats(robot, trial.scene, poses)
    states = evaluate_scene(
        Hypothesis(robot), trial.scene, np.zeros(0), poses, initial, derivative=False, vary_initial=False,
        pivot=robot.marker_points.mean(axis=0), starts=trial.starts_on(robot.body.mesh),
    ).states  # fmt: skip
    return replace(trial, mesh_error=_by_sweep(trial, _moves(robot, fine, trial, places, initial, states), poses))


def _by_sweep(trial: Trial, moves: dict[int, FloatArray], poses: Sequence[FloatArray]) -> FloatArray:
    """Return the error of all sweeps together, then `VARIES` times that of each sweep [m], shape (k, c, 1 + sweeps)."""
    error = np.array([moves[int(f)][m] for f, m in zip(trial.scene.frame, trial.scene.marker)])
    if trial.scene.patches is not None:
        error = np.einsum("kc,kc->k", error, normals_of(trial.scene, poses))[:, None]
    number = np.unique(trial.groups.sweep, return_inverse=True)[1]
    fields = np.zeros((*error.shape, int(number.max()) + 2))
    fields[:, :, 0] = error
    fields[np.arange(len(error)), :, 1 + number] = VARIES * error
    return fields


def _moves(
    robot: Robot, fine: Robot, trial: Trial, places: FloatArray, initial: FloatArray | None, states: dict[int, Equilibrium]
) -> dict[int, FloatArray]:
    """Return by how much the finer mesh moves the markers in each frame [m], (m, 3)."""
    coarse_walk = Walk(robot, drive_of(robot, trial.scene.recording, initial=initial))
    fine_walk = Walk(fine, drive_of(fine, trial.scene.recording, initial=initial))
    ties = embed_points(robot.body.mesh, fine.body.mesh.nodes)
    here, there = robot.tie_markers(places), fine.tie_markers(places)
    frames = sorted(states)
    vectors = _state_vectors(trial, frames)
    chosen = _representatives(vectors, max(8, MOST_WORK // len(fine.body.mesh.tets)))
    known, settled = [], []

    def finer_at(i: int) -> FloatArray | None:
        return finer_state(coarse_walk, fine_walk, frames[i], states[frames[i]], ties)

    finer_states = [finer_at(chosen[0]), *each(finer_at, chosen[1:])]  # the first makes what all of them share
    for i, finer in zip(chosen, finer_states):
        if finer is not None:
            settled.append(i)
            known.append(there.positions(finer) - here.positions(states[frames[i]].positions))
    if not known:
        raise DataError("no state settles on the finer mesh")
    nearest = np.asarray(cKDTree(vectors[settled]).query(vectors)[1])
    return {k: known[j] for k, j in zip(frames, nearest)}


def _state_vectors(trial: Trial, frames: list[int]) -> FloatArray:
    """Return inputs, pressures, gravity and total load of each frame, each in units of its range, shape (f, q)."""
    recording = trial.scene.recording
    load = np.zeros((len(recording.time_s), 3))
    np.add.at(load, recording.load_frame, recording.load_forces)
    gravity = np.zeros((len(load), 0)) if recording.gravity is None else recording.gravity
    table = np.hstack([recording.inputs, recording.pressures, gravity, load])[frames]
    return np.asarray(table / np.maximum(np.ptp(table, axis=0), 1e-12))


def _representatives(vectors: FloatArray, most: int) -> list[int]:
    """Return indices of distinct states, at most so many, spread widely (farthest-point sampling)."""
    chosen = [0]
    distance = np.linalg.norm(vectors - vectors[0], axis=1)
    while len(chosen) < most and distance.max() > 1e-9:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(vectors - vectors[chosen[-1]], axis=1))
    return chosen


__all__ = ["with_mesh_errors"]
