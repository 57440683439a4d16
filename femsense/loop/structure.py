"""What a residual still holds: tests of structure, and what it goes with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from femsense.arrays import FloatArray, IntArray
from femsense.loop.joint import Trial
from femsense.loop.noise import Noise, whiten
from femsense.model import Robot
from femsense.recording import state_key

PERMUTATIONS = 499
LEVEL = 0.01
"""Probability, over all tests together (Holm 1979), of calling mere noise structure."""


@dataclass(frozen=True, eq=False, slots=True)
class StructureTests:
    """Tests for structure in a residual; p-values as they are, not adjusted."""

    lag_one: float
    p: dict[str, float]
    """Test → p-value: neighbouring states alike, one pattern in many states, one sweep apart, one marker apart."""

    @property
    def significant(self) -> bool:
        """Whether any test stands after Holm's adjustment."""
        return min(self.p.values(), default=1.0) * len(self.p) <= LEVEL

    def document(self) -> dict[str, Any]:
        """Return the tests as plain tables."""
        return {
            "lag_one": self.lag_one,
            "p_value": min(self.p.values(), default=1.0),
            "tests": dict(self.p),
            "significant": self.significant,
        }


def structure_tests(trials: list[Trial], residuals: list[FloatArray], *, rng: np.random.Generator) -> StructureTests:
    """Return tests for structure in residuals [m], (k, 3) a trial.

    * `neighbours`: marker means and frame means removed; T = Σ r_k·r_{k+1} / Σ |r_k|² over neighbouring states of a sweep, against
      shuffles of the states within sweeps. It knows no scale, so that a wrong noise level cannot trip it.
    * `pattern`: the largest singular value of states × markers, against shuffles of each marker's states among themselves (Horn 1965).
    * `sweep`, `marker`: the sweep or marker with the largest mean square, against the same shuffles.
    """
    fields = [_field(t, r) for t, r in zip(trials, residuals)]
    observed = _lag_one(fields, None)
    p: dict[str, float] = {}
    if np.isfinite(observed):
        shuffled = np.array([_lag_one(fields, rng) for _ in range(PERMUTATIONS)])
        p["neighbours"] = _share(shuffled, observed)
    seen = np.array([_largest(fields, None)])
    null = np.array([_largest(fields, rng) for _ in range(PERMUTATIONS)])
    p |= {name: _share(null[:, i], float(seen[0, i])) for i, name in enumerate(("pattern", "sweep"))}
    return StructureTests(observed if np.isfinite(observed) else 0.0, p)


def _share(null: FloatArray, observed: float) -> float:
    return float((1 + (null >= observed - 1e-12).sum()) / (1 + len(null)))


def _largest(fields: list[tuple[FloatArray, IntArray]], rng: np.random.Generator | None) -> tuple[float, float]:
    """Return the largest singular value, and the largest mean square of a sweep, relative to all; with `rng` after shuffling."""
    singular, apart = 0.0, 0.0
    for values, sweep in fields:
        flat = values.reshape(len(values), -1)
        if rng is not None:
            markers = values.shape[1]
            order = np.argsort(rng.random((len(values), markers)), axis=0)
            flat = values[order, np.arange(markers)[None, :]].reshape(len(values), -1)
        total = float((flat**2).sum())
        if total <= 0 or len(flat) < 3:
            continue
        singular = max(singular, float(np.linalg.svd(flat, compute_uv=False)[0] ** 2 / total))
        power = (flat**2).sum(axis=1)
        means = [power[sweep == s].mean() for s in np.unique(sweep)]
        apart = max(apart, float(np.max(means) / power.mean()))
    return singular, apart


def without_mesh_error(trial: Trial, residual: FloatArray, noise: Noise) -> FloatArray:
    """Return the residual [m], (k, 3), less what of it is likeliest to be the mesh's own error."""
    if trial.mesh_error is None:
        return residual
    plain = noise.whitener(trial.groups)
    G, r = whiten(plain, trial.mesh_error), whiten(plain, residual)
    share = np.linalg.solve(np.eye(G.shape[1]) + G.T @ G, G.T @ r)
    return np.asarray(residual - trial.mesh_error @ share)


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


def describe_left(robot: Robot, trials: list[Trial], residuals: list[FloatArray]) -> dict[str, Any]:
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
