"""Repeated states: their differences are noise, whatever the model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.data.trial import Trial
from femsense.model.repeats import State, squares_about_mean, stays_of

Cell = tuple[State, int]
"""A state with its predecessor, and a marker."""


def rows_of_stays(trial: Trial, residual: FloatArray) -> dict[Cell, dict[int, FloatArray]]:
    """Return the residuals of each stay in each state, by marker: cell → stay → [m], (frames, c)."""
    stays = stays_of(trial.scene.recording)
    rows: dict[Cell, dict[int, list[FloatArray]]] = {}
    for k, m, r in zip(trial.scene.frame, trial.scene.marker, residual):
        stay, state = stays[int(k)]
        rows.setdefault((state, int(m)), {}).setdefault(stay, []).append(r)
    return {cell: {stay: np.array(own) for stay, own in of.items()} for cell, of in rows.items()}


def repeated_means(trial: Trial, residual: FloatArray) -> list[FloatArray]:
    """Return the mean residuals of the stays in each state and marker [m], (stays, c)."""
    return [np.array([own.mean(axis=0) for own in of.values()]) for of in rows_of_stays(trial, residual).values()]


def count_repeats(trial: Trial) -> int:
    """Return the number of stays that repeat an earlier one."""
    stays = stays_of(trial.scene.recording)
    seen = {stays[int(k)] for k in trial.scene.frames}
    return len(seen) - len({state for _, state in seen})


def scatter_of_repeats(trials: Sequence[Trial], residuals: Sequence[FloatArray]) -> tuple[float, int]:
    """Return the standard deviation along each axis of rows of one marker in one state [m], and its degrees of freedom.

    It is the larger of two estimates: frames of one stay vary with the frame; means of stays in one state vary also with the sweep.
    """
    within, between = np.zeros(2), np.zeros(2)
    for trial, residual in zip(trials, residuals):
        for of in rows_of_stays(trial, residual).values():
            within += squares_about_mean(np.concatenate(list(of.values())))
            between += squares_about_mean(np.array([own.mean(axis=0) for own in of.values()]))
    known = [(float(np.sqrt(square / count)), int(count)) for square, count in (within, between) if count]
    return max(known, default=(0.0, 0))
