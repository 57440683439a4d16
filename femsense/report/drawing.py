"""Figures: one look for all of them, and SVG that is the same each time."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

BEFORE, AFTER = "#c8641b", "#1f6f5c"
INK, SOFT, LINE, PALE = "#1f252c", "#5b6673", "#dfe3e8", "#9aa4af"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#4b3b8f", "#666666")
WIDTH, HEIGHT = 4.5, 3.0
"""Of a panel [inch]: readable at the width of a phone."""
SIZE = 9.5
MANY = 1500
"""From this number on, points are drawn as pixels."""


def nice(value: float) -> float:
    """Return the largest of 1, 2, 5 × 10ⁿ that is not above a value."""
    base = 10.0 ** math.floor(math.log10(max(value, 1e-300)))
    return next(step * base for step in (5.0, 2.0, 1.0) if step * base <= value * (1 + 1e-9))


def new_axes(*, width: float = WIDTH, height: float = HEIGHT) -> tuple[Any, Any]:
    """Return a figure of its own with axes of the report's look."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    return figure, dress(figure.add_subplot())


def dress(axes: Any) -> Any:
    """Return axes with the report's look."""
    axes.set_facecolor("white")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(PALE)
    axes.tick_params(colors=SOFT, labelsize=SIZE - 0.5, length=3, width=0.8)
    axes.grid(True, color=LINE, linewidth=0.7)
    axes.set_axisbelow(True)
    return axes


def name_axes(axes: Any, x: str, y: str) -> None:
    """Name both axes."""
    axes.set_xlabel(x, fontsize=SIZE, color=INK)
    axes.set_ylabel(y, fontsize=SIZE, color=INK)


def add_legend(axes: Any, **options: Any) -> None:
    """Explain the colours above the axes, where nothing is covered."""
    handles, _ = axes.get_legend_handles_labels()
    columns = options.pop("columns", min(len(handles), 3))
    if handles:
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=columns,
            frameon=False,
            fontsize=SIZE - 0.5,
            labelcolor=INK,
            borderaxespad=0.2,
            handlelength=1.4,
            columnspacing=1.3,
            handletextpad=0.5,
            **options,
        )


def whole_numbers(axes: Any) -> None:
    """Have only whole numbers on the x axis."""
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(nbins=7, integer=True))


def marker_bars(rms_m: Mapping[str, float | None], title: str, *, most: int, axis: str) -> Markup | None:
    """Return the residuals of markers [m] as bars, the `most` largest of them, the largest on top; None where none is known."""
    sizes = sorted(((1e3 * v, name) for name, v in rms_m.items() if v is not None and math.isfinite(v)), reverse=True)
    if not sizes:
        return None
    shown = sizes[:most]
    more = f" The {len(shown)} largest of {len(sizes)}." if len(sizes) > len(shown) else ""
    figure = _draw_bars([name for _, name in shown], [size for size, _ in shown], axis)
    return as_image(figure, alt=f"{title}: the largest {shown[0][0]:.2f} mm at {shown[0][1]}.", caption=f"{title}.{more}")


def _draw_bars(names: Sequence[str], values_mm: Sequence[float], axis: str) -> Any:
    figure, axes = new_axes(height=max(1.5, 0.55 + 0.26 * len(names)))
    places = np.arange(len(names))
    axes.bar_label(axes.barh(places, values_mm, height=0.62, color=AFTER), fmt=" %.2f", fontsize=SIZE - 1, color=INK)
    axes.set_yticks(places, [clipped(name) for name in names])
    axes.invert_yaxis()
    axes.margins(x=0.14)
    axes.grid(False, axis="y")
    name_axes(axes, axis, "")
    return figure


def clipped(name: str, width: int = 22) -> str:
    """Return a name that fits next to an axis; dollar signs are escaped, which matplotlib reads as mathematics."""
    text = name if len(name) <= width else name[: width - 1] + "…"
    return text.replace("$", r"\$")


def as_image(figure: Any, *, alt: str, caption: str = "", wide: bool = False) -> Markup:
    """Return a figure of matplotlib as part of a page; see `image`."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", dpi=170, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = stream.getvalue()
    return image(_stable(svg[svg.index("<svg") :]).encode(), "svg+xml", alt=alt, caption=caption, wide=wide)


def image(data: bytes, kind: str, *, alt: str, caption: str = "", wide: bool = False) -> Markup:
    """Return a picture inside the page.

    Arguments:
        data: the picture.
        kind: "svg+xml" or "png".
        alt: what it shows, for those who do not see it.
        caption: stands below it.
        wide: over the whole width of the page.
    """
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    below = Markup("<figcaption>{}</figcaption>\n").format(caption) if caption else ""
    class_ = Markup(' class="wide"') if wide else ""
    return Markup('<figure{}><img src="{}" alt="{}">{}</figure>').format(class_, source, alt, below)


def _stable(svg: str) -> str:
    """Return an SVG of matplotlib with its random names numbered in the order in which they appear."""
    names: dict[str, str] = {}

    def numbered(match: re.Match[str]) -> str:
        return names.setdefault(match.group(0), f"n{len(names)}")

    return re.sub(r'(?<=[#"])(?:[A-Za-z]\w*?)?[0-9a-f]{10}(?=[)"])', numbered, svg)
