"""A run as one figure: forces over time with their uncertainty, and the residual before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.report import words
from femsense.report.drawing import AFTER, BEFORE, SERIES, add_legend, name_axes, new_axes

if TYPE_CHECKING:
    from femsense.sensing.types import Run

SHOWN = len(SERIES)
"""Contacts that get a colour: those with the largest forces."""


def plot_run(run: Run) -> Any:
    """Return a matplotlib figure: the size of each force over time with two standard deviations, hollow
    where the frame is not ok, or the residual where nothing touches."""
    figure, axes = new_axes()
    if not run.contacts:
        time = [frame.time_s for frame in run.frames]
        axes.plot(time, [1e3 * frame.rms_before_m for frame in run.frames], color=BEFORE, label="before")
        axes.plot(time, [1e3 * frame.rms_after_m for frame in run.frames], color=AFTER, label="after")
        name_axes(axes, "time [s]", "residual [mm]")
        add_legend(axes)
        return figure
    ok = {frame.frame for frame in run.frames if frame.status == "ok"}
    factor, unit = words.force_unit(max(contact.force_n for contact in run.contacts))
    tracks = sorted({c.track for c in run.contacts}, key=lambda track: -max(c.force_n for c in run.contacts if c.track == track))
    for color, track in zip(SERIES, tracks[:SHOWN]):
        rows = [contact for contact in run.contacts if contact.track == track]
        at_s, size, std = (np.array([getattr(c, name) for c in rows]) for name in ("time_s", "force_n", "std_n"))
        axes.errorbar(
            at_s, factor * size, 2 * factor * np.nan_to_num(std), fmt="o-", ms=3, lw=1.2, color=color, label=f"contact {track}"
        )
        doubtful = np.array([contact.frame not in ok for contact in rows])
        axes.plot(at_s[doubtful], factor * size[doubtful], "o", ms=5, mfc="white", mec=color, zorder=4)
    if any(contact.frame not in ok for contact in run.contacts):
        axes.plot([], [], "o", ms=5, mfc="white", mec="0.4", label="frame not ok")
    name_axes(axes, "time [s]", f"force [{unit}]")
    axes.set_ylim(bottom=0.0)
    add_legend(axes)
    return figure
