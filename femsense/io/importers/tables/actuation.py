"""An actuation log with its own clock, aligned with the frames by a known offset or by cross-correlation with the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.importers.journal import Journal
from femsense.io.importers.options import Options
from femsense.io.importers.tables.clock import seconds_of
from femsense.io.importers.tables.csv_tables import column_unit, read_numbers, time_column
from femsense.io.importers.tables.input_samples import samples_of
from femsense.io.importers.tables.mapping import check_targets, resolved
from femsense.io.importers.tables.plain_csv import input_columns, mapped_time, notation_notes, unit_notes

SURE = 0.6
"""Least correlation that determines the offset."""
DEVIATIONS = 5.0
"""Least distance of the correlation from zero in standard deviations (Fisher's z): of 40 random walks of 22 frames, 6 had more than 0.6."""
APART = 0.1
"""Least difference between the best correlation and the next peak."""
SMOOTH_S = 0.1
"""Averaging time of both signals before differentiation: with noise of a tenth of the motion the correlation is 0.84 instead of 0.41."""
FLAT = 1e-9
"""A signal whose variance over the overlap is below this share of its energy is constant (rounding of the transform)."""
QUARTER_S, FARTHEST_ZONE_S, ZONE_SLACK_S = 900.0, 14 * 3600.0, 120.0
"""Zones of time differ by whole quarters of an hour, up to fourteen hours; programs are started within two minutes of each other [s]."""
GRID = 4000
"""Samples of the common clock on which motion and inputs are compared, at most."""


@dataclass(frozen=True, eq=False, slots=True)
class ActuationLog:
    """Inputs over time."""

    path: Path
    time_s: FloatArray
    """On the log's clock [s], increasing, shape (n,)."""
    columns: tuple[str, ...]
    """Columns of frames.csv."""
    values: FloatArray
    """[N], [m] or [Pa], NaN where a cell is empty, shape (n, columns)."""
    actuation: str | None = None
    notes: tuple[str, ...] = ()
    """Assumptions made."""

    def at(self, times: FloatArray) -> dict[str, FloatArray]:
        """Return each column at these times of the log's clock [s], NaN where it is not known; see `Samples.at`."""
        return dict(zip(self.columns, samples_of(self.time_s, self.values).at(times).T))


def read_actuation_log(path: str | Path, options: Options) -> ActuationLog:
    """Read a CSV file with a column of time and columns of inputs.

    Arguments:
        path: the file.
        options: `columns` maps its columns; without it, those named cable_… or chamber_… are taken, else all but the time.

    Raises:
        InputError: no time, no inputs, times that go back.
    """
    file = Path(path)
    names, table = read_numbers(file)
    check_targets(options.columns)
    columns = resolved(options.columns, names)
    clock, unit = mapped_time(names, columns) or time_column(names, file)
    time_s, notes = seconds_of(table[:, clock], unit)
    direct, actuation = input_columns(names, columns, file)
    mapped = [column for column in direct if names[column.index] in columns]
    chosen = mapped or direct
    if not chosen:
        others = {n: f"cable_{column_unit(n)[0]}" for j, n in enumerate(names) if j != clock and n.lower() not in ("frame", "id")}
        chosen, actuation = input_columns(names, others, file)
    if not chosen:
        raise InputError(
            "no inputs", where=file, found=", ".join(names), expected="columns cable_… or chamber_…, or --map NAME=cable_x"
        )
    kept = np.isfinite(time_s) & np.isfinite(table[:, [column.index for column in chosen]]).any(axis=1)
    time_s = time_s[kept]
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(time_s) < 2 or len(back):
        row = int(np.flatnonzero(kept)[back[0] + 1]) + 1 if len(back) else 0
        raise InputError(
            "time does not increase",
            where=file,
            found=f"{time_s[back[0] + 1]:.6g} s after {time_s[back[0]]:.6g} s in row {row}"
            if len(back)
            else f"{len(time_s)} rows",
            expected="rows in order of time",
            hint="repeated time stamps were rounded: log more digits" if len(back) > 1 else None,
        )
    values = np.stack([column.values(table[kept]) for column in chosen], axis=1)
    notes += notation_notes(file) + unit_notes(chosen, names, columns)
    return ActuationLog(file, time_s, tuple(column.name for column in chosen), values, actuation, tuple(notes))


def align(log: ActuationLog, journal: Journal, offset: float | None) -> tuple[ActuationLog, dict[str, Any]]:
    """Return the log on the frames' clock, and a description of the alignment.

    Arguments:
        log: the inputs.
        journal: the frames, with the centre of their points.
        offset: the frames' time minus the log's [s]; None finds it.

    Raises:
        InputError: the motion does not determine the offset, or the two do not overlap.
    """
    times = journal.times()
    said: dict[str, Any] = {"actuation_log": log.path.name, "actuation_offset_from": "--offset"}
    if offset is None:
        offset, best, next_best = _offset_of_motion(log, journal, times)
        said = {
            "actuation_log": log.path.name,
            "actuation_offset_from": "correlation of motion and inputs",
            "actuation_correlation": best,
            "actuation_next_correlation": next_best,
        }
    moved = replace(log, time_s=log.time_s + offset)
    inside = (times >= moved.time_s[0]) & (times <= moved.time_s[-1])
    if not inside.any():
        raise InputError(
            "the log of actuation and the frames do not overlap",
            where=log.path,
            found=f"log {log.time_s[0]:.3f} … {log.time_s[-1]:.3f} s, frames {times[0]:.3f} … {times[-1]:.3f} s, offset {offset:g} s",
            expected="the same clock, or --offset SECONDS (frames' time minus the log's)",
            hint=_offset_hint(float(times[0] - log.time_s[0])),
        )
    return moved, {**said, "actuation_offset_s": float(offset), "frames_beyond_log": int((~inside).sum())}


def _offset_hint(apart: float) -> str:
    """Return a hint for clocks that differ by `apart` [s]: multiples of a quarter of an hour suggest time zones."""
    zone = QUARTER_S * round(apart / QUARTER_S)
    if zone and abs(zone) <= FARTHEST_ZONE_S and abs(apart - zone) < ZONE_SLACK_S:
        return f"one is in local time and the other in UTC, {abs(zone) / 3600:g} hours apart: --offset {zone:g}"
    return f"if both began together: --offset {apart:.3f}"


def _offset_of_motion(log: ActuationLog, journal: Journal, times: FloatArray) -> tuple[float, float, float]:
    """Return the offset [s], its correlation, and that of the next peak."""
    places = _places(journal)
    kept = np.isfinite(places).any(axis=1)
    if kept.sum() < 8:
        raise _unsure(log, "fewer than eight frames show the robot")
    step = max(float(np.median(np.diff(times))), (times[-1] - times[0] + np.ptp(log.time_s)) / GRID)
    motion = _activity(times[kept], places[kept], step)
    size = np.nanmax(log.values, axis=0) - np.nanmin(log.values, axis=0)
    drive = _activity(log.time_s, log.values / np.maximum(size, 1e-12), step)
    score = _correlations(motion, drive)
    best = int(np.argmax(score))
    width = max(3, len(motion) // 50)
    others = np.delete(score, np.arange(max(best - width, 0), min(best + width + 1, len(score))))
    next_best = float(others.max(initial=0.0))
    lag = best - (len(drive) - 1)
    overlap = min(len(motion), len(drive) + lag) - max(lag, 0)
    chance = np.arctanh(min(score[best], 1.0 - 1e-12)) * np.sqrt(max(overlap - 3, 0))
    if score[best] < SURE or score[best] - next_best < APART or chance < DEVIATIONS:
        found = f"the best correlation is {score[best]:.2f} over {overlap} samples, the next {next_best:.2f}"
        raise _unsure(log, found)
    return float(times[kept][0] - log.time_s[0] + lag * step), float(score[best]), next_best


def _places(journal: Journal) -> FloatArray:
    """Return the moving coordinates [m], shape (frames, columns), NaN if hidden: x, y, z of the markers visible in half of the frames;
    without such markers the centroid, which jumps when a marker is hidden."""
    centers, seen = [], list[dict[str, list[float]]]()
    for entry in journal.entries():
        centers.append(entry.center or [np.nan] * 3)
        seen.append({name: place for one in entry.seen.values() for name, place in one.markers.items()})
    counts: dict[str, int] = {}
    for markers in seen:
        for name in markers:
            counts[name] = counts.get(name, 0) + 1
    often = [name for name, count in counts.items() if 2 * count >= len(seen)]
    if not often:
        return np.array(centers, dtype=np.float64)
    lost = [np.nan] * 3
    return np.array([[x for name in often for x in markers.get(name, lost)] for markers in seen], dtype=np.float64)


def _activity(times: FloatArray, values: FloatArray, step: float) -> FloatArray:
    """Return how fast values change, on a grid of `step` [s], each value the mean over SMOOTH_S; straight over gaps (NaN)."""
    grid = np.arange(times[0], times[-1] + 0.5 * step, step)
    known = [(times[np.isfinite(column)], column[np.isfinite(column)]) for column in values.T]
    even = np.stack([np.interp(grid, when, column) for when, column in known], axis=1)
    width = max(1, min(round(SMOOTH_S / step), len(grid) // 4))
    sums = np.cumsum(np.concatenate([np.zeros((1, even.shape[1])), even]), axis=0)
    mean = (sums[width:] - sums[:-width]) / width
    return np.asarray(np.linalg.norm(np.diff(mean, axis=0), axis=1))


def _correlations(motion: FloatArray, drive: FloatArray) -> FloatArray:
    """Return Pearson's correlation over the overlap for each lag −(len(drive) − 1) … len(motion) − 1.

    It is 0 for an overlap below one half, and if one of the signals is constant in it.
    """
    from scipy.signal import fftconvolve

    ones_m, ones_d = np.ones_like(motion), np.ones_like(drive)

    def over(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(fftconvolve(a, b[::-1]))

    n = np.rint(over(ones_m, ones_d))
    sum_m, sum_d = over(motion, ones_d), over(ones_m, drive)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance = over(motion, drive) - sum_m * sum_d / n
        of_m, of_d = over(motion**2, ones_d) - sum_m**2 / n, over(ones_m, drive**2) - sum_d**2 / n
        score = covariance / np.sqrt(of_m * of_d)
    varies = (of_m > FLAT * np.sum(motion**2)) & (of_d > FLAT * np.sum(drive**2))
    enough = n >= max(8, min(len(motion), len(drive)) // 2)
    return np.where(enough & varies & np.isfinite(score), np.clip(score, -1.0, 1.0), 0.0)


def _unsure(log: ActuationLog, found: str) -> InputError:
    return InputError(
        "the motion does not determine the offset between the actuation log and the frames",
        where=log.path,
        found=found,
        expected="--offset SECONDS: the frames' time minus the log's (0 where both have one clock)",
    )
