"""What a residual still holds: tests of structure, and what it goes with."""

from __future__ import annotations

from typing import Any

import numpy as np

from femsense.arrays import FloatArray, IntArray
from femsense.loop.joint import Trial
from femsense.model import Robot
from femsense.recording import state_key

PERMUTATIONS = 499


def structure_test(trials: list[Trial], residuals: list[FloatArray], *, rng: np.random.Generator) -> tuple[float, float]:
    """Return a statistic of structure in time and its permutation p-value.

    Marker means and frame means are removed; T = Σ r_k·r_{k+1} / Σ |r_k|² over neighbouring frames of a sweep, against shuffles
    of the frames within sweeps. It knows no scale, so that a wrong noise level cannot trip it.
    """
    fields = [_field(t, r) for t, r in zip(trials, residuals)]
    observed = _lag_one(fields, None)
    if not np.isfinite(observed):
        return 0.0, 1.0
    shuffled = np.array([_lag_one(fields, rng) for _ in range(PERMUTATIONS)])
    return observed, float((1 + (shuffled >= observed - 1e-12).sum()) / (1 + PERMUTATIONS))


def _field(trial: Trial, residual: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return residuals as (distinct states, markers, 3) with means removed, and the sweep of each state."""
    frames = np.unique(trial.scene.frame)
    count = int(trial.groups.marker.max()) + 1
    grid = np.full((len(frames), count, 3), np.nan)
    place = np.searchsorted(frames, trial.scene.frame)
    grid[place, trial.groups.marker] = residual
    sweep = np.zeros(len(frames), dtype=np.int64)
    sweep[place] = trial.groups.sweep
    keys = [state_key(trial.scene.recording, int(f)) for f in frames]
    first = [i for i in range(len(frames)) if i == 0 or keys[i] != keys[i - 1]]
    merged = np.array([np.nanmean(grid[a:b], axis=0) for a, b in zip(first, [*first[1:], len(frames)])])
    merged = np.nan_to_num(merged - np.nanmean(merged, axis=0, keepdims=True))
    merged = merged - merged.mean(axis=1, keepdims=True)
    return merged, sweep[first]


def _lag_one(fields: list[tuple[FloatArray, IntArray]], rng: np.random.Generator | None) -> float:
    above, below = 0.0, 0.0
    for values, sweep in fields:
        order = np.arange(len(values))
        if rng is not None:
            for s in np.unique(sweep):
                members = np.flatnonzero(sweep == s)
                order[members] = rng.permutation(members)
        v = values[order]
        same = sweep[1:] == sweep[:-1]
        above += float((v[1:] * v[:-1]).sum(axis=(1, 2))[same].sum())
        below += float((v**2).sum())
        if len(values) < 3 or not same.any():
            below += 0.0
    pairs = sum(int((s[1:] == s[:-1]).sum()) for _, s in fields)
    return above / below if below > 0 and pairs >= 4 else float("nan")


def describe_left(
    robot: Robot, trials: list[Trial], residuals: list[FloatArray], statistic: float, p_value: float
) -> dict[str, Any]:
    """Return what the remaining residual looks like: size, where, and what it goes with."""
    marker = np.concatenate([t.scene.marker for t in trials])
    size = np.concatenate([np.linalg.norm(r, axis=1) for r in residuals])
    per_marker = {robot.marker_names[m]: float(np.sqrt((size[marker == m] ** 2).mean())) for m in np.unique(marker)}
    worst = max(per_marker, key=lambda name: per_marker[name])
    mean = np.mean(np.concatenate(residuals)[marker == robot.marker_names.index(worst)], axis=0)
    frame_rms, covariates, frames = _per_frame(trials, residuals)
    goes_with = _rank(frame_rms, covariates)
    top = int(np.argmax(frame_rms))
    return {
        "rms_m": float(np.sqrt((size**2).mean())),
        "marker_rms_m": per_marker,
        "where": {
            "marker": worst,
            "position_m": robot.marker_points[robot.marker_names.index(worst)].tolist(),
            "mean_residual_m": mean.tolist(),
        },
        "worst_frame": {"frame": int(frames[top]), "rms_m": float(frame_rms[top])},
        "goes_with": goes_with,
        "structure": {"lag_one": float(statistic), "p_value": float(p_value)},
    }


def _per_frame(trials: list[Trial], residuals: list[FloatArray]) -> tuple[FloatArray, dict[str, FloatArray], IntArray]:
    rms, rows, numbers = [], [], []
    for trial, residual in zip(trials, residuals):
        recording = trial.scene.recording
        for k in np.unique(trial.scene.frame):
            rms.append(np.sqrt((residual[trial.scene.frame == k] ** 2).sum(axis=1).mean()))
            numbers.append(recording.frame_numbers[k])
            change = recording.inputs[k] - recording.inputs[k - 1] if k > 0 else np.zeros(recording.inputs.shape[1])
            load = np.linalg.norm(recording.load_forces[recording.load_frame == k].sum(axis=0))
            rows.append(
                [
                    recording.time_s[k],
                    np.abs(recording.inputs[k]).sum(),
                    np.abs(recording.pressures[k]).sum(),
                    float(change.sum() < 0),
                    float(load),
                    float(np.linalg.norm(trial.scene.points[trial.scene.frame == k].mean(axis=0))),
                ]
            )
    table = np.array(rows, dtype=float)
    names = ("time", "actuation", "pressure", "unloading", "known load", "distance from the camera")
    return np.array(rms), {n: table[:, i] for i, n in enumerate(names)}, np.array(numbers)


def _rank(values: FloatArray, covariates: dict[str, FloatArray]) -> list[dict[str, Any]]:
    """Return the covariates by the strength of their rank correlation with the residual of a frame."""
    from scipy.stats import spearmanr

    result: list[dict[str, Any]] = []
    for name, covariate in covariates.items():
        if len(values) >= 5 and np.ptp(covariate) > 0 and np.ptp(values) > 0:
            answer = spearmanr(values, covariate)
            result.append({"covariate": name, "rank_correlation": float(answer.statistic), "p_value": float(answer.pvalue)})
    return sorted(result, key=lambda r: -abs(r["rank_correlation"]))[:3]
