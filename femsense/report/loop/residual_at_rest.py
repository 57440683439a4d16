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
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    INK,
    MANY,
    SIZE,
    DrawnSurface,
    Key,
    View,
    arrow_options,
    as_image,
    best_view,
    body_height,
    draw_body,
    frame_body,
    new_axes,
    nice,
)
from femsense.report.page import render

ARROW_SHARE = 0.2
"""The longest arrow, in sizes of the body."""
SPOTS = 600
"""So many single frames are drawn as dots."""


@dataclass(frozen=True, eq=False, slots=True)
class MeanResidual:
    """Residuals of the held-out frames, and how they are drawn."""

    surface: DrawnSurface
    points: FloatArray
    """Where each row is taken, at rest [m], shape (r, 3)."""
    rows: dict[str, FloatArray]
    """Residual of each row "before" and "after" [m], shape (r, 3)."""
    places: FloatArray
    """Of each marker at rest [m], shape (m, 3)."""
    means: dict[str, FloatArray]
    """Mean over the frames of each marker "before" and "after" [m], shape (m, 3)."""
    view: View
    factor: float
    """So many times longer arrows are drawn."""

    @property
    def key_m(self) -> float:
        """A round length for the arrow of the legend [m]."""
        return nice(self.largest_m) if self.largest_m > 0 else 1e-3

    @property
    def largest_m(self) -> float:
        return max(_largest(mean) for mean in self.means.values())

    @property
    def reach(self) -> tuple[FloatArray, FloatArray]:
        """Corners [mm] of what both pictures show: the body and all arrows (of single frames all but the farthest)."""
        tips = [self.points + self.factor * rows for rows in self.rows.values()]
        arrows = [np.quantile(self.view.flat(tip), q, axis=0) for tip in tips for q in (0.01, 0.99)]
        corners = 1e3 * np.vstack([self.view.flat(self.surface.nodes), self.view.flat(self.points), *arrows])
        return corners.min(axis=0), corners.max(axis=0)

    @property
    def shown_share(self) -> float:
        """Share of the squared mean residual before that lies in the page."""
        before = self.means["before"]
        return float((self.view.flat(before) ** 2).sum() / max((before**2).sum(), 1e-300))


def mean_residual(loop: Loop, residuals: Residuals, robot: Robot, surface: DrawnSurface) -> MeanResidual | None:
    """Return the mean residual of each marker, or point of the surface, on the robot of the loop;
    None where nothing has a place on it."""
    place = {name: point for name, point in zip(robot.marker_names, robot.marker_points)} | surface_points(loop)
    rows = np.array([i for i, name in enumerate(residuals.marker) if name in place], dtype=np.int64)
    if not len(rows):
        return None
    names = [residuals.marker[i] for i in rows]
    points = np.array([place[name] for name in names])
    fields = {
        "before": np.asarray(residuals.before_m, float)[rows],
        "after": np.asarray(residuals.after_m, float)[rows],
    }
    means = {title: _per_marker(names, field) for title, field in fields.items()}
    places = _per_marker(names, points)
    view = best_view(np.vstack([surface.nodes, places]), means["before"])
    return MeanResidual(surface, points, fields, places, means, view, exaggeration(surface.nodes, means.values()))


def surface_points(loop: Loop) -> dict[str, FloatArray]:
    """Return where the points of the surface lie at rest [m]."""
    clouds = loop.data.clouds
    return {} if clouds is None else {name: np.asarray(place, float) for name, place in clouds.points_m.items()}


def exaggeration(points: FloatArray, fields: Sequence[FloatArray] | Any) -> float:
    """Return a round factor by which arrows (n, 3) [m] are drawn longer on a body of some points, at least 1."""
    largest = max(_largest(field) for field in fields)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    return max(1.0, nice(ARROW_SHARE * size / largest)) if largest > 0 else 1.0


def _largest(field: FloatArray) -> float:
    return float(np.linalg.norm(field, axis=1).max(initial=0.0))


def _per_marker(names: Sequence[str], values: FloatArray) -> FloatArray:
    """Return the mean of the rows of each marker, in the order of their names."""
    labels = np.array(names)
    return np.array([np.mean(values[labels == name], axis=0) for name in sorted(set(names))])


def mean_residual_panels(
    loop: Loop, residuals: Residuals, cameras: Sequence[FloatArray], robot: Robot | None, surface: DrawnSurface | None
) -> Markup:
    """Return both pictures and how they are read; empty without a robot."""
    residual = None if robot is None or surface is None else mean_residual(loop, residuals, robot, surface)
    if residual is None:
        return Markup()
    pictures = [
        as_image(
            draw_mean_residual(residual, title, cameras if title == "before" else ()),
            alt=f"Mean residual of {words.counted(len(residual.places), 'marker')} {title}: {_sizes(mean)}.",
            caption=f"{title.capitalize()}: mean over the held-out frames {_sizes(mean)}.",
        )
        for title, mean in residual.means.items()
    ]
    return render("pictures.html", text=_how_to_read(residual, bool(cameras)), pictures=pictures)


def _how_to_read(residual: MeanResidual, cameras: bool) -> str:
    factor, axes = residual.factor, residual.view.axes
    length = "at true length" if factor == 1 else f"drawn {factor:g} times as long"
    camera = "; the black one says which way the camera looks" if cameras else ""
    return (
        "Arrows point from the model to the measurement: the mean of each marker over the held-out frames, "
        f"{length}, with the same scale in both pictures{camera}. Small dots are single frames. "
        f"The body is at rest, seen so that its {axes[0]}–{axes[1]} plane lies in the page, "
        f"which shows {words.percent(residual.shown_share)} of the squared mean residual before."
    )


def draw_mean_residual(residual: MeanResidual, title: str, cameras: Sequence[FloatArray] = ()) -> Any:
    """Return a figure of the residual "before" or "after"; `cameras` are the axes along which cameras look."""
    color = BEFORE if title == "before" else AFTER
    view, factor, key = residual.view, residual.factor, residual.key_m
    low, high = residual.reach
    figure, axes = new_axes(height=body_height(low, high))
    draw_body(axes, residual.surface, view)
    step = max(1, len(residual.points) // SPOTS)
    tips = 1e3 * view.flat(residual.points + factor * residual.rows[title])[::step]
    axes.plot(*tips.T, ".", color=color, alpha=0.35, markersize=3, markeredgewidth=0, rasterized=len(tips) > MANY)
    places = 1e3 * view.flat(residual.places)
    axes.plot(*places.T, "o", color="white", markeredgecolor=INK, markeredgewidth=0.8, markersize=3.5)
    axes.quiver(*places.T, *(1e3 * factor * view.flat(residual.means[title])).T, color=color, **arrow_options())
    explained = Key(1e3 * factor * key, f"{1e3 * key:g} mm residual", color)
    frame_body(axes, view, low, high, key=explained, cameras=cameras)
    axes.set_title(title, fontsize=SIZE + 1, color=color, loc="left", fontweight="bold")
    return figure


def _sizes(mean: FloatArray) -> str:
    sizes = np.linalg.norm(mean, axis=1)
    return f"{words.length(float(np.sqrt((sizes**2).mean())))} rms, {words.length(float(sizes.max()))} at most"
