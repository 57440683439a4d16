"""What these data cannot say: effects that are not distinguishable, and those that calibration absorbs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.report import words
from femsense.report.drawing import BEFORE, INK, SIZE, as_image, clipped, new_axes
from femsense.report.loop.document import Confounded, Loop
from femsense.report.loop.evidence import Confounding, Evidence
from femsense.report.page import Html, bullets, code, element, paragraph, section, together

WIDE = 6
"""Beyond so many effects the map takes the whole width."""


def open_questions(loop: Loop, evidence: Evidence) -> Html | None:
    """Return the pairs that are not distinguishable, the effects that are not testable, and the next experiment."""
    names = {effect.name for effect in loop.effects}
    pairs = [
        element("span", code(r.pair[0]), " and ", code(r.pair[1]), f": {_why_alike(r)}")
        for r in loop.confounded
        if names & set(r.pair) or not names
    ]
    others = [" / ".join(r.pair) for r in loop.confounded if names and not names & set(r.pair)]
    hidden = [
        element("span", code(u.name), f": {words.nearly(u.absorbed_share)} of it is absorbed by calibration")
        for u in loop.not_testable
    ]
    experiment = loop.next_experiment
    advice = paragraph(element("strong", "Next experiment: "), experiment, class_="next") if experiment else None
    return (
        together(
            section("Cannot be distinguished", bullets(pairs), level=4),
            paragraph("Nor could these, were one of them there: ", ", ".join(others), ".") if others else None,
            section("Not testable with these data", bullets(hidden), level=4),
            advice,
            confounding_map(evidence.confounding),
        )
        or None
    )


def _why_alike(pair: Confounded) -> str:
    if words.known(pair.dbic_gap):
        return f"their evidence differs by a ΔBIC of {words.number(pair.dbic_gap, 2)} only"
    if words.known(pair.absorbed_share):
        return f"{words.nearly(pair.absorbed_share, 1)} of the second is absorbed by calibration, most of it by the first"
    if words.known(pair.cosine):
        return f"they leave the same trace (agreement {words.percent(pair.cosine, 1)})"
    return "these data do not tell which it is"


def confounding_map(confounding: Confounding) -> Html | None:
    """Return the heat map of how much each effect is collinear with each other one."""
    names, n = confounding.names, len(confounding.names)
    if n < 2 or len(confounding.share) != n or any(len(row) != n for row in confounding.share):
        return None
    share = np.array([[np.nan if v is None else v for v in row] for row in confounding.share], float)
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
