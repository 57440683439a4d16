"""Marker placement: a marker that is glued elsewhere than declared, or a dot that is found a little beside its middle, turns with the body.

Where a body bends by 60°, the error of a place turns by as much: what is the same vector in all frames on the body is none in space. Taken for one, it
leaves residuals that go with the bending, and these look like a marker that is far off, or like anything else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.equilibrium import Equilibrium
from femsense.fem.mesh import weight_slopes
from femsense.loop.data.dataset import Data
from femsense.loop.data.trial import Trial
from femsense.loop.fit.fitted_model import FittedModel, poses_and_inputs
from femsense.model.observation import placements
from femsense.model.robot import Robot


def with_turning_placements(data: Data, fitted: FittedModel) -> Data:
    """Return the data with how the places of markers turn where a fitted model has the body; nothing is solved."""
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    train = [
        _turned(robot, t, poses, j.states)
        for t, (poses, _), j in zip(data.train, poses_and_inputs(data, fitted.fit), fitted.fit.jets)
    ]
    held = [_turned(robot, t, h.poses, h.jet.states) for t, h in zip(data.held, fitted.held)]
    return replace(data, train=train, held=held)


def _turned(robot: Robot, trial: Trial, poses: Sequence[FloatArray], states: Mapping[int, Equilibrium]) -> Trial:
    """Return the markers of a trial with how their places turn; clouds as they are."""
    if trial.scene.crossings is not None:
        return trial
    places = placements(robot, trial.scene, poses)
    by_frame = {k: placement_turns(robot, places, state.positions) for k, state in states.items()}
    turns = np.array([by_frame[int(k)][m] for k, m in zip(trial.scene.frame, trial.scene.marker)]).reshape(-1, 3, 3)
    return replace(trial, groups=replace(trial.groups, turns=turns))


def placement_turns(robot: Robot, places: FloatArray, positions: FloatArray) -> FloatArray:
    """Return by how much the markers of a robot move if their places at rest [m], shape (m, 3), do, for node positions [m], shape (n, 3): the
    deformation gradient there, shape (m, 3, 3), axes of the place last."""
    mesh = robot.body.mesh
    ties = robot.tie_markers(places)
    gradient = np.einsum("pkc,pka->pca", positions[ties.nodes], weight_slopes(mesh, ties, places))
    share = 1.0 if robot.marker_share is None else robot.marker_share[:, None, None]
    return np.asarray(share * gradient + (1.0 - share) * np.eye(3))
