"""What another mesh of the same body makes of every state: Newton steps from the state on the first mesh, which a finer one holds exactly."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from femsense.arrays import FloatArray
from femsense.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import embed_points
from femsense.loop.joint import Trial
from femsense.march import Walk, drive_of, finer_state
from femsense.model import Robot
from femsense.parallel import each

MOST_WORK = 300_000
"""Tetrahedra × states; beyond it the nearest state that was computed stands for others."""


def moves_on(
    robot: Robot, fine: Robot, trial: Trial, places: FloatArray, initial: FloatArray | None, states: dict[int, Equilibrium]
) -> dict[int, FloatArray]:
    """Return by how much the finer mesh moves the markers in each frame [m], (m, 3), nearly. Raises DataError."""
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


__all__ = ["moves_on"]
