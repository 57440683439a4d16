"""Residuals of single frames, drawn on the deformed body: before above after, with one scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray, diagonal, rms
from femsense.loop.result.evidence import Pictures, Snapshot
from femsense.report import words
from femsense.report.bodies import Arrows, DrawnSurface, Key, Panel, best_view, body_figure, exaggeration, largest_of
from femsense.report.drawing import AFTER, BEFORE, as_image, nice
from femsense.report.loop.residual_at_rest import ARROW_SHARE

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
    """Shape of the declared model."""
    measured: tuple[FloatArray, ...]
    """Of each marker [m], shape (m, 3)."""
    before: tuple[FloatArray, ...]
    """Measured minus modelled [m], shape (m, 3)."""
    after: tuple[FloatArray, ...]
    """Likewise."""

    @property
    def factor(self) -> float:
        """Exaggeration of the arrows: relative to the largest body, not to the distance between bodies."""
        largest = max(self._bodies, key=diagonal)
        return exaggeration(largest, [*self.before, *self.after], share=ARROW_SHARE)

    @property
    def _bodies(self) -> list[FloatArray]:
        return [*self.measured, *(shape.nodes for shape in self.shapes if shape is not None)]

    def figure(self, cameras: Sequence[FloatArray]) -> Any:
        """Return a figure with two rows, before and after, and a column a frame; `cameras` are the axes along which cameras look."""
        length = nice(largest_of([*self.before, *self.after]))
        key = Key(1e3 * self.factor * length, f"{1e3 * length:g} mm residual", BEFORE, SHAFT)
        view = best_view(np.vstack(self._bodies), np.vstack(self.before))
        rows = [self._panels("before", self.before, BEFORE), self._panels("after", self.after, AFTER)]
        return body_figure(rows, view, key, cameras=cameras, width=WIDTH, most=TALLEST)

    def _panels(self, name: str, residuals: Sequence[FloatArray], color: str) -> list[Panel]:
        return [
            Panel(
                shape,
                (Arrows(measured - residual, self.factor * residual, color, rings=True),),
                color,
                f"{name}, {title}\n{1e3 * rms(residual):.2f} mm",
            )
            for title, shape, measured, residual in zip(self.titles, self.shapes, self.measured, residuals)
        ]


def frame_residuals(pictures: Pictures, rest: DrawnSurface | None) -> FrameResiduals | None:
    """Return the residuals of the frames of a report; None where there are none."""
    shown = [f for f in pictures.frames if f.measured_m]
    if not shown:
        return None
    measured, before, after = (
        tuple(np.asarray(getattr(f, name), float) for f in shown) for name in ("measured_m", "before_m", "after_m")
    )
    titles = tuple(f"{f.title} (frame {f.frame})" for f in shown)
    return FrameResiduals(titles, tuple(_shape(f, pictures, rest) for f in shown), measured, before, after)


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
        f"{title} {words.length(rms(before))} before and {words.length(rms(after))} after"
        for title, before, after in zip((f.title for f in pictures.frames if f.measured_m), frames.before, frames.after)
    )
    alt = f"Residuals in {len(frames.titles)} frames: {sizes}."
    return Markup("<p>{}</p>\n{}").format(text, as_image(frames.figure(pictures.camera_axes), alt=alt, wide=True))
