"""What became of each frame of a run: status, residual, time, tensions and pressures."""

from __future__ import annotations

from collections import Counter
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
from femsense.report.run.forces import SHOWN
from femsense.report.run.tables import FrameTable, median_of

LISTED = 40


def statuses(frames: FrameTable) -> list[tuple[str, list[int]]]:
    """Return each status with its frames: "ok" first, then the most frequent."""
    counts = Counter(frames.status)
    return [
        (status, [int(frame) for frame, own in zip(frames.frame, frames.status) if own == status])
        for status in sorted(counts, key=lambda status: (status != "ok", -counts[status]))
    ]


def frame_pictures(frames: FrameTable | None) -> list[Markup | None]:
    """Return residual, time, tensions and pressures over the frames."""
    if frames is None or not frames.good.any():
        return []
    tensions = _drive_panel(frames, frames.tension_n, "tension [N]", "Tension of the cables")
    pressures = _drive_panel(frames, frames.pressure_pa, "pressure [Pa]", "Pressure in the chambers")
    return [_residual_panel(frames), _time_panel(frames), tensions, pressures]


def _residual_panel(frames: FrameTable) -> Markup | None:
    if not np.isfinite(frames.before_m).any():
        return None
    figure, axes = new_axes()
    for values, color, name in ((frames.before_m, BEFORE, "without forces"), (frames.after_m, AFTER, "with the forces")):
        _dots(axes, frames, 1e3 * values, color, name)
    axes.set_ylim(0.0, 1.08 * max(1e3 * float(np.nanmax([frames.before_m, frames.after_m])), 1e-9))
    whole_numbers(axes)
    name_axes(axes, "frame", "rms residual [mm]")
    add_legend(axes)
    before, after = (words.length(median_of(values)) for values in (frames.before_m, frames.after_m))
    return as_image(
        figure,
        alt=f"Residual of each frame without and with the contact forces; medians {before} and {after}.",
        caption=f"Residual of the model; median {before} without forces, {after} with them.",
    )


def _dots(axes: Any, frames: FrameTable, values: FloatArray, color: str, name: str) -> None:
    size = 3.8 if len(frames) <= 150 else 2.0
    axes.plot(
        frames.frame, values, "o", color=color, markersize=size, markeredgewidth=0, label=name, rasterized=len(frames) > MANY
    )


def _time_panel(frames: FrameTable) -> Markup | None:
    times = frames.ms[np.isfinite(frames.ms)]
    if not len(times):
        return None
    figure, axes = new_axes()
    _dots(axes, frames, frames.ms, SERIES[0], "one frame")
    median = float(np.median(times))
    axes.axhline(median, color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="median")
    axes.set_ylim(0.0, 1.08 * float(times.max()))
    whole_numbers(axes)
    name_axes(axes, "frame", "time [ms]")
    add_legend(axes)
    span = f"median {words.number(median)} ms, {words.number(float(times.min()))} to {words.number(float(times.max()))} ms"
    return as_image(figure, alt=f"Computing time of each frame: {span}.", caption=f"Computing time of each frame; {span}.")


def _drive_panel(frames: FrameTable, drives: dict[str, FloatArray], label: str, title: str) -> Markup | None:
    shown = [(name, values) for name, values in drives.items() if np.isfinite(values).any()][:SHOWN]
    if not shown:
        return None
    figure, axes = new_axes()
    for color, (name, values) in zip(SERIES, shown):
        axes.plot(frames.frame, values, color=color, linewidth=1.5, label=clipped(name, 14), rasterized=len(frames) > MANY)
    whole_numbers(axes)
    name_axes(axes, "frame", label)
    add_legend(axes, columns=min(len(shown), 4))
    return as_image(figure, alt=f"{title} {', '.join(name for name, _ in shown)} over the frames.", caption=f"{title}.")
