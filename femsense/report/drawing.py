"""Figures: one look for all of them, the body seen along an axis, and SVG that is the same each time."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray, IntArray
from femsense.fem.mesh import TetMesh, surface_triangles

BEFORE, AFTER = "#c8641b", "#1f6f5c"
INK, SOFT, LINE, PALE = "#1f252c", "#5b6673", "#dfe3e8", "#9aa4af"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9", "#4b3b8f", "#666666")
WIDTH, HEIGHT = 4.5, 3.0
"""Of a panel [inch]: readable at the width of a phone."""
SIZE = 9.5
MANY = 1500
"""So many points are drawn as pixels."""
ROW, SIGN = 15.0, 36.0
"""Heights below a body [pt]: of a line of text, and of the arrows that say where things point."""
BODY = np.array([0.80, 0.84, 0.89])


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """A direction to look along, given by what points right and up."""

    right: FloatArray
    up: FloatArray
    axes: tuple[str, str]

    @property
    def towards(self) -> FloatArray:
        """Unit vector from the body to the eye, shape (3,)."""
        return np.cross(self.right, self.up)

    def flat(self, points: FloatArray) -> FloatArray:
        """Return points or vectors (…, 3) as seen, (…, 2)."""
        return np.asarray(points) @ np.stack([self.right, self.up], axis=1)


X, Y, Z = np.eye(3)
VIEWS = (View(X, Z, ("x", "z")), View(Y, Z, ("y", "z")), View(X, Y, ("x", "y")))


@dataclass(frozen=True, eq=False, slots=True)
class DrawnSurface:
    """The skin of a body."""

    nodes: FloatArray
    """[m], shape (n, 3)."""
    triangles: IntArray
    """shape (t, 3)."""


def skin(nodes: FloatArray, tets: IntArray) -> DrawnSurface:
    """Return the skin of a body; mid-edge nodes are left out."""
    return DrawnSurface(np.asarray(nodes, dtype=np.float64), surface_triangles(TetMesh(nodes, tets[:, :4])))


def best_view(points: FloatArray, vectors: FloatArray) -> View:
    """Return the view along an axis that shows most of the vectors (k, 3), and of the points (n, 3) they stand on."""

    def shown(view: View) -> float:
        whole = float((vectors**2).sum())
        share = float((view.flat(vectors) ** 2).sum()) / whole if whole > 0 else 1.0
        return share * math.sqrt(float(np.prod(np.ptp(view.flat(points), axis=0))))

    return max(VIEWS, key=shown)


def nice(value: float) -> float:
    """Return the largest of 1, 2, 5 × 10ⁿ that is not above a value."""
    base = 10.0 ** math.floor(math.log10(max(value, 1e-300)))
    return next(step * base for step in (5.0, 2.0, 1.0) if step * base <= value * (1 + 1e-9))


def new_axes(*, width: float = WIDTH, height: float = HEIGHT) -> tuple[Any, Any]:
    """Return a figure of its own with axes of the report's look."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    axes.set_facecolor("white")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(PALE)
    axes.tick_params(colors=SOFT, labelsize=SIZE - 0.5, length=3, width=0.8)
    axes.grid(True, color=LINE, linewidth=0.7)
    axes.set_axisbelow(True)
    return figure, axes


def new_panels(rows: int, columns: int, *, width: float, height: float) -> tuple[Any, list[list[Any]]]:
    """Return a figure of its own with a grid of axes without a frame, for bodies."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    grid = figure.subplots(rows, columns, squeeze=False)
    return figure, [list(line) for line in grid]


def arrow_options(width: float = 0.018) -> dict[str, Any]:
    """Return how arrows in units of the axes are drawn, their shafts so wide [inch]."""
    return {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1.0,
        "units": "inches",
        "width": width,
        "headwidth": 3.6,
        "headlength": 4.2,
        "headaxislength": 3.8,
        "minlength": 0.2,
        "zorder": 5,
    }


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


def draw_body(axes: Any, surface: DrawnSurface, view: View) -> None:
    """Draw the skin of a body [mm], shaded, as pixels."""
    from matplotlib.collections import PolyCollection

    corners = 1e3 * surface.nodes[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    facing = normals @ view.towards
    front = np.flatnonzero(facing > 0)
    order = front[np.argsort((corners[front] @ view.towards).mean(axis=1), kind="stable")]
    light = 0.6 * view.towards + 0.5 * view.up - 0.3 * view.right
    shade = 0.74 + 0.30 * np.clip(normals[order] @ light / np.linalg.norm(light), 0.0, 1.0)
    colors = np.clip(BODY * shade[:, None], 0.0, 1.0)
    axes.add_collection(
        PolyCollection(list(view.flat(corners[order])), facecolors=colors, edgecolors=colors, linewidths=0.7, rasterized=True)
    )


@dataclass(frozen=True, slots=True)
class Key:
    """A length that is explained below a body."""

    length_mm: float
    text: str
    color: str
    width: float | None = 0.018
    """Of the shaft of its arrow [inch]; None for a bar."""


def body_height(low: FloatArray, high: FloatArray, *, width: float = WIDTH, most: float = 4.9) -> float:
    """Return how high a picture of a rectangle with its title and keys is [inch], where it takes the whole width."""
    across, up = high - low + 0.08 * float((high - low).max())
    return min(most, float((width - 0.1) * up / across) + (2 * ROW + SIGN) / 72.0 + 0.6)


def frame_body(
    axes: Any,
    view: View,
    low: FloatArray,
    high: FloatArray,
    *,
    key: Key | None = None,
    cameras: Sequence[FloatArray] = (),
    corner: bool = True,
) -> None:
    """Show a rectangle [mm] with equal scales, without axes. Below it stand, each in a line of its own, a scale bar, the key,
    and which way the cameras look, or else (where `corner`) the axes of the robot frame."""
    margin = 0.04 * float((high - low).max())
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    axes.axis("off")
    bar = nice(0.3 * float((high - low).max()))
    keys = [Key(bar, f"{bar:g} mm", INK, None), *([key] if key else [])]
    for i, one in enumerate(keys):
        _draw_key(axes, one, low[0], (i + 0.5) * ROW)
    below = len(keys) * ROW
    if len(cameras):
        _draw_cameras(axes, view, cameras, low[0], below)
    elif corner:
        _draw_cross(axes, view, low[0], below)
    room = _below(axes, 0.0, below + SIGN)  # the same in all pictures, whatever stands there
    axes.plot([low[0]], [0.0], "o", color="none", markersize=1, transform=room, clip_on=False)
    axes.dataLim.set_points(axes.viewLim.get_points())
    axes.set_autoscale_on(True)  # limits may be widened
    axes.set_aspect("equal", adjustable="datalim")  # widens what is shown: the layout knows nothing of a box that shrinks


def _below(axes: Any, right: float, down: float) -> Any:
    """Return the transform from x [mm] and a height to so many points right of and below the lower edge of the axes."""
    from matplotlib.transforms import ScaledTranslation, blended_transform_factory

    edge = blended_transform_factory(axes.transData, axes.transAxes)
    return edge + ScaledTranslation(right / 72.0, -down / 72.0, axes.figure.dpi_scale_trans)


def _draw_key(axes: Any, key: Key, x: float, down: float) -> None:
    """Draw a bar or an arrow of the length of a key from x [mm], with its text on the right."""
    line = _below(axes, 0.0, down)
    if key.width is None:
        axes.plot(
            [x, x + key.length_mm], [0.0, 0.0], color=key.color, linewidth=2, solid_capstyle="butt", transform=line, clip_on=False
        )
    else:
        axes.quiver(
            [x], [0.0], [key.length_mm], [0.0], color=key.color, transform=line, clip_on=False, **arrow_options(key.width)
        )
    _write(axes, x + key.length_mm, 6.0, down, key.text)


def _write(
    axes: Any, x: float, right: float, down: float, text: str, *, color: str = INK, size: float = SIZE - 0.5, ha: str = "left"
) -> None:
    axes.text(x, 0.0, text, transform=_below(axes, right, down), ha=ha, va="center_baseline", fontsize=size, color=color)


def _draw_cameras(axes: Any, view: View, directions: Sequence[FloatArray], x: float, down: float) -> None:
    """Draw which way the cameras look, beside each other; across the page as a ring with a dot (to the eye) or a cross."""
    middle = down + 0.5 * SIGN
    for i, direction in enumerate(directions[:2]):
        right = 12.0 + 72.0 * i
        flat = 11.0 * view.flat(direction)
        if float(np.linalg.norm(flat)) > 0.35 * 11.0:
            _draw_way(axes, x, (right - flat[0], middle + flat[1]), (right + flat[0], middle - flat[1]), "-|>", INK, 1.1)
        else:
            place = _below(axes, right, middle)
            axes.plot([x], [0.0], "o", color="white", markeredgecolor=INK, markersize=8, transform=place, clip_on=False)
            inner = "." if float(direction @ view.towards) > 0 else "x"
            axes.plot([x], [0.0], inner, color=INK, markersize=4, transform=place, clip_on=False)
        _write(axes, x, right + 16.0, middle, "camera" if len(directions) == 1 else f"camera {i + 1}")


def _draw_cross(axes: Any, view: View, x: float, down: float) -> None:
    """Draw which way the axes of the robot frame point."""
    foot = (5.0, down + SIGN - 9.0)
    for name, (dx, dy) in zip(view.axes, ((1.0, 0.0), (0.0, 1.0))):
        _draw_way(axes, x, foot, (foot[0] + 14.0 * dx, foot[1] - 14.0 * dy), "->", SOFT, 0.9)
        _write(axes, x, foot[0] + 19.5 * dx, foot[1] - 19.5 * dy, name, color=SOFT, size=SIZE - 1, ha="center")


def _draw_way(
    axes: Any, x: float, start: tuple[float, float], end: tuple[float, float], style: str, color: str, width: float
) -> None:
    """Draw an arrow between two places, each so many points right of x [mm] and below the axes."""
    tail, tip = (_below(axes, *place) for place in (start, end))
    arrow = {"arrowstyle": style, "color": color, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(x, 0.0), xycoords=tip, xytext=(x, 0.0), textcoords=tail, arrowprops=arrow, annotation_clip=False)


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
    axes.barh(places, values_mm, height=0.62, color=AFTER)
    for place, value in zip(places, values_mm):
        axes.text(value, place, f" {value:.2f}", va="center", fontsize=SIZE - 1, color=INK)
    axes.set_yticks(places, [clipped(name) for name in names])
    axes.invert_yaxis()
    axes.margins(x=0.14)
    axes.grid(False, axis="y")
    name_axes(axes, axis, "")
    return figure


def clipped(name: str, width: int = 22) -> str:
    """Return a name that fits beside an axis, without what matplotlib takes for mathematics."""
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
