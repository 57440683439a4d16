"""Where residuals bend because a cable cannot push: tensions that zero, gain and log let come out below 0.

Where a log says 0 for every cable that is not used, all these frames bend at once as its zero goes through 0, and a fit that believes
in straight lines overshoots again and again. What makes them bend is known without solving anything: the tension that drives each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from femsense.arrays import FloatArray, IntArray
from femsense.calib.fit import Kinks
from femsense.calib.forward import Hypothesis, SceneJet
from femsense.loop.noise import Whitener, whiten
from femsense.march import creep_response, inputs_wanted

if TYPE_CHECKING:
    from femsense.loop.joint import Trial

DRIVING = ("cable_offset", "cable_gain", "creep")
"""Effects that change the tension that drives a frame, and leave the body as it is."""
NEAR_ZERO = 0.25
"""Tensions below this share of the largest one may come to 0 in a step."""


Part = tuple[slice, IntArray, Kinks]
"""Rows of a trial, which parameters its slopes are by, and its kinks."""


def trial_kinks(
    hypothesis: Hypothesis, trial: Trial, jet: SceneJet, factor: Whitener, own: FloatArray, coordinates: FloatArray
) -> Kinks | None:
    """Return where the residual rows of a trial bend near a point; its slopes are by the trial's own parameters, then the coordinates.

    Frames in which a cable is driven alike, and answers alike to all parameters, bend together.
    """
    if trial.scene.recording.actuation != "tension" or not jet.by_input.shape[2]:
        return None
    value, slope, response = _wanted(hypothesis, trial, own, coordinates)
    near = (value < NEAR_ZERO * value.max(axis=0).clip(1e-9)) & (np.abs(slope).max(axis=2) > 0)
    frame, cable = np.nonzero(near)
    if not len(frame):
        return None
    table = np.column_stack([cable, value[near], slope[near], jet.pulled[near]])
    _, first, group = np.unique(table.round(9), axis=0, return_index=True, return_inverse=True)
    weight = np.zeros((len(value), len(first)))
    np.add.at(weight.T, group.ravel(), response[:, frame].T)
    field = jet.by_input[:, :, cable[first]] * weight[trial.scene.frame][:, None, :]
    some = np.abs(field).max(axis=(0, 1)) > 0
    first = first[some]
    return Kinks(whiten(factor, field[:, :, some]), value[near][first], slope[near][first], jet.pulled[near][first])


def joined(parts: Sequence[Part], rows: int, width: int) -> Kinks:
    """Return the kinks of several trials together, for so many rows and parameters."""
    columns, slopes = list[FloatArray](), list[FloatArray]()
    for own, by, part in parts:
        columns.append(np.zeros((rows, len(part.value))))
        columns[-1][own] = part.columns
        slopes.append(np.zeros((len(part.value), width)))
        slopes[-1][:, by] = part.slope
    value, counted = (np.concatenate([getattr(part, name) for _, _, part in parts]) for name in ("value", "counted"))
    return Kinks(np.hstack(columns), value, np.vstack(slopes), counted)


def _wanted(
    hypothesis: Hypothesis, trial: Trial, own: FloatArray, coordinates: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the tensions that are wanted [N], (F, a), their derivatives by all parameters, (F, a, p), and what each frame is driven by
    of those of all frames, (F, F)."""
    recording = trial.scene.recording
    poses = 6 * len(trial.poses)
    initial = None if trial.initial is None else own[poses:]
    chosen = np.concatenate([np.full(len(p), e.name in DRIVING) for e, _, p in hypothesis.terms] or [np.zeros(0, bool)])
    driving = replace(hypothesis, terms=tuple(t for t in hypothesis.terms if t[0].name in DRIVING))
    at = coordinates[chosen]
    robot = driving.robot_at(at)
    value = inputs_wanted(robot, recording, initial)
    slope = np.zeros((*value.shape, len(own) + len(coordinates)))
    for i in range(0 if initial is None else len(initial)):
        slope[:, i, poses + i] = robot.actuation.gain[i]
    for j, parameter, k in zip(range(len(at)), driving.parameters, len(own) + np.flatnonzero(chosen)):
        moved = at.copy()
        moved[j] += parameter.step
        slope[:, :, k] = (inputs_wanted(driving.robot_at(moved), recording, initial) - value) / parameter.step
    return value, slope, creep_response(robot, recording)


__all__ = ["Part", "joined", "trial_kinks"]
