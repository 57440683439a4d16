"""What the mesh itself costs: how far a mesh of half the size would move the markers, in every state.

A residual of that shape says nothing of the robot. It counts as noise, once its size as standard deviation, so that no effect is named
for what a finer mesh would explain. A Newton step or two from the state on the declared mesh, which the finer one holds exactly,
give it (a hierarchical estimate: Bank & Smith 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from femsense.arrays import FloatArray
from femsense.calib.forward import Hypothesis, evaluate_scene, seats
from femsense.effects.shape import finer_mesh, robot_on_mesh
from femsense.errors import FemsenseError
from femsense.loop.data import Data
from femsense.loop.finer import moves_on
from femsense.loop.joint import Trial, normals_of
from femsense.loop.stages import Stage, placed
from femsense.model import Robot

MOST_TETS = 24000
"""A finer mesh than this takes too long in every state."""


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
    return replace(trial, mesh_error=_by_sweep(trial, moves_on(robot, fine, trial, places, initial, states), poses))


def _by_sweep(trial: Trial, moves: dict[int, FloatArray], poses: Sequence[FloatArray]) -> FloatArray:
    """Return the error as one field a sweep [m], (k, c, sweeps): each sweep loads the mesh in its own way."""
    error = np.array([moves[int(f)][m] for f, m in zip(trial.scene.frame, trial.scene.marker)])
    if trial.scene.patches is not None:
        error = np.einsum("kc,kc->k", error, normals_of(trial.scene, poses))[:, None]
    number = np.unique(trial.groups.sweep, return_inverse=True)[1]
    fields = np.zeros((*error.shape, int(number.max()) + 1))
    fields[np.arange(len(error)), :, number] = error
    return fields


__all__ = ["with_mesh_errors"]
