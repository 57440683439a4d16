"""Figures of a closed loop: residuals on the deformed robot, what they go with, sweeps, the map of confounding, a field of forces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.report import words
from femsense.report.documents import Confounding, ForceField, Frames, Pictures, Score, Snapshot, Tip
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    INK,
    LINE,
    PALE,
    SERIES,
    SIZE,
    SOFT,
    DrawnSurface,
    Key,
    add_legend,
    arrow_options,
    as_image,
    best_view,
    body_height,
    clipped,
    draw_body,
    frame_body,
    name_axes,
    new_axes,
    new_panels,
    nice,
)
from femsense.report.page import Html, panels, paragraph, together

ARROW_SHARE = 0.2
"""The longest arrow, in sizes of the body."""
FIELD_SHARE = 0.25
SWEEPS = len(SERIES)
"""So many sweeps have a colour of their own."""
DASH = (0, (4, 3))


# On the robot


def residual_in_frames(pictures: Pictures, rest: DrawnSurface | None) -> Html | None:
    """Return the residuals of three frames on the deformed body, before above after, all with one scale."""
    shown = [f for f in pictures.frames if f.measured_m]
    if not shown:
        return None
    shapes = [_shape(f, pictures, rest) for f in shown]
    measured = [np.asarray(f.measured_m, float) for f in shown]
    fields = {"before": [np.asarray(f.before_m, float) for f in shown], "after": [np.asarray(f.after_m, float) for f in shown]}
    size = max(float(np.linalg.norm(np.ptp(m, axis=0))) for m in measured)
    size = max([size, *(float(np.linalg.norm(np.ptp(s.nodes, axis=0))) for s in shapes if s is not None)])
    largest = max(float(np.linalg.norm(r, axis=1).max(initial=0.0)) for part in fields.values() for r in part)
    factor = max(1.0, nice(ARROW_SHARE * size / largest)) if largest > 0 else 1.0
    everything = np.vstack([*measured, *(s.nodes for s in shapes if s is not None)])
    view = best_view(everything, np.vstack(fields["before"]))
    tips = np.vstack([m + (factor - 1.0) * r for part in fields.values() for m, r in zip(measured, part)])
    corners = 1e3 * np.vstack([view.flat(everything), view.flat(tips)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    width = 9.4
    height = 2 * body_height(low, high, width=width / len(shown), most=4.7)
    figure, grid = new_panels(2, len(shown), width=width, height=height)
    seen = [np.asarray(c.axis, float) for c in pictures.cameras]
    for row, (name, color) in enumerate((("before", BEFORE), ("after", AFTER))):
        key = Key(1e3 * factor * nice(largest), f"{1e3 * nice(largest):g} mm residual", color, 0.014)
        for column, (snapshot, shape, places) in enumerate(zip(shown, shapes, measured)):
            axes, r = grid[row][column], fields[name][column]
            if shape is not None:
                draw_body(axes, shape, view)
            foot = 1e3 * view.flat(places - r)
            axes.plot(*foot.T, "o", color="white", markeredgecolor=INK, markeredgewidth=0.7, markersize=2.8)
            axes.quiver(*foot.T, *(1e3 * factor * view.flat(r)).T, color=color, **arrow_options(0.014))
            cameras = seen if row == column == 0 else []
            frame_body(axes, view, low, high, key=key, cameras=cameras, corner=column == 0)
            title = f"{name}, {snapshot.title} (frame {snapshot.frame})\n{1e3 * _rms(r):.2f} mm"
            axes.set_title(title, fontsize=SIZE, color=color, loc="center", fontweight="bold")
    text = paragraph(
        f"Single frames of the fitted data, from little to much actuation, on the shape that the declared model has there. Arrows point from the model to the measurement, "
        f"{'at true length' if factor == 1 else f'drawn {factor:g} times as long'}, with one scale in all pictures; numbers are the rms of the frame."
    )
    sizes = ", ".join(
        f"{f.title} {words.length(_rms(b))} before and {words.length(_rms(a))} after" for f, b, a in zip(shown, *fields.values())
    )
    return together(text, as_image(figure, alt=f"Residuals in {len(shown)} frames: {sizes}.", wide=True))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).sum(axis=1).mean()))


def _shape(snapshot: Snapshot, pictures: Pictures, rest: DrawnSurface | None) -> DrawnSurface | None:
    if snapshot.nodes_m is None or pictures.triangles is None:
        return rest if snapshot.title == "rest" else None
    nodes, triangles = np.asarray(snapshot.nodes_m, float), np.asarray(pictures.triangles, np.int64)
    return DrawnSurface(nodes, triangles) if len(triangles) and triangles.max() < len(nodes) else None


def force_field(field: ForceField, surface: DrawnSurface | None) -> Html | None:
    """Return the field of equivalent forces as a picture."""
    if not field.points_m or surface is None:
        return None
    points, forces = np.asarray(field.points_m, float), np.asarray(field.forces_n, float)
    largest = float(np.linalg.norm(forces, axis=1).max(initial=0.0))
    if largest <= 0:
        return None
    size = float(np.linalg.norm(np.ptp(surface.nodes, axis=0)))
    scale = FIELD_SHARE * size / largest
    view = best_view(surface.nodes, forces)
    tips = points + scale * forces
    corners = 1e3 * np.vstack([view.flat(surface.nodes), view.flat(tips)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    figure, axes = new_axes(height=body_height(low, high))
    draw_body(axes, surface, view)
    front = points @ view.towards >= np.median(points @ view.towards)
    for rows, alpha in ((~front, 0.35), (front, 1.0)):
        axes.quiver(
            *(1e3 * view.flat(points[rows])).T,
            *(1e3 * scale * view.flat(forces[rows])).T,
            color=SERIES[6],
            alpha=alpha,
            **arrow_options(),
        )
    factor, unit = words.force_unit(largest)
    key = nice(largest)
    frame_body(axes, view, low, high, key=Key(1e3 * scale * key, f"{factor * key:g} {unit}", SERIES[6]))
    total = [words.number(factor * (v or 0.0), 2) for v in field.total_n]
    sum_words = f" Together they make ({', '.join(total)}) {unit}." if len(total) == 3 else ""
    return as_image(
        figure,
        alt=f"Equivalent forces in frame {field.frame}, the largest {words.quantity(largest, 'N', 2)}.",
        caption=f"Not evidence: the smallest forces on the surface that would bend the model to the measurement in frame {field.frame}, the one with the largest residual "
        f"(they explain {words.percent(field.explained_share)} of it). Any residual is some field of forces; pale arrows are behind.{sum_words}",
    )


# What it goes with


def residual_against(frames: Frames, score: Score, tip: Tip) -> Html | None:
    """Return the leading pattern against its best covariate, coloured by direction and by sweep, and the way of the tip."""
    figures = []
    if score.covariate and len(score.covariate_values) == len(frames.score_before_m) > 0:
        x, y, z = (
            np.asarray([np.nan if v is None else v for v in values], float)
            for values in (score.covariate_values, frames.score_before_m, frames.score_after_m)
        )
        best = score.goes_with_before[0] if score.goes_with_before else None
        strength = "" if best is None else f" (rank correlation {words.number(best.rank_correlation, 2)})"
        x = x + _spread(x)
        by_way = [
            ("loading", BEFORE, ~np.asarray(frames.unloading, bool)),
            ("unloading", SERIES[0], np.asarray(frames.unloading, bool)),
        ]
        figures.append(
            as_image(
                _scatter(x, y, z, by_way, score.covariate),
                alt=f"Leading pattern of the residual against {score.covariate}{strength}, by direction.",
                caption=f"The pattern holds {words.percent(score.share)} of the squared residual before, mean of each marker taken off; it goes best with: {score.covariate}{strength}.",
            )
        )
        labels = _sweep_labels(frames)
        names = list(dict.fromkeys(labels))
        chosen = names if len(names) <= SWEEPS else names[: SWEEPS - 1]
        groups = [(clipped(n, 12), SERIES[i], np.array([v == n for v in labels])) for i, n in enumerate(chosen)]
        if len(names) > len(chosen):
            groups.append((f"{len(names) - len(chosen)} others", PALE, np.array([v not in chosen for v in labels])))
        figures.append(
            as_image(
                _scatter(x, y, None, groups, score.covariate),
                alt=f"Leading pattern of the residual against {score.covariate}, by sweep.",
                caption=f"The same, by sweep ({words.counted(len(names), 'sweep')}).",
            )
        )
    loop = _tip_loop(frames, tip)
    return panels(*figures, loop)


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
    units = {"time": "s", "time since the last reversal": "s", "known load": "N", "distance from the camera": "m"}
    return (
        f"{clipped(name, 40)} [{units[name]}]"
        if name in units
        else "unloading (0: no, 1: yes)"
        if name == "unloading"
        else clipped(name, 40)
    )


def _sweep_labels(frames: Frames) -> list[str]:
    several = len(set(frames.recording)) > 1
    return [f"R{r + 1} {s}" if several else s for r, s in zip(frames.recording, frames.sweep)]


def _tip_loop(frames: Frames, tip: Tip) -> Html | None:
    """Draw the way of the tip against actuation: measured, before and after."""
    place = {key: i for i, key in enumerate(zip(frames.recording, frames.frame))}
    rows = [(place[key], i) for i, key in enumerate(zip(tip.recording, tip.frame)) if key in place]
    if len(rows) < 3:
        return None
    labels = _sweep_labels(frames)
    rows.sort(key=lambda at: (frames.recording[at[0]], frames.frame[at[0]]))
    runs: list[list[tuple[int, int]]] = []
    for at in rows:
        if not runs or labels[runs[-1][-1][0]] != labels[at[0]]:
            runs.append([])
        runs[-1].append(at)
    figure, axes = new_axes()
    kinds = (("measured", INK, tip.measured_m), ("before", BEFORE, tip.before_m), ("after", AFTER, tip.after_m))
    for title, color, way in kinds:
        for n, run in enumerate(runs):
            x = [frames.actuation[a] for a, _ in run]
            y = [1e3 * (way[b] if way[b] is not None else math.nan) for _, b in run]  # type: ignore[operator]
            style = (
                {"linestyle": "none", "marker": "o", "markersize": 3.4, "markeredgewidth": 0}
                if title == "measured"
                else {"linewidth": 1.3}
            )
            axes.plot(x, y, color=color, label=title if n == 0 else None, zorder=3 if title == "measured" else 2, **style)
    name_axes(axes, "actuation (sum of the inputs)", f"{clipped(tip.marker, 12)} along its main way [mm]")
    add_legend(axes)
    gap = [_gap(tip.measured_m, way) for way in (tip.before_m, tip.after_m)]
    axis = ", ".join(words.number(v, 2) for v in tip.direction)
    return as_image(
        figure,
        alt=f"Way of marker {tip.marker} against actuation; the model misses it by {gap[0]} before and {gap[1]} after.",
        caption=f"Marker {tip.marker} along ({axis}); the model misses it there by {gap[0]} rms before and {gap[1]} after.",
    )


def _gap(measured: Sequence[float | None], model: Sequence[float | None]) -> str:
    gaps = [(a - b) ** 2 for a, b in zip(measured, model) if a is not None and b is not None]
    return words.length(math.sqrt(sum(gaps) / len(gaps))) if gaps else words.NOTHING


# Sweeps


def sweep_dots(frames: Frames, noise_m: float | None) -> Html | None:
    """Return the error of each sweep, held-out ones marked, with its frames as small dots."""
    labels = _sweep_labels(frames)
    names = list(dict.fromkeys(zip(labels, frames.held_out)))
    if len(names) < 2:
        return None
    figure, axes = new_axes()
    fell = 0
    squares = {
        k: np.array([np.nan if v is None else (1e3 * v) ** 2 for v in c])
        for k, c in (("before", frames.before_rms_m), ("after", frames.after_rms_m))
    }
    for i, name in enumerate(names):
        rows = np.array([key == name for key in zip(labels, frames.held_out)])
        if name[1]:
            axes.axvspan(i - 0.5, i + 0.5, color=LINE, alpha=0.45, linewidth=0)
        ends = {}
        for kind, color, side in (("before", BEFORE, -0.13), ("after", AFTER, 0.13)):
            values = squares[kind][rows]
            ends[kind] = float(np.sqrt(np.nanmean(values))) if np.isfinite(values).any() else math.nan
            axes.plot(
                np.full(rows.sum(), i + side), np.sqrt(values), "o", color=color, alpha=0.5, markersize=3.2, markeredgewidth=0
            )
            axes.plot(
                [i + side], [ends[kind]], "o", color=color, markersize=6.0, markeredgewidth=0, label=kind if i == 0 else None
            )
        fell += name[1] and ends["after"] < ends["before"]
    if words.known(noise_m):
        axes.axhline(1e3 * float(noise_m or 0.0), color=SOFT, linewidth=1.2, linestyle=DASH, label="noise")
    step = max(1, math.ceil(len(names) / 9))
    texts = [clipped(label, 10) for label, _ in names]
    axes.set_xticks(
        range(0, len(names), step),
        texts[::step],
        rotation=30 if max(map(len, texts)) > 4 else 0,
        ha="right" if max(map(len, texts)) > 4 else "center",
    )
    axes.set_xlim(-0.6, len(names) - 0.4)
    axes.set_ylim(bottom=0.0)
    axes.grid(False, axis="x")
    name_axes(axes, "sweep", "rms error [mm]")
    add_legend(axes)
    held = sum(h for _, h in names)
    return as_image(
        figure,
        alt=f"Error of each sweep before and after; it fell in {fell} of {held} held-out sweeps.",
        caption=f"Large dots: a sweep; small ones: its frames; held-out sweeps stand on grey. The error fell in {fell} of {words.counted(held, 'held-out sweep')}.",
    )


# Confounding


def confounding_map(confounding: Confounding) -> Html | None:
    """Return the heat map of how much each effect is collinear with each other one."""
    names, n = confounding.names, len(confounding.names)
    if n < 2 or len(confounding.share) != n or any(len(row) != n for row in confounding.share):
        return None
    share = np.array([[np.nan if v is None else v for v in row] for row in confounding.share], float)
    np.fill_diagonal(share, np.nan)
    wide = n > 6
    figure, axes = new_axes(width=7.6 if wide else 4.5, height=1.3 + 0.34 * n)
    from matplotlib.colors import LinearSegmentedColormap

    colors = LinearSegmentedColormap.from_list("map", ["#ffffff", "#f3d9c4", BEFORE, "#6e2f06"])
    axes.pcolormesh(
        np.arange(n + 1) - 0.5,
        np.arange(n + 1) - 0.5,
        np.ma.masked_invalid(100 * share),
        cmap=colors,
        vmin=0,
        vmax=100,
        edgecolors="white",
        linewidth=1.0,
    )
    for i in range(n):
        for j in range(n):
            if np.isfinite(share[i, j]):
                axes.text(
                    j,
                    i,
                    f"{100 * share[i, j]:.0f}",
                    ha="center",
                    va="center",
                    fontsize=SIZE - 2,
                    color="white" if share[i, j] > 0.6 else INK,
                    fontweight="bold" if share[i, j] > 0.95 else "normal",
                )
    axes.set_xticks(range(n), [clipped(name, 16) for name in names], rotation=40, ha="right", fontsize=SIZE - 1)
    axes.set_yticks(range(n), [clipped(name, 16) for name in names], fontsize=SIZE - 1)
    axes.set_xlim(-0.5, n - 0.5)
    axes.set_ylim(n - 0.5, -0.5)
    axes.grid(False)
    axes.spines[["left", "bottom"]].set_visible(False)
    worst = [(float(share[i, j]), names[i], names[j]) for i in range(n) for j in range(n) if np.isfinite(share[i, j])]
    top = max(worst)
    return as_image(
        figure,
        alt=f"Map of {n} effects: how much of the trace of one is collinear with another one; the most {top[0]:.0%} of {top[1]} by {top[2]}.",
        caption="How much of the trace of the effect on the left is collinear with that of the effect below [%], with all that calibration can absorb taken off. Above 95 (bold) these data cannot tell the two apart.",
        wide=wide,
    )
