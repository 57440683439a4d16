"""The mean residual of each marker, drawn on the robot at rest: before and after, with one scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray
from femsense.loop.result.loop_result import Loop
from femsense.loop.result.records import Residuals
from femsense.model.robot import Robot
from femsense.report import words
from femsense.report.bodies import (
    Arrows,
    DrawnSurface,
    Key,
    Panel,
    View,
    best_view,
    body_figure,
    corners_of,
    exaggeration,
    largest_of,
)
from femsense.report.drawing import AFTER, BEFORE, as_image, nice
from femsense.report.page import render

ARROW_SHARE = 0.2
"""The longest arrow, in sizes of the body."""
SPOTS = 600
"""Number of single frames that are drawn as dots."""


@dataclass(frozen=True, eq=False, slots=True)
class MeanResidual:
    """Residuals of held-out frames on the body at rest, their mean over the frames at each marker."""

    panels: tuple[Panel, Panel]
    """Before and after."""
    means: tuple[FloatArray, FloatArray]
    """Of each marker, before and after [m], shape (m, 3)."""
    view: View
    factor: float
    """Exaggeration of the arrows."""

    def figures(self, cameras: Sequence[FloatArray]) -> list[Any]:
        """Return a figure before and one after; `cameras` are the axes along which cameras look."""
        length = nice(largest_of(self.means)) if largest_of(self.means) > 0 else 1e-3
        key = Key(1e3 * self.factor * length, f"{1e3 * length:g} mm residual", BEFORE)
        corners = corners_of(self.panels, self.view)
        shown = zip(self.panels, (cameras, ()))
        return [body_figure([[panel]], self.view, key, corners=corners, cameras=looks) for panel, looks in shown]


def mean_residual(loop: Loop, residuals: Residuals, robot: Robot, surface: DrawnSurface) -> MeanResidual | None:
    """Return the mean residual of each marker, or point of the surface, on the robot of the loop;
    None where nothing has a place on it."""
    clouds = loop.data.clouds
    place = dict(zip(robot.marker_names, robot.marker_points))
    place |= {} if clouds is None else {name: np.asarray(point, float) for name, point in clouds.points_m.items()}
    rows = [i for i, name in enumerate(residuals.marker) if name in place]
    if not rows:
        return None
    names = np.array([residuals.marker[i] for i in rows])
    points = np.array([place[name] for name in names])
    fields = [np.asarray(values, float)[rows] for values in (residuals.before_m, residuals.after_m)]
    places, before, after = (_per_marker(names, values) for values in (points, *fields))
    view = best_view(np.vstack([surface.nodes, places]), before)
    factor = exaggeration(surface.nodes, [before, after], share=ARROW_SHARE)
    step = max(1, len(rows) // SPOTS)
    panels = [
        Panel(surface, (Arrows(places, factor * mean, color, rings=True),), color, title, (points + factor * field)[::step])
        for title, color, mean, field in zip(("before", "after"), (BEFORE, AFTER), (before, after), fields)
    ]
    return MeanResidual((panels[0], panels[1]), (before, after), view, factor)


def _per_marker(names: Any, values: FloatArray) -> FloatArray:
    """Return the mean of the rows of each marker, in the order of their names."""
    return np.array([np.mean(values[names == name], axis=0) for name in np.unique(names)])


def mean_residual_panels(
    loop: Loop, residuals: Residuals, cameras: Sequence[FloatArray], robot: Robot | None, surface: DrawnSurface | None
) -> Markup:
    """Return both pictures and how they are read; empty without a robot."""
    residual = None if robot is None or surface is None else mean_residual(loop, residuals, robot, surface)
    if residual is None:
        return Markup()
    pictures = [
        as_image(
            figure,
            alt=f"Mean residual of {words.counted(len(mean), 'marker')} {panel.title}: {_sizes(mean)}.",
            caption=f"{panel.title.capitalize()}: mean over the held-out frames {_sizes(mean)}.",
        )
        for figure, panel, mean in zip(residual.figures(cameras), residual.panels, residual.means)
    ]
    return render("pictures.html", text=_how_to_read(residual, bool(cameras)), pictures=pictures)


def _how_to_read(residual: MeanResidual, cameras: bool) -> str:
    factor, axes, before = residual.factor, residual.view.axes, residual.means[0]
    shown = float((residual.view.flat(before) ** 2).sum() / max((before**2).sum(), 1e-300))
    length = "at true length" if factor == 1 else f"drawn {factor:g} times as long"
    camera = "; the black one is the direction of the camera" if cameras else ""
    return (
        "Arrows point from the model to the measurement: the mean of each marker over the held-out frames, "
        f"{length}, with the same scale in both pictures{camera}. Small dots are single frames. "
        f"The body is at rest, seen so that its {axes[0]}–{axes[1]} plane lies in the page, "
        f"which shows {words.percent(shown)} of the squared mean residual before."
    )


def _sizes(mean: FloatArray) -> str:
    sizes = np.linalg.norm(mean, axis=1)
    return f"{words.length(float(np.sqrt((sizes**2).mean())))} rms, {words.length(float(sizes.max()))} at most"
