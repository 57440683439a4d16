"""Nonsmooth residuals of slack cables: the tension is max(0, recorded, with offset and gain).

If unused cables are recorded as 0, all their frames become slack or taut together when the offset crosses 0, and a Gauss–Newton step overshoots
repeatedly. The points of nonsmoothness follow from the recorded tensions without solving equilibria.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.local_model import Nonsmoothness
from femsense.loop.fit.noise_components import Whitener, whiten
from femsense.model.drive import creep_response, inputs_wanted
from femsense.model.observation import Hypothesis, SceneJet

if TYPE_CHECKING:
    from femsense.loop.data.trial import Trial

NEAR_ZERO = 0.25
"""Tensions below this share of the largest one may reach 0 within a step."""
ALIKE = 0.01
"""Tensions that differ by less than this share of the largest one are grouped: recordings of idle cables are noisy."""


Part = tuple[slice, IntArray, Nonsmoothness]
"""Rows of a trial, the parameters of its slopes, and its nonsmoothness."""


def trial_nonsmoothness(
    hypothesis: Hypothesis, trial: Trial, jet: SceneJet, factor: Whitener, own: FloatArray, coordinates: FloatArray
) -> Nonsmoothness | None:
    """Return the nonsmoothness of the residual rows of a trial near a point; slopes are by the trial's own parameters, then the coordinates.

    Frames with the same tension of a cable become slack together.
    """
    if trial.scene.recording.actuation != "tension" or not jet.by_input.shape[2]:
        return None
    value, slope, response = _wanted(hypothesis, trial, own, coordinates)
    largest = value.max(axis=0).clip(1e-9)
    near = (value < NEAR_ZERO * largest) & (np.abs(slope).max(axis=2) > 0)
    frame, cable = np.nonzero(near)
    if not len(frame):
        return None
    table = np.column_stack([cable, np.rint((value / largest)[near] / ALIKE), jet.pulled[near]])
    _, group, count = np.unique(table, axis=0, return_inverse=True, return_counts=True)
    share = np.zeros((len(count), len(frame)))
    share[group.ravel(), np.arange(len(frame))] = 1.0
    weight = response[:, frame] @ share.T  # effect of a group of frames on the tension of every frame (creep)
    first = share.argmax(axis=1)
    field = jet.by_input[:, :, cable[first]] * weight[trial.scene.frame][:, None, :]
    some = np.abs(field).max(axis=(0, 1)) > 0
    mean = (share / count[:, None])[some]
    return Nonsmoothness(whiten(factor, field[:, :, some]), mean @ value[near], mean @ slope[near], jet.pulled[near][first][some])


def joined(parts: Sequence[Part], rows: int, width: int) -> Nonsmoothness:
    """Return the nonsmoothness of several trials together, given the total number of rows and parameters."""
    columns, slopes = list[FloatArray](), list[FloatArray]()
    for own, by, part in parts:
        columns.append(np.zeros((rows, len(part.value))))
        columns[-1][own] = part.columns
        slopes.append(np.zeros((len(part.value), width)))
        slopes[-1][:, by] = part.slope
    value, counted = (np.concatenate([getattr(part, name) for _, _, part in parts]) for name in ("value", "counted"))
    return Nonsmoothness(np.hstack(columns), value, np.vstack(slopes), counted)


def _wanted(
    hypothesis: Hypothesis, trial: Trial, own: FloatArray, coordinates: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the commanded tensions before the limit at 0 [N], (F, a), their derivatives by all parameters, (F, a, p), and the weights of all frames'
    commands in the drive of each frame (creep), (F, F)."""
    recording = trial.scene.recording
    poses = 6 * len(trial.poses)
    initial = None if trial.initial is None else own[poses:]
    chosen = np.concatenate([np.full(len(p), e.drives) for e, _, p in hypothesis.terms] or [np.zeros(0, bool)])
    driving = replace(hypothesis, terms=tuple(t for t in hypothesis.terms if t[0].drives))
    at = coordinates[chosen]
    robot = driving.robot_at(at)
    value = inputs_wanted(robot, recording, initial)
    slope = np.zeros((*value.shape, len(own) + len(coordinates)))
    for i in range(0 if initial is None else len(initial)):
        slope[:, i, poses + i] = robot.in_recording(recording.label).actuation.gain[i]
    for j, parameter, k in zip(range(len(at)), driving.parameters, len(own) + np.flatnonzero(chosen)):
        moved = at.copy()
        moved[j] += parameter.step
        slope[:, :, k] = (inputs_wanted(driving.robot_at(moved), recording, initial) - value) / parameter.step
    return value, slope, creep_response(robot, recording)
