"""Diagnostics of a residual: tests of structure, and correlations."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.loop.data.covariates import covariates_of, rank_with, stacked
from femsense.loop.data.trial import Trial, heads_of, vectors_of
from femsense.loop.result.records import FrameError, Left, Structure, WorstMarker
from femsense.loop.thresholds import DEFAULTS
from femsense.model.recording import state_key
from femsense.model.robot import Robot

PERMUTATIONS = 499
WORST_FRAMES = 5
GOES_WITH = 8
"""Maximum number of listed frames, and of covariates."""


def _structure(lag_one: float, p: dict[str, float], level: float) -> Structure:
    """Return the tests with their joint verdict: the smallest p-value times their number, compared with the level."""
    least = min(p.values(), default=1.0)
    return Structure(lag_one, least, p, least * len(p) <= level)


def structure_tests(
    trials: list[Trial], residuals: list[FloatArray], *, rng: np.random.Generator, level: float = DEFAULTS.structure
) -> Structure:
    """Return permutation tests for structure in residuals [m], (k, c) per trial; `level` is the probability of a false alarm of all tests together (Holm 1979).

    Marker means and state means are removed first. The statistics and their null distributions are

    * `neighbours`: T = Σ r_k·r_{k+1} / Σ |r_k|² over consecutive states of a sweep, under permutations of the states within sweeps. It is
      independent of the scale, so that a wrong noise level cannot cause an alarm.
    * `pattern`: the largest singular value of states × markers, relative to all, under permutations of the states of each marker (Horn 1965).
    * `sweep`: the largest mean square of a sweep, relative to all, under the same permutations.

    Errors of a cloud are correlated between neighbouring points, so that its states are permuted as a whole, and `pattern` is not tested.
    """
    if any(t.scene.crossings is not None for t in trials):
        return _cloud_tests(trials, residuals, rng, level)
    fields = [_field(t, r) for t, r in zip(trials, residuals)]
    observed = _lag_one(fields, None)
    p: dict[str, float] = {}
    if np.isfinite(observed):
        shuffled = np.array([_lag_one(fields, rng) for _ in range(PERMUTATIONS)])
        p["neighbours"] = _share(shuffled, observed)
    seen = np.array([_largest(fields, None)])
    null = np.array([_largest(fields, rng) for _ in range(PERMUTATIONS)])
    p |= {name: _share(null[:, i], float(seen[0, i])) for i, name in enumerate(("pattern", "sweep"))}
    return _structure(observed if np.isfinite(observed) else 0.0, p, level)


def _cloud_tests(trials: list[Trial], residuals: list[FloatArray], rng: np.random.Generator, level: float) -> Structure:
    """Return the tests of clouds, together with those of the markers if there are some."""
    pairs = list(zip(trials, residuals))
    marked = [(t, r) for t, r in pairs if t.scene.crossings is None]
    markers = structure_tests([t for t, _ in marked], [r for _, r in marked], rng=rng, level=level) if marked else None
    fields = [_field(t, r) for t, r in pairs if t.scene.crossings is not None]
    p = {} if markers is None else dict(markers.tests)
    observed = _lag_one(fields, None)
    if np.isfinite(observed):
        p["cloud neighbours"] = _share(np.array([_lag_one(fields, rng) for _ in range(PERMUTATIONS)]), observed)
    whole = [_largest(_shuffled(fields, rng), None)[1] for _ in range(PERMUTATIONS)]
    p["cloud sweep"] = _share(np.array(whole), _largest(fields, None)[1])
    lag = observed if np.isfinite(observed) else 0.0
    return _structure(lag if markers is None else markers.lag_one, p, level)


def _shuffled(fields: list[tuple[FloatArray, IntArray]], rng: np.random.Generator) -> list[tuple[FloatArray, IntArray]]:
    """Return fields with their states permuted as a whole."""
    return [(values[rng.permutation(len(values))], sweep) for values, sweep in fields]


def _share(null: FloatArray, observed: float) -> float:
    return float((1 + (null >= observed - 1e-12).sum()) / (1 + len(null)))


def _largest(fields: list[tuple[FloatArray, IntArray]], rng: np.random.Generator | None) -> tuple[float, float]:
    """Return the largest squared singular value and the largest mean square of a sweep, relative to all; with `rng` after a permutation."""
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


def _field(trial: Trial, residual: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return residuals as (distinct states, markers, c) with means removed, and the sweep of each state."""
    frames = np.unique(trial.scene.frame)
    count = int(trial.groups.marker.max()) + 1
    grid = np.full((len(frames), count, residual.shape[1]), np.nan)
    place = np.searchsorted(frames, trial.scene.frame)
    grid[place, trial.groups.marker] = residual
    sweep = np.zeros(len(frames), dtype=np.int64)
    sweep[place] = trial.groups.sweep
    keys = [state_key(trial.scene.recording, int(f)) for f in frames]
    first = [i for i in range(len(frames)) if i == 0 or keys[i] != keys[i - 1]]
    merged = np.array([_mean_seen(grid[a:b]) for a, b in zip(first, [*first[1:], len(frames)])])
    merged = np.nan_to_num(merged - _mean_seen(merged)[None])
    merged = merged - merged.mean(axis=1, keepdims=True)
    return merged, sweep[first]


def _mean_seen(values: FloatArray) -> FloatArray:
    """Return the mean over the first axis without NaN; NaN if all are."""
    seen = np.isfinite(values)
    count = seen.sum(axis=0)
    total = np.where(seen, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


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
    pairs = sum(int((s[1:] == s[:-1]).sum()) for _, s in fields)
    return above / below if below > 0 and pairs >= 4 else float("nan")


def describe_left(
    robot: Robot,
    trials: list[Trial],
    residuals: list[FloatArray],
    *,
    held_out: bool,
    structure: Structure,
    explained_share: float,
) -> Left:
    """Return the description of the remaining residual: size, place on the body, frames, direction, and correlations.

    The direction is the first principal direction of the residuals of the worst marker, with the sign of their mean. The others are as of `Left`.
    """
    heads = heads_of(trials)
    trials, residuals = [trials[i] for i in heads], [residuals[i] for i in heads]
    marker = np.concatenate([t.scene.marker for t in trials])
    field = np.concatenate([vectors_of(t, r) for t, r in zip(trials, residuals)])
    size = np.linalg.norm(field, axis=1)
    per_marker = {robot.marker_names[m]: float(np.sqrt((size[marker == m] ** 2).mean())) for m in np.unique(marker)}
    worst = max(per_marker, key=lambda name: per_marker[name])
    own = field[marker == robot.marker_names.index(worst)]
    frames, direction, share = frame_errors(trials, residuals), *_direction(own)
    worst_frames = sorted(frames, key=lambda frame: -frame.rms_m)
    return Left(
        rms_m=float(np.sqrt((size**2).mean())),
        marker_rms_m=per_marker,
        where=WorstMarker(
            marker=worst,
            position_m=tuple(robot.marker_points[robot.marker_names.index(worst)].tolist()),
            mean_residual_m=tuple(own.mean(axis=0).tolist()),
            direction=tuple(direction.tolist()),
            direction_share=share,
        ),
        worst_frame=worst_frames[0],
        worst_frames=tuple(worst_frames[:WORST_FRAMES]),
        half_in_frames=_share_of_half(np.array([frame.rms_m for frame in worst_frames])),
        goes_with=tuple(
            rank_with(np.array([frame.rms_m for frame in frames]), stacked([covariates_of(t.scene) for t in trials]))[:GOES_WITH]
        ),
        held_out=held_out,
        structure=structure,
        explained_share=explained_share,
    )


def frame_errors(trials: list[Trial], residuals: list[FloatArray]) -> list[FrameError]:
    """Return the residual of each frame of each recording, in order: of its markers, or if there are none, of its clouds."""
    return [
        FrameError(i, int(number), float(rms))
        for i, (t, r) in enumerate((trials[at], residuals[at]) for at in heads_of(trials))
        for number, rms in zip(t.scene.recording.frame_numbers[t.scene.frames], frame_rms(t, r))
    ]


def frame_rms(trial: Trial, residual: FloatArray) -> FloatArray:
    """Return the root mean square of a residual (k, c) in each frame of a trial [m], shape (f,)."""
    place = np.searchsorted(trial.scene.frames, trial.scene.frame)
    count = np.bincount(place, minlength=len(trial.scene.frames))
    return np.sqrt(np.bincount(place, (residual**2).sum(axis=1), minlength=len(count)) / np.maximum(count, 1))


def _direction(vectors: FloatArray) -> tuple[FloatArray, float]:
    """Return the first principal direction of vectors (k, 3) as a unit vector, and its share of their mean square."""
    _, s, Vt = np.linalg.svd(vectors, full_matrices=False)
    sign = -1.0 if float(vectors.mean(axis=0) @ Vt[0]) < 0 else 1.0
    return sign * Vt[0], float(s[0] ** 2 / max(float((s**2).sum()), 1e-300))


def _share_of_half(rms_falling: FloatArray) -> float:
    """Return the share of the frames, the worst first, that contribute half of the mean square."""
    held = np.cumsum(rms_falling**2)
    return float((np.searchsorted(held, 0.5 * held[-1]) + 1) / len(held))
