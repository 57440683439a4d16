"""The leading pattern of the residual against its covariates, and the path of the tip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray
from femsense.loop.result.evidence import FrameTable, Pattern, Tip
from femsense.report import words
from femsense.report.drawing import AFTER, BEFORE, INK, PALE, SERIES, add_legend, as_image, clipped, name_axes, new_axes

SWEEPS = len(SERIES)
"""Number of sweeps that have a colour of their own."""


def residual_against(frames: FrameTable, score: Pattern, tip: Tip) -> list[Markup | None]:
    """Return the leading pattern against its best covariate, coloured by direction and by sweep, and the path of the tip."""
    if not score.covariate or not len(score.covariate_values) == len(frames.score_before_m) > 0:
        return [_tip_loop(frames, tip)]
    x, y, z = (np.asarray(values, float) for values in (score.covariate_values, frames.score_before_m, frames.score_after_m))
    best = score.goes_with_before[0] if score.goes_with_before else None
    strength = "" if best is None else f" (rank correlation {words.number(best.rank_correlation, 2)})"
    title = f"Leading pattern of the residual against {score.covariate}"
    x, unloading = x + _spread(x), np.asarray(frames.unloading, bool)
    by_direction = as_image(
        _scatter(x, y, z, [("loading", BEFORE, ~unloading), ("unloading", SERIES[0], unloading)], score.covariate),
        alt=f"{title}{strength}, by direction.",
        caption=(
            f"The pattern holds {words.percent(score.share)} of the squared residual before, mean of each marker "
            f"taken off; it goes best with: {score.covariate}{strength}."
        ),
    )
    labels = sweep_labels(frames)
    names = list(dict.fromkeys(labels))
    chosen = names if len(names) <= SWEEPS else names[: SWEEPS - 1]
    groups = [(clipped(n, 12), SERIES[i], np.array([v == n for v in labels])) for i, n in enumerate(chosen)]
    if len(names) > len(chosen):
        groups.append((f"{len(names) - len(chosen)} others", PALE, np.array([v not in chosen for v in labels])))
    by_sweep = as_image(
        _scatter(x, y, None, groups, score.covariate),
        alt=f"{title}, by sweep.",
        caption=f"The same, by sweep ({words.counted(len(names), 'sweep')}).",
    )
    return [by_direction, by_sweep, _tip_loop(frames, tip)]


def _spread(x: FloatArray) -> FloatArray:
    """Return small shifts that keep points apart where a covariate has two values only."""
    if len(np.unique(x[np.isfinite(x)])) > 2:
        return np.zeros(len(x))
    return np.asarray(0.08 / 3.0 * max(float(np.ptp(x)), 1e-12) * (np.arange(len(x)) % 7 - 3), dtype=np.float64)


def _scatter(x: FloatArray, y: FloatArray, after: FloatArray | None, groups: Sequence[tuple[str, str, Any]], name: str) -> Any:
    figure, axes = new_axes()
    for title, color, rows in groups:
        if rows.any():
            axes.plot(x[rows], 1e3 * y[rows], "o", color=color, markersize=4.2, markeredgewidth=0, label=title)
    if after is not None:
        axes.plot(
            x, 1e3 * after, "o", color="none", markeredgecolor=AFTER, markeredgewidth=0.8, markersize=3.6, label="after (all)"
        )
    axes.axhline(0.0, color=PALE, linewidth=0.8)
    name_axes(axes, _with_unit(name), "pattern of the residual [mm]")
    add_legend(axes)
    return figure


def _with_unit(name: str) -> str:
    if name == "unloading":
        return "unloading (0: no, 1: yes)"
    units = {"time": "s", "time since the last reversal": "s", "known load": "N", "distance from the camera": "m"}
    return clipped(name, 40) + (f" [{units[name]}]" if name in units else "")


def sweep_labels(frames: FrameTable) -> list[str]:
    """Return the name of the sweep of each frame, with its recording where there are several."""
    several = len(set(frames.recording)) > 1
    return [f"R{r + 1} {s}" if several else s for r, s in zip(frames.recording, frames.sweep)]


def _tip_loop(frames: FrameTable, tip: Tip) -> Markup | None:
    """Draw the path of the tip against actuation: measured, before and after."""
    place = {key: i for i, key in enumerate(zip(frames.recording, frames.frame))}
    rows = [(place[key], i) for i, key in enumerate(zip(tip.recording, tip.frame)) if key in place]
    if len(rows) < 3:
        return None
    labels = sweep_labels(frames)
    rows.sort(key=lambda at: (frames.recording[at[0]], frames.frame[at[0]]))
    runs: list[list[tuple[int, int]]] = []
    for at in rows:
        if not runs or labels[runs[-1][-1][0]] != labels[at[0]]:
            runs.append([])
        runs[-1].append(at)
    figure, axes = new_axes()
    dots = {"linestyle": "none", "marker": "o", "markersize": 3.4, "markeredgewidth": 0, "zorder": 3}
    line = {"linewidth": 1.3, "zorder": 2}
    kinds = (("measured", INK, tip.measured_m, dots), ("before", BEFORE, tip.before_m, line), ("after", AFTER, tip.after_m, line))
    for title, color, way, style in kinds:
        for n, run in enumerate(runs):
            x, y = [frames.actuation[a] for a, _ in run], [1e3 * way[b] for _, b in run]
            axes.plot(x, y, color=color, label=None if n else title, **style)
    name_axes(axes, "actuation (sum of the inputs)", f"{clipped(tip.marker, 12)} along its main way [mm]")
    add_legend(axes)
    gap = [_gap(tip.measured_m, way) for way in (tip.before_m, tip.after_m)]
    axis = ", ".join(words.number(v, 2) for v in tip.direction)
    return as_image(
        figure,
        alt=f"Way of marker {tip.marker} against actuation; the model misses it by {gap[0]} before and {gap[1]} after.",
        caption=f"Marker {tip.marker} along ({axis}); the model misses it there by {gap[0]} rms before and {gap[1]} after.",
    )


def _gap(measured: Sequence[float], model: Sequence[float]) -> str:
    gaps = [(a - b) ** 2 for a, b in zip(measured, model) if math.isfinite(a - b)]
    return words.length(math.sqrt(sum(gaps) / len(gaps))) if gaps else words.NOTHING
