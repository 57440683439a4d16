"""The heat map of effects that these data cannot distinguish."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray
from femsense.loop.result.evidence import ConfoundingMap
from femsense.report.drawing import BEFORE, INK, SIZE, as_image, clipped, new_axes

WIDE = 6
"""A map of more effects than this takes the whole width."""


def confounding_map(confounding: ConfoundingMap) -> Markup | None:
    """Return the heat map of how much each effect is collinear with each other one."""
    names, n = confounding.names, len(confounding.names)
    if n < 2 or len(confounding.share) != n or any(len(row) != n for row in confounding.share):
        return None
    share = np.array(confounding.share, float)
    np.fill_diagonal(share, np.nan)
    top = max((float(share[i, j]), names[i], names[j]) for i, j in np.argwhere(np.isfinite(share)))
    return as_image(
        _draw_map(names, share),
        alt=(
            f"Map of {n} effects: how much of the trace of one is collinear with another one; the most {top[0]:.0%} of "
            f"{top[1]} by {top[2]}."
        ),
        caption=(
            "How much of the trace of the effect on the left is collinear with that of the effect below [%], with all that "
            "calibration can absorb taken off. Above 95 (bold) these data cannot distinguish the two."
        ),
        wide=n > WIDE,
    )


def _draw_map(names: Sequence[str], share: FloatArray) -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    n = len(names)
    figure, axes = new_axes(width=7.6 if n > WIDE else 4.5, height=1.3 + 0.34 * n)
    colors = LinearSegmentedColormap.from_list("map", ["#ffffff", "#f3d9c4", BEFORE, "#6e2f06"])
    edges = np.arange(n + 1) - 0.5
    cells = np.ma.masked_invalid(100 * share)
    axes.pcolormesh(edges, edges, cells, cmap=colors, vmin=0, vmax=100, edgecolors="white", linewidth=1.0)
    for i, j in np.argwhere(np.isfinite(share)):
        color, weight = "white" if share[i, j] > 0.6 else INK, "bold" if share[i, j] > 0.95 else "normal"
        text = f"{100 * share[i, j]:.0f}"
        axes.text(j, i, text, ha="center", va="center", fontsize=SIZE - 2, color=color, fontweight=weight)
    labels = [clipped(name, 16) for name in names]
    axes.set_xticks(range(n), labels, rotation=40, ha="right", fontsize=SIZE - 1)
    axes.set_yticks(range(n), labels, fontsize=SIZE - 1)
    axes.set_xlim(-0.5, n - 0.5)
    axes.set_ylim(n - 0.5, -0.5)
    axes.grid(False)
    axes.spines[["left", "bottom"]].set_visible(False)
    return figure
