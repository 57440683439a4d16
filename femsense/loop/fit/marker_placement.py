"""Marker placement: the error of a marker's declared place rotates with the body.

If the body bends by 60°, so does the placement error: constant in body coordinates, it is not constant in space. Treated as a constant vector it
would leave residuals correlated with the bending, which resemble other effects.
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
from femsense.loop.fit.discretisation_error import as_shown
from femsense.loop.fit.fitted_model import FittedModel, poses_and_inputs
from femsense.model.observation import placements
from femsense.model.robot import Robot


def with_turning_placements(data: Data, fitted: FittedModel) -> Data:
    """Return the data with the rotation of marker placements in the states of a fitted model; nothing is solved."""
    robot = fitted.fit.hypothesis.robot_at(fitted.fit.coordinates)
    train = [
        _turned(robot, t, poses, j.states)
        for t, (poses, _), j in zip(data.train, poses_and_inputs(data, fitted.fit), fitted.fit.jets)
    ]
    held = [_turned(robot, t, h.poses, h.jet.states) for t, h in zip(data.held, fitted.held)]
    return replace(data, train=train, held=held)


def with_errors_as_shown(data: Data, fitted: FittedModel) -> Data:
    """Return the data with the discretisation error scaled, and the marker placements rotated, as in a fitted model (`as_shown`, `with_turning_placements`)."""
    return with_turning_placements(as_shown(data, fitted), fitted)


def _turned(robot: Robot, trial: Trial, poses: Sequence[FloatArray], states: Mapping[int, Equilibrium]) -> Trial:
    """Return the markers of a trial with the rotation of their placements; clouds unchanged."""
    if trial.scene.crossings is not None:
        return trial
    places = placements(robot, trial.scene, poses)
    by_frame = {k: placement_turns(robot, places, state.positions) for k, state in states.items()}
    turns = np.array([by_frame[int(k)][m] for k, m in zip(trial.scene.frame, trial.scene.marker)]).reshape(-1, 3, 3)
    return replace(trial, groups=replace(trial.groups, turns=turns))


def placement_turns(robot: Robot, places: FloatArray, positions: FloatArray) -> FloatArray:
    """Return ∂(marker position)/∂(its place at rest), shape (m, 3, 3), axes of the place last, for node positions [m], shape (n, 3): the deformation
    gradient at the markers, places [m], shape (m, 3)."""
    mesh = robot.body.mesh
    ties = robot.tie_markers(places)
    gradient = np.einsum("pkc,pka->pca", positions[ties.nodes], weight_slopes(mesh, ties, places))
    share = 1.0 if robot.marker_share is None else robot.marker_share[:, None, None]
    return np.asarray(share * gradient + (1.0 - share) * np.eye(3))
