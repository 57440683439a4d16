"""The frames of a run: status, residual, time, tensions and pressures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray
from femsense.report import words
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    MANY,
    SERIES,
    SOFT,
    add_legend,
    as_image,
    clipped,
    name_axes,
    new_axes,
    whole_numbers,
)
from femsense.sensing.types import FrameReport

LISTED = 40


def column(rows: Sequence[Any], name: str) -> FloatArray:
    """Return a field of each row as an array, shape (n,)."""
    return np.array([getattr(row, name) for row in rows], dtype=np.float64)


def median_of(values: FloatArray) -> float:
    """Return the median of the finite values; nan where there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def statuses(frames: Sequence[FrameReport]) -> list[tuple[str, list[int]]]:
    """Return each status with its frames: "ok" first, then the most frequent."""
    counts = Counter(frame.status for frame in frames)
    ordered = sorted(counts, key=lambda status: (status != "ok", -counts[status]))
    return [(status, [frame.frame for frame in frames if frame.status == status]) for status in ordered]


def frame_pictures(frames: Sequence[FrameReport]) -> list[Markup | None]:
    """Return residual, time, tensions and pressures over the frames."""
    if all(frame.status != "ok" for frame in frames):
        return []
    tensions = _drive_panel(frames, "tension_n", "tension [N]", "Tension of the cables")
    pressures = _drive_panel(frames, "pressure_pa", "pressure [Pa]", "Pressure in the chambers")
    return [_residual_panel(frames), _time_panel(frames), tensions, pressures]


def _residual_panel(frames: Sequence[FrameReport]) -> Markup | None:
    before, after = (column(frames, name) for name in ("rms_before_m", "rms_after_m"))
    if not np.isfinite(before).any():
        return None
    figure, axes = new_axes()
    for values, color, name in ((before, BEFORE, "without forces"), (after, AFTER, "with the forces")):
        _dots(axes, frames, 1e3 * values, color, name)
    axes.set_ylim(0.0, 1.08 * max(1e3 * float(np.nanmax([before, after])), 1e-9))
    whole_numbers(axes)
    name_axes(axes, "frame", "rms residual [mm]")
    add_legend(axes)
    medians = [words.length(median_of(values)) for values in (before, after)]
    return as_image(
        figure,
        alt=f"Residual of each frame without and with the contact forces; medians {medians[0]} and {medians[1]}.",
        caption=f"Residual of the model; median {medians[0]} without forces, {medians[1]} with them.",
    )


def _dots(axes: Any, frames: Sequence[FrameReport], values: FloatArray, color: str, name: str) -> None:
    size = 3.8 if len(frames) <= 150 else 2.0
    at, many = column(frames, "frame"), len(frames) > MANY
    axes.plot(at, values, "o", color=color, markersize=size, markeredgewidth=0, label=name, rasterized=many)


def _time_panel(frames: Sequence[FrameReport]) -> Markup | None:
    ms = column(frames, "ms")
    times = ms[np.isfinite(ms)]
    if not len(times):
        return None
    figure, axes = new_axes()
    _dots(axes, frames, ms, SERIES[0], "one frame")
    median = float(np.median(times))
    axes.axhline(median, color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="median")
    axes.set_ylim(0.0, 1.08 * float(times.max()))
    whole_numbers(axes)
    name_axes(axes, "frame", "time [ms]")
    add_legend(axes)
    span = f"median {words.number(median)} ms, {words.number(float(times.min()))} to {words.number(float(times.max()))} ms"
    return as_image(figure, alt=f"Computing time of each frame: {span}.", caption=f"Computing time of each frame; {span}.")


def _drive_panel(frames: Sequence[FrameReport], field: str, label: str, title: str) -> Markup | None:
    """Draw the tensions or pressures, a field of the frames that maps names to values."""
    drives = {name: np.array([getattr(frame, field)[name] for frame in frames]) for name in getattr(frames[0], field)}
    shown = [(name, values) for name, values in drives.items() if np.isfinite(values).any()][: len(SERIES)]
    if not shown:
        return None
    figure, axes = new_axes()
    at, many = column(frames, "frame"), len(frames) > MANY
    for color, (name, values) in zip(SERIES, shown):
        axes.plot(at, values, color=color, linewidth=1.5, label=clipped(name, 14), rasterized=many)
    whole_numbers(axes)
    name_axes(axes, "frame", label)
    add_legend(axes, columns=min(len(shown), 4))
    return as_image(figure, alt=f"{title} {', '.join(name for name, _ in shown)} over the frames.", caption=f"{title}.")
