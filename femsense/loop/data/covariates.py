"""Covariates of a residual: inputs, their direction and history, time, load, gravity and depth, one number per frame.

Rank correlations describe a residual; no decision depends on them. Neighbouring frames are not independent, so their p-values are too small even after
Holm's adjustment (1979).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.loop.result.records import Correlation
from femsense.model.observation import Scene
from femsense.model.recording import Recording

FEWEST = 5
"""Minimum number of frames for a rank correlation."""
EACH_INPUT = 8
"""With more cables or chambers than this, none is listed by itself."""


def actuation_of(recording: Recording) -> FloatArray:
    """Return the total actuation of each frame, shape (F,): the sum of all inputs, pressures scaled to the range of the inputs; without inputs the load."""
    parts = [np.abs(table - table.min(axis=0)).sum(axis=1) for table in (recording.inputs, recording.pressures) if table.size]
    moving = [part for part in parts if np.ptp(part) > 0]
    if not moving:
        return load_of(recording)
    return np.asarray(sum(part * np.ptp(moving[0]) / np.ptp(part) for part in moving))


def load_of(recording: Recording) -> FloatArray:
    """Return the magnitude of the known load of each frame [N], shape (F,)."""
    total = np.zeros((len(recording.time_s), 3))
    np.add.at(total, recording.load_frame, recording.load_forces)
    return np.asarray(np.linalg.norm(total, axis=1))


def unloading(recording: Recording) -> BoolArray:
    """Return in which frames the actuation decreases, shape (F,); during a hold the direction is that of the motion before it."""
    change = np.sign(np.diff(actuation_of(recording), prepend=0.0))
    moved = np.flatnonzero(change)
    last = np.searchsorted(moved, np.arange(len(change)), side="right") - 1
    return np.asarray(np.where(last >= 0, change[moved[np.maximum(last, 0)]] < 0, False)) if len(moved) else change < 0


def covariates_of(scene: Scene) -> dict[str, FloatArray]:
    """Return the covariates that vary, name → one value per frame of a scene, shape (f,)."""
    recording, frames = scene.recording, scene.frames
    drive, back = actuation_of(recording), unloading(recording)
    turned = np.flatnonzero(np.diff(back.astype(int), prepend=int(back[0])) != 0)
    since = (
        recording.time_s
        - recording.time_s[np.concatenate([[0], turned])[np.searchsorted(turned, np.arange(len(back)), side="right")]]
    )
    step = np.diff(recording.time_s, prepend=recording.time_s[0] - 1.0)
    table = {
        "time": recording.time_s,
        "actuation": drive,
        "unloading": back.astype(float),
        "speed of the inputs": np.abs(np.diff(drive, prepend=drive[0])) / np.maximum(step, 1e-9),
        "time since the last reversal": since,
        "largest actuation so far": np.maximum.accumulate(drive),
        "known load": load_of(recording),
    }
    for kind, names, values in (
        ("cable", recording.cable_names, recording.inputs),
        ("chamber", recording.chamber_names, recording.pressures),
    ):
        table |= {f"{kind} {name}": values[:, j] for j, name in enumerate(names) if len(names) <= EACH_INPUT}
    if recording.gravity is not None:
        table |= {f"gravity {axis}": recording.gravity[:, j] for j, axis in enumerate("xyz")}
    picked = {name: np.asarray(values, dtype=float)[frames] for name, values in table.items()}
    order = np.searchsorted(frames, scene.frame)
    count = np.maximum(np.bincount(order, minlength=len(frames)), 1)
    distance = np.linalg.norm(scene.points, axis=1)
    picked["distance from the camera"] = np.bincount(order, distance, minlength=len(frames)) / count
    return picked


def stacked(tables: list[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    """Concatenate the covariates of several scenes; one that a scene lacks is left out."""
    common = [name for name in tables[0] if all(name in table for table in tables)] if tables else []
    return {name: np.concatenate([table[name] for table in tables]) for name in common}


def rank_with(values: FloatArray, covariates: Mapping[str, FloatArray]) -> list[Correlation]:
    """Return Spearman's correlation of a number per frame with each covariate, the strongest first, p-values adjusted after Holm (1979)."""
    from scipy.stats import spearmanr

    rows = list[tuple[str, float, float]]()
    for name, covariate in covariates.items():
        if len(values) >= FEWEST and np.ptp(covariate) > 0 and np.ptp(values) > 0:
            answer = spearmanr(values, covariate)
            rows.append((name, float(answer.statistic), float(answer.pvalue)))
    largest, found = 0.0, list[Correlation]()
    for i, (name, correlation, p) in enumerate(sorted(rows, key=lambda row: row[2])):
        largest = max(largest, min(1.0, (len(rows) - i) * p))
        found.append(Correlation(name, correlation, p, largest))
    order = {name: i for i, name in enumerate(covariates)}
    return sorted(found, key=lambda row: (-abs(row.rank_correlation), order[row.covariate]))
