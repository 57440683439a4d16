"""The error on held-out data, before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray
from femsense.loop.result.evidence import FrameTable
from femsense.loop.result.records import Residuals
from femsense.report import words
from femsense.report.drawing import AFTER, BEFORE, LINE, MANY, SOFT, add_legend, as_image, clipped, name_axes, new_axes
from femsense.report.loop.residual_against import sweep_labels

FEW = 80
"""Up to this number of groups, the members of each are drawn too."""
LABELS = 9
"""Number of groups that have a label on the axis, about."""
DASH = (0, (4, 3))


@dataclass(frozen=True, eq=False, slots=True)
class Group:
    """Errors that are summarised by one dot."""

    label: str
    before: FloatArray
    """[m], shape (n,); nan where unknown."""
    after: FloatArray
    """[m], shape (n,); nan where unknown."""
    held_out: bool = False
    """Whether it is marked as held out."""

    @property
    def fell(self) -> bool:
        """Whether the root mean square error fell."""
        return _rms(self.after) < _rms(self.before)


def held_out_errors(residuals: Residuals, table: FrameTable, noise_m: float) -> list[Markup | None]:
    """Return the errors on held-out data: their distribution, and those of sweeps or frames."""
    sweeps = sweep_dots(table, noise_m)
    if not residuals.frame:
        return [sweeps]
    before, after = (np.linalg.norm(np.asarray(values, float), axis=1) for values in (residuals.before_m, residuals.after_m))
    median = [words.length(float(np.median(values))) for values in (before, after)]
    frames = _frames(residuals, before, after)
    fell = f"the error fell in {sum(frame.fell for frame in frames)} of {words.counted(len(frames), 'held-out frame')}"
    shares = as_image(
        _distribution(before, after, noise_m),
        alt=f"Share of held-out measurements with an error below a size, before and after; medians {median[0]} and {median[1]}.",
        caption=(
            f"{words.counted(len(before), 'measurement')} of {words.counted(len(set(residuals.marker)), 'marker')}; median "
            f"{median[0]} before, {median[1]} after; {fell}."
        ),
    )
    return [
        shares,
        sweeps
        or as_image(
            _dots(frames, noise_m, "frame"),
            alt=f"Root mean square error of each held-out frame before and after; {fell}.",
            caption="Error of each held-out frame.",
        ),
    ]


def sweep_dots(frames: FrameTable, noise_m: float) -> Markup | None:
    """Return the error of each sweep, held-out ones marked, with its frames as small dots; None where there is one sweep only."""
    keys = list(zip(sweep_labels(frames), frames.held_out))
    before, after = np.asarray(frames.before_rms_m, float), np.asarray(frames.after_rms_m, float)
    rows = {key: np.array([other == key for other in keys]) for key in dict.fromkeys(keys)}
    if len(rows) < 2:
        return None
    sweeps = [Group(label, before[own], after[own], held_out) for (label, held_out), own in rows.items()]
    held = [sweep for sweep in sweeps if sweep.held_out]
    fell = sum(sweep.fell for sweep in held)
    return as_image(
        _dots(sweeps, noise_m, "sweep"),
        alt=f"Error of each sweep before and after; it fell in {fell} of {len(held)} held-out sweeps.",
        caption=(
            f"Large dots: a sweep; small ones: its frames; held-out sweeps have a grey background. The error fell in {fell} of "
            f"{words.counted(len(held), 'held-out sweep')}."
        ),
    )


def _frames(residuals: Residuals, before: FloatArray, after: FloatArray) -> list[Group]:
    """Return the held-out frames in order, each with the errors of its markers."""
    recordings, frames = np.asarray(residuals.recording), np.asarray(residuals.frame)
    several = len(set(residuals.recording)) > 1
    groups = []
    for r, f in sorted(set(zip(residuals.recording, residuals.frame))):
        own = (recordings == r) & (frames == f)
        groups.append(Group(f"R{r + 1} {f}" if several else str(f), before[own], after[own]))
    return groups


def _distribution(before: FloatArray, after: FloatArray, noise_m: float) -> Any:
    """Draw the distribution function of the errors, next to that of noise alone."""
    figure, axes = new_axes()
    for values, color, name in ((before, BEFORE, "before"), (after, AFTER, "after")):
        axes.ecdf(1e3 * values, color=color, linewidth=1.9, label=name)
    top = 1e3 * float(np.quantile(np.concatenate([before, after]), 0.995)) * 1.08
    if noise_m > 0:
        top = max(top, 2.2e3 * noise_m)
        x = np.linspace(0.0, top, 200)
        axes.plot(x, _noise_share(x / (1e3 * noise_m)), color=SOFT, linewidth=1.2, linestyle=DASH, label="noise alone")
    axes.set(xlim=(0.0, max(top, 1e-9)), ylim=(0.0, 1.02))
    axes.yaxis.set_major_formatter(lambda share, _: f"{100 * share:.0f}")
    name_axes(axes, "error [mm]", "measurements below it [%]")
    add_legend(axes)
    return figure


def _noise_share(ratio: FloatArray) -> FloatArray:
    """Return the probability that 3-D Gaussian noise of root mean square 1 is below a size (Maxwell's distribution)."""
    from scipy.stats import maxwell

    return np.asarray(maxwell.cdf(ratio, scale=1.0 / math.sqrt(3.0)))


def _dots(groups: Sequence[Group], noise_m: float, axis: str) -> Any:
    """Draw the root mean square error of each group as a large dot, its members as small ones."""
    figure, axes = new_axes()
    places, few = np.arange(len(groups)), len(groups) <= FEW
    for place, group in zip(places, groups):
        if group.held_out:
            axes.axvspan(place - 0.5, place + 0.5, color=LINE, alpha=0.45, linewidth=0)
    for name, color, side in (("before", BEFORE, -0.13), ("after", AFTER, 0.13)):
        values = [getattr(group, name) for group in groups]
        if few:
            at, every = np.repeat(places + side, list(map(len, values))), 1e3 * np.concatenate(values)
            small = {"markersize": 3.2, "alpha": 0.5, "rasterized": len(at) > MANY}
            axes.plot(at, every, "o", color=color, markeredgewidth=0, **small)
        sizes = [1e3 * _rms(own) for own in values]
        axes.plot(places + side, sizes, "o", color=color, markersize=6.0 if few else 2.5, markeredgewidth=0, label=name)
    if words.known(noise_m):
        axes.axhline(1e3 * noise_m, color=SOFT, linewidth=1.2, linestyle=DASH, label="noise")
    step = max(1, math.ceil(len(groups) / LABELS))
    texts = [clipped(group.label, 10) for group in groups]
    turned = {"rotation": 30, "ha": "right"} if max(map(len, texts)) > 4 else {}
    axes.set_xticks(places[::step], texts[::step], **turned)
    axes.set_xlim(-0.6, len(groups) - 0.4)
    axes.set_ylim(bottom=0.0)
    axes.grid(False, axis="x")
    name_axes(axes, axis, "rms error [mm]")
    add_legend(axes)
    return figure


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan
