"""The F test of lack of fit against pure error, from states that are reached again."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.loop.data.trial import Trial
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.result.evidence import LackOfFit, Tested
from femsense.loop.result.records import Structure
from femsense.model.recording import state_key

REPEATS = 6
"""Degrees of freedom of the pure error at least."""


def tested(trials: list[Trial], residuals: list[FloatArray], fit: JointFit, structure: Structure) -> Tested:
    """Return the tests of residuals [m], (k, c) a trial, that a fit leaves."""
    return Tested(structure, lack_of_fit(trials, residuals, len(fit.fit.theta)), fit.rms)


def lack_of_fit(trials: list[Trial], residuals: list[FloatArray], parameters: int) -> LackOfFit | None:
    """Return the F test of lack of fit against pure error; None where too little is repeated.

    A repeat is a state that is reached again from the same state before it; frames of one stay in a state are averaged first, since
    they share their error. F = [Σ n c̄² / (cells − parameters)] / [Σ (c − c̄)² / (stays − cells)] over the cells (state, marker).
    """
    from scipy.stats import f as fisher

    lack, pure, cells, stays = 0.0, 0.0, 0, 0
    for trial, residual in zip(trials, residuals):
        for values in _cells(trial, residual):
            mean = values.mean(axis=0)
            lack += len(values) * float(mean @ mean)
            pure += float(((values - mean) ** 2).sum())
            cells, stays = cells + len(mean), stays + len(mean) * len(values)
    own, free = cells - parameters, stays - cells
    if free < REPEATS or own < 1 or pure <= 0:
        return None
    ratio = (lack / own) / (pure / free)
    error = float(np.sqrt(max(r.shape[1] for r in residuals) * pure / free))
    return LackOfFit(ratio, float(fisher.sf(ratio, own, free)), own, free, error)


def _stays(trial: Trial) -> dict[int, tuple[int, tuple[bytes, bytes]]]:
    """Return for each frame the number of its stay, and what distinguishes states: the state and the one before it."""
    recording = trial.scene.recording
    keys = [state_key(recording, k) for k in range(len(recording.time_s))]
    result, stay, past = {}, 0, b""
    for k, key in enumerate(keys):
        if k > 0 and key != keys[k - 1]:
            stay, past = stay + 1, keys[k - 1]
        result[k] = (stay, (key, past))
    return result


def _cells(trial: Trial, residual: FloatArray) -> list[FloatArray]:
    """Return for each state and marker the mean residuals of its stays [m], (n, c)."""
    stays = _stays(trial)
    sums: dict[tuple[tuple[bytes, bytes], int], dict[int, list[FloatArray]]] = {}
    for k, m, r in zip(trial.scene.frame, trial.scene.marker, residual):
        stay, state = stays[int(k)]
        sums.setdefault((state, int(m)), {}).setdefault(stay, []).append(r)
    return [np.array([np.mean(rows, axis=0) for rows in cell.values()]) for cell in sums.values()]


def repeats(trial: Trial) -> int:
    """Return how many stays repeat an earlier one."""
    stays = _stays(trial)
    seen = {stays[int(k)] for k in trial.scene.frames}
    return len(seen) - len({state for _, state in seen})
