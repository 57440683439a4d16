"""The error on held-out data, before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import BoolArray, FloatArray
from femsense.loop.result.evidence import FrameTable
from femsense.loop.result.records import Residuals
from femsense.report import words
from femsense.report.drawing import AFTER, BEFORE, LINE, MANY, PALE, SOFT, add_legend, as_image, clipped, name_axes, new_axes
from femsense.report.loop.residual_against import sweep_labels


def held_out_errors(residuals: Residuals, table: FrameTable, noise_m: float) -> list[Markup | None]:
    """Return the errors on held-out data: their distribution, and those of sweeps or frames."""
    if not residuals.frame:
        return [sweep_dots(table, noise_m)]
    before, after = (np.linalg.norm(np.asarray(values, float), axis=1) for values in (residuals.before_m, residuals.after_m))
    median = [words.length(float(np.median(values))) for values in (before, after)]
    frames = _per_frame(residuals, before, after)
    fell = f"the error fell in {sum(b > a for _, _, b, a in frames)} of {words.counted(len(frames), 'held-out frame')}"
    shares = as_image(
        _distribution(before, after, noise_m),
        alt=f"Share of held-out measurements with an error below a size, before and after; medians {median[0]} and {median[1]}.",
        caption=(
            f"{words.counted(len(before), 'measurement')} of {words.counted(len(set(residuals.marker)), 'marker')}; median "
            f"{median[0]} before, {median[1]} after; {fell}."
        ),
    )
    dots = sweep_dots(table, noise_m) or as_image(
        _frame_dots(frames, noise_m),
        alt=f"Root mean square error of each held-out frame before and after; {fell}.",
        caption="Error of each held-out frame.",
    )
    return [shares, dots]


def _distribution(before: FloatArray, after: FloatArray, noise_m: float) -> Any:
    """Draw the distribution function of the errors, next to that of noise alone."""
    figure, axes = new_axes()
    for values, color, name in ((before, BEFORE, "before"), (after, AFTER, "after")):
        sizes = 1e3 * np.sort(values)
        shares = np.arange(1, len(sizes) + 1) / max(len(sizes), 1)
        axes.step(
            np.concatenate([[0.0], sizes]),
            100 * np.concatenate([[0.0], shares]),
            where="post",
            color=color,
            linewidth=1.9,
            label=name,
        )
    top = 1e3 * float(np.quantile(np.concatenate([before, after]), 0.995)) * 1.08
    if noise_m > 0:
        top = max(top, 2.2e3 * noise_m)
        x = np.linspace(0.0, top, 200)
        axes.plot(
            x, 100 * _noise_share(x / (1e3 * noise_m)), color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="noise alone"
        )
    axes.set(xlim=(0.0, max(top, 1e-9)), ylim=(0.0, 102.0))
    name_axes(axes, "error [mm]", "measurements below it [%]")
    add_legend(axes)
    return figure


def _noise_share(ratio: FloatArray) -> FloatArray:
    """Return the probability that 3-D Gaussian noise of root mean square 1 is below a size (Maxwell's distribution)."""
    from scipy.special import erf

    u = ratio * math.sqrt(1.5)
    return np.asarray(erf(u) - 2.0 / math.sqrt(math.pi) * u * np.exp(-(u**2)))


def _per_frame(residuals: Residuals, before: FloatArray, after: FloatArray) -> list[tuple[int, int, float, float]]:
    """Return (recording, frame, rms before, rms after) of each held-out frame, in order."""
    keys = list(zip(residuals.recording, residuals.frame))
    rows: dict[tuple[int, int], list[int]] = {}
    for i, key in enumerate(keys):
        rows.setdefault(key, []).append(i)
    return [(r, f, _rms(before[rows[r, f]]), _rms(after[rows[r, f]])) for r, f in sorted(rows)]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _frame_dots(frames: Sequence[tuple[int, int, float, float]], noise_m: float) -> Any:
    figure, axes = new_axes()
    places = np.arange(len(frames)) + np.array([0.8 * recording for recording, *_ in frames])
    before, after = 1e3 * np.array([f[2] for f in frames]), 1e3 * np.array([f[3] for f in frames])
    many = len(frames) > MANY
    if len(frames) <= 80:
        axes.vlines(places, np.minimum(before, after), np.maximum(before, after), color=PALE, linewidth=0.9)
    size = 4.5 if len(frames) <= 80 else 2.5
    axes.plot(places, before, "o", color=BEFORE, markersize=size, markeredgewidth=0, label="before", rasterized=many)
    axes.plot(places, after, "o", color=AFTER, markersize=size, markeredgewidth=0, label="after", rasterized=many)
    if words.known(noise_m):
        axes.axhline(1e3 * noise_m, color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="noise")
    step = max(1, math.ceil(len(frames) / 9))
    several = len({f[0] for f in frames}) > 1
    labels = [f"{f[1]}\nR{f[0] + 1}" if several else str(f[1]) for f in frames]
    axes.set_xticks(places[::step], labels[::step])
    axes.set_ylim(0.0, 1.08 * float(np.max([*before, *after, 1e-9])))
    axes.grid(False, axis="x")
    name_axes(axes, "frame" + (" (R: recording)" if several else ""), "rms error [mm]")
    add_legend(axes)
    return figure


DASH = (0, (4, 3))


def sweep_dots(frames: FrameTable, noise_m: float) -> Markup | None:
    """Return the error of each sweep, held-out ones marked, with its frames as small dots."""
    labels = sweep_labels(frames)
    names = list(dict.fromkeys(zip(labels, frames.held_out)))
    if len(names) < 2:
        return None
    rows = [np.array([key == name for key in zip(labels, frames.held_out)]) for name in names]
    figure, axes = new_axes()
    for i, (_, held_out) in enumerate(names):
        if held_out:
            axes.axvspan(i - 0.5, i + 0.5, color=LINE, alpha=0.45, linewidth=0)
    before = _draw_sweeps(axes, frames.before_rms_m, rows, "before", BEFORE, -0.13)
    after = _draw_sweeps(axes, frames.after_rms_m, rows, "after", AFTER, 0.13)
    if words.known(noise_m):
        axes.axhline(1e3 * noise_m, color=SOFT, linewidth=1.2, linestyle=DASH, label="noise")
    _name_sweeps(axes, [label for label, _ in names])
    name_axes(axes, "sweep", "rms error [mm]")
    add_legend(axes)
    held = sum(held_out for _, held_out in names)
    fell = sum(held_out and a < b for (_, held_out), b, a in zip(names, before, after))
    return as_image(
        figure,
        alt=f"Error of each sweep before and after; it fell in {fell} of {held} held-out sweeps.",
        caption=(
            f"Large dots: a sweep; small ones: its frames; held-out sweeps stand on grey. The error fell in {fell} of "
            f"{words.counted(held, 'held-out sweep')}."
        ),
    )


def _draw_sweeps(
    axes: Any, rms_m: Sequence[float], rows: Sequence[BoolArray], label: str, color: str, side: float
) -> list[float]:
    """Draw the frames of each sweep and their root mean square; return the latter [mm]."""
    squares = (1e3 * np.array(rms_m)) ** 2
    sizes = []
    for i, members in enumerate(rows):
        values = squares[members]
        sizes.append(float(np.sqrt(np.nanmean(values))) if np.isfinite(values).any() else math.nan)
        at, name = i + side, label if i == 0 else None
        axes.plot(np.full(len(values), at), np.sqrt(values), "o", color=color, alpha=0.5, markersize=3.2, markeredgewidth=0)
        axes.plot([at], [sizes[-1]], "o", color=color, markersize=6.0, markeredgewidth=0, label=name)
    return sizes


def _name_sweeps(axes: Any, labels: Sequence[str]) -> None:
    step = max(1, math.ceil(len(labels) / 9))
    texts = [clipped(label, 10) for label in labels]
    long = max(map(len, texts)) > 4
    axes.set_xticks(range(0, len(labels), step), texts[::step], rotation=30 if long else 0, ha="right" if long else "center")
    axes.set_xlim(-0.6, len(labels) - 0.4)
    axes.set_ylim(bottom=0.0)
    axes.grid(False, axis="x")
