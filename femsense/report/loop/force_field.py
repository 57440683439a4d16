"""The field of forces on the surface that would explain the frame with the largest residual."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import diagonal
from femsense.loop.result.evidence import ForceField
from femsense.report import words
from femsense.report.bodies import Arrows, DrawnSurface, Key, Panel, best_view, body_figure
from femsense.report.drawing import SERIES, as_image, nice

FIELD_SHARE = 0.25


def force_field(field: ForceField, surface: DrawnSurface | None) -> Markup | None:
    """Return the field of equivalent forces as a picture."""
    if not field.points_m or surface is None:
        return None
    points, forces = np.asarray(field.points_m, float), np.asarray(field.forces_n, float)
    largest = float(np.linalg.norm(forces, axis=1).max(initial=0.0))
    if largest <= 0:
        return None
    size = diagonal(surface.nodes)
    scale = FIELD_SHARE * size / largest
    view = best_view(surface.nodes, forces)
    depth = points @ view.towards
    front = depth >= np.median(depth)
    arrows = [Arrows(points[rows], scale * forces[rows], SERIES[6], alpha) for rows, alpha in ((~front, 0.35), (front, 1.0))]
    factor, unit = words.force_unit(largest)
    length = nice(largest)
    key = Key(1e3 * scale * length, f"{factor * length:g} {unit}", SERIES[6])
    total = [words.number(factor * v, 2) for v in field.total_n]
    sum_words = f" Together they make ({', '.join(total)}) {unit}." if len(total) == 3 else ""
    return as_image(
        body_figure([[Panel(surface, tuple(arrows), SERIES[6])]], view, key),
        alt=f"Equivalent forces in frame {field.frame}, the largest {words.quantity(largest, 'N', 2)}.",
        caption=f"Not evidence: the smallest forces on the surface that would bend the model to the measurement in frame "
        f"{field.frame}, the one with the largest residual "
        f"(they explain {words.percent(field.explained_share)} of it). Any residual is some field of forces; pale arrows "
        f"are behind.{sum_words}",
    )
