"""Residuals of single frames, drawn on the deformed body: before above after, with one scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray
from femsense.loop.result.evidence import Pictures, Snapshot
from femsense.report import words
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    INK,
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
    new_panels,
    nice,
)
from femsense.report.loop.residual_at_rest import exaggeration

WIDTH = 9.4
"""Of the whole figure [inch]."""
TALLEST = 4.7
"""Of one row [inch]."""
SHAFT = 0.014
"""Width of an arrow [inch]."""


@dataclass(frozen=True, eq=False, slots=True)
class FrameResiduals:
    """Residuals of some frames, one entry a frame."""

    titles: tuple[str, ...]
    shapes: tuple[DrawnSurface | None, ...]
    """What the declared model looks like there."""
    measured: tuple[FloatArray, ...]
    """Of each marker [m], shape (m, 3)."""
    residuals: dict[str, tuple[FloatArray, ...]]
    """Measured minus modelled "before" and "after" [m], shape (m, 3)."""

    @property
    def largest_m(self) -> float:
        return max(float(np.linalg.norm(r, axis=1).max(initial=0.0)) for part in self.residuals.values() for r in part)

    @property
    def everything(self) -> FloatArray:
        """All points of bodies and markers [m]."""
        return np.vstack([*self.measured, *(shape.nodes for shape in self.shapes if shape is not None)])

    @property
    def factor(self) -> float:
        """So many times longer arrows are drawn: by the largest body, not by how far bodies lie apart."""
        bodies = [*self.measured, *(shape.nodes for shape in self.shapes if shape is not None)]
        largest = max(bodies, key=lambda points: float(np.linalg.norm(np.ptp(points, axis=0))))
        return exaggeration(largest, [r for part in self.residuals.values() for r in part])

    @property
    def view(self) -> View:
        return best_view(self.everything, np.vstack(self.residuals["before"]))

    def reach(self, view: View, factor: float) -> tuple[FloatArray, FloatArray]:
        """Return the corners of what all pictures show [mm]."""
        tips = [m + (factor - 1.0) * r for part in self.residuals.values() for m, r in zip(self.measured, part)]
        corners = 1e3 * np.vstack([view.flat(self.everything), view.flat(np.vstack(tips))])
        return corners.min(axis=0), corners.max(axis=0)


def frame_residuals(pictures: Pictures, rest: DrawnSurface | None) -> FrameResiduals | None:
    """Return the residuals of the frames of a report; None where there are none."""
    shown = [f for f in pictures.frames if f.measured_m]
    if not shown:
        return None
    return FrameResiduals(
        tuple(f"{f.title} (frame {f.frame})" for f in shown),
        tuple(_shape(f, pictures, rest) for f in shown),
        tuple(np.asarray(f.measured_m, float) for f in shown),
        {
            "before": tuple(np.asarray(f.before_m, float) for f in shown),
            "after": tuple(np.asarray(f.after_m, float) for f in shown),
        },
    )


def _shape(snapshot: Snapshot, pictures: Pictures, rest: DrawnSurface | None) -> DrawnSurface | None:
    if snapshot.nodes_m is None or pictures.triangles is None:
        return rest if snapshot.title == "rest" else None
    nodes, triangles = np.asarray(snapshot.nodes_m, float), np.asarray(pictures.triangles, np.int64)
    return DrawnSurface(nodes, triangles) if len(triangles) and triangles.max() < len(nodes) else None


def frame_residuals_panel(pictures: Pictures, rest: DrawnSurface | None) -> Markup:
    """Return the residuals of three frames as one picture, and how it is read; empty where there are none."""
    frames = frame_residuals(pictures, rest)
    if frames is None:
        return Markup()
    length = "at true length" if frames.factor == 1 else f"drawn {frames.factor:g} times as long"
    text = (
        "Single frames of the fitted data, from little to much actuation, on the shape that the declared model has there. "
        f"Arrows point from the model to the measurement, {length}, with one scale in all pictures; numbers are the rms "
        f"of the frame."
    )
    sizes = ", ".join(
        f"{title} {words.length(_rms(before))} before and {words.length(_rms(after))} after"
        for title, before, after in zip((f.title for f in pictures.frames if f.measured_m), *frames.residuals.values())
    )
    picture = as_image(
        draw_frame_residuals(frames, pictures.camera_axes),
        alt=f"Residuals in {len(frames.titles)} frames: {sizes}.",
        wide=True,
    )
    return Markup("<p>{}</p>\n{}").format(text, picture)


def draw_frame_residuals(frames: FrameResiduals, cameras: list[FloatArray]) -> Any:
    """Return a figure with two rows, before and after, and a column a frame; `cameras` are the axes along which cameras look."""
    view, factor, count = frames.view, frames.factor, len(frames.titles)
    low, high = frames.reach(view, factor)
    height = 2 * body_height(low, high, width=WIDTH / count, most=TALLEST)
    figure, grid = new_panels(2, count, width=WIDTH, height=height)
    length = nice(frames.largest_m)
    for line, (name, color) in zip(grid, (("before", BEFORE), ("after", AFTER))):
        key = Key(1e3 * factor * length, f"{1e3 * length:g} mm residual", color, SHAFT)
        columns = zip(line, frames.titles, frames.shapes, frames.measured, frames.residuals[name])
        for axes, title, shape, measured, residual in columns:
            first = axes is line[0]
            if shape is not None:
                draw_body(axes, shape, view)
            foot = 1e3 * view.flat(measured - residual)
            axes.plot(*foot.T, "o", color="white", markeredgecolor=INK, markeredgewidth=0.7, markersize=2.8)
            axes.quiver(*foot.T, *(1e3 * factor * view.flat(residual)).T, color=color, **arrow_options(SHAFT))
            frame_body(axes, view, low, high, key=key, cameras=cameras if first and line is grid[0] else (), corner=first)
            text = f"{name}, {title}\n{1e3 * _rms(residual):.2f} mm"
            axes.set_title(text, fontsize=SIZE, color=color, loc="center", fontweight="bold")
    return figure


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).sum(axis=1).mean()))
