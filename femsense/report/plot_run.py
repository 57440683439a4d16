"""A run as one figure: forces over time with their uncertainty, or the residual before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.report.drawing import AFTER, BEFORE, add_legend, name_axes, new_axes
from femsense.report.run.forces import forces_figure
from femsense.report.run.frames import column

if TYPE_CHECKING:
    from femsense.sensing.types import Run


def plot_run(run: Run) -> Any:
    """Plot the contact forces of a run [N] over time [s].

    Bands show one and two standard deviations; hollow marks are frames whose status is not "ok". For a run without contacts the residual is plotted
    instead.

    Arguments:
        run: result of `estimate` or `read_run`.

    Returns:
        a matplotlib figure.
    """
    contacts = [c for c in run.contacts if np.isfinite(c.force_n)]
    if contacts:
        return forces_figure(contacts, run.frames)
    figure, axes = new_axes()
    for name, color in (("before", BEFORE), ("after", AFTER)):
        axes.plot(column(run.frames, "time_s"), 1e3 * column(run.frames, f"rms_{name}_m"), color=color, label=name)
    name_axes(axes, "time [s]", "residual [mm]")
    add_legend(axes)
    return figure
