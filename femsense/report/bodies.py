"""Pictures of bodies: seen along an axis, with arrows on them, a scale, and the viewing direction of the camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, diagonal
from femsense.fem.mesh import TetMesh, surface_triangles
from femsense.report.drawing import INK, MANY, SIZE, SOFT, WIDTH, nice

ROW, SIGN = 15.0, 36.0
"""Heights below a body [pt]: of a line of text, and of the arrows that say where things point."""
BODY = np.array([0.80, 0.84, 0.89])
SHAFT = 0.018
"""Width of the shaft of an arrow [inch]."""


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """A viewing direction, given by the vectors that point right and up."""

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


@dataclass(frozen=True, eq=False, slots=True)
class Arrows:
    """Vectors on a body."""

    feet: FloatArray
    """[m], shape (k, 3)."""
    vectors: FloatArray
    """As they are drawn [m], shape (k, 3)."""
    color: str
    alpha: float = 1.0
    rings: bool = False
    """Whether a ring marks each foot."""

    @property
    def tips(self) -> FloatArray:
        """[m], shape (k, 3)."""
        return self.feet + self.vectors


@dataclass(frozen=True, eq=False, slots=True)
class Panel:
    """A body with its arrows."""

    surface: DrawnSurface | None
    arrows: tuple[Arrows, ...]
    color: str
    """Of title and key."""
    title: str = ""
    spots: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """Drawn as dots [m], shape (s, 3)."""


@dataclass(frozen=True, slots=True)
class Key:
    """A length that is explained below a body."""

    length_mm: float
    text: str
    color: str
    width: float | None = SHAFT
    """Of the shaft of its arrow [inch]; None for a bar."""


def best_view(points: FloatArray, vectors: FloatArray) -> View:
    """Return the view along an axis that shows most of the vectors (k, 3), and of the points (n, 3) they stand on."""

    def shown(view: View) -> float:
        whole = float((vectors**2).sum())
        share = float((view.flat(vectors) ** 2).sum()) / whole if whole > 0 else 1.0
        return share * math.sqrt(float(np.prod(np.ptp(view.flat(points), axis=0))))

    return max(VIEWS, key=shown)


def exaggeration(points: FloatArray, fields: Sequence[FloatArray], *, share: float) -> float:
    """Return a round factor by which vectors (k, 3) [m] are drawn longer on a body of some points (n, 3) [m], at least 1: the longest
    then has about this share of the size of the body."""
    largest = largest_of(fields)
    size = diagonal(points)
    return max(1.0, nice(share * size / largest)) if largest > 0 else 1.0


def largest_of(fields: Sequence[FloatArray]) -> float:
    """Return the length of the longest of several fields of vectors (k, 3); 0 where there are none."""
    return max((float(np.linalg.norm(field, axis=1).max(initial=0.0)) for field in fields), default=0.0)


def corners_of(panels: Sequence[Panel], view: View) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper corner [mm] of the rectangle that holds bodies and arrows of some panels, and of spots all but the
    farthest percent."""
    seen = [view.flat(p.surface.nodes) for p in panels if p.surface is not None]
    seen += [view.flat(points) for p in panels for arrows in p.arrows for points in (arrows.feet, arrows.tips)]
    seen += [np.quantile(view.flat(p.spots), [0.01, 0.99], axis=0) for p in panels if len(p.spots)]
    flat = 1e3 * np.vstack(seen)
    return flat.min(axis=0), flat.max(axis=0)


def body_figure(
    rows: Sequence[Sequence[Panel]],
    view: View,
    key: Key,
    *,
    corners: tuple[FloatArray, FloatArray] | None = None,
    cameras: Sequence[FloatArray] = (),
    width: float = WIDTH,
    most: float = 4.9,
) -> Any:
    """Return a figure of bodies with one scale.

    Arguments:
        rows: of panels, all of the same length.
        view: of all of them.
        key: what an arrow means; it has the colour of its panel.
        corners: of what each panel shows [mm]; by default all that there is (`corners_of`).
        cameras: unit vectors along which cameras look, drawn below the first panel; the axes of the robot frame where there are none.
        width: of the figure [inch].
        most: height of a panel at most [inch].
    """
    low, high = corners or corners_of([panel for row in rows for panel in row], view)
    columns = len(rows[0])
    height = len(rows) * body_height(low, high, width=width / columns, most=most)
    figure, grid = new_panels(len(rows), columns, width=width, height=height)
    for i, (row, line) in enumerate(zip(rows, grid)):
        for j, (panel, axes) in enumerate(zip(row, line)):
            draw_panel(axes, panel, view, shaft=key.width or SHAFT)
            looks = cameras if i == j == 0 else ()
            frame_body(axes, view, low, high, key=replace(key, color=panel.color), cameras=looks, corner=j == 0)
            place, size = ("left", SIZE + 1) if columns == 1 else ("center", SIZE)
            axes.set_title(panel.title, fontsize=size, color=panel.color, loc=place, fontweight="bold")
    return figure


def draw_panel(axes: Any, panel: Panel, view: View, *, shaft: float = SHAFT) -> None:
    """Draw a body [mm] with its spots and its arrows, whose shafts have a width [inch]."""
    if panel.surface is not None:
        _draw_body(axes, panel.surface, view)
    spots = 1e3 * view.flat(panel.spots)
    axes.plot(*spots.T, ".", color=panel.color, alpha=0.35, markersize=3, markeredgewidth=0, rasterized=len(spots) > MANY)
    for arrows in panel.arrows:
        feet = 1e3 * view.flat(arrows.feet)
        if arrows.rings:
            axes.plot(*feet.T, "o", color="white", markeredgecolor=INK, markeredgewidth=0.8, markersize=190 * shaft)
        vectors = 1e3 * view.flat(arrows.vectors)
        axes.quiver(*feet.T, *vectors.T, color=arrows.color, alpha=arrows.alpha, **_arrow_options(shaft))


def new_panels(rows: int, columns: int, *, width: float, height: float) -> tuple[Any, list[list[Any]]]:
    """Return a figure of its own with a grid of axes without a frame, for bodies."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    grid = figure.subplots(rows, columns, squeeze=False)
    return figure, [list(line) for line in grid]


def _arrow_options(width: float = SHAFT) -> dict[str, Any]:
    """Return options of arrows in units of the axes, with shafts of a width [inch]."""
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


def _draw_body(axes: Any, surface: DrawnSurface, view: View) -> None:
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


def body_height(low: FloatArray, high: FloatArray, *, width: float = WIDTH, most: float = 4.9) -> float:
    """Return the height of a picture of a rectangle with its title and keys [inch], where it takes the whole width."""
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
    """Show a rectangle [mm] with equal scales, without axes. Below it come, each in a line of its own, a scale bar, the key,
    and the viewing directions of the cameras, or else (where `corner`) the axes of the robot frame."""
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
    room = _below(axes, 0.0, below + SIGN)  # equal in all pictures, whether a camera or the axes are drawn
    axes.plot([low[0]], [0.0], "o", color="none", markersize=1, transform=room, clip_on=False)
    axes.dataLim.set_points(axes.viewLim.get_points())
    axes.set_autoscale_on(True)  # limits may be widened
    axes.set_aspect("equal", adjustable="datalim")  # widens the limits: the layout does not account for a box that shrinks


def _below(axes: Any, right: float, down: float) -> Any:
    """Return the transform from x [mm] and a height to a place below the lower edge of the axes, shifted by `right` and `down` [pt]."""
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
            [x], [0.0], [key.length_mm], [0.0], color=key.color, transform=line, clip_on=False, **_arrow_options(key.width)
        )
    _write(axes, x + key.length_mm, 6.0, down, key.text)


def _write(
    axes: Any, x: float, right: float, down: float, text: str, *, color: str = INK, size: float = SIZE - 0.5, ha: str = "left"
) -> None:
    axes.text(x, 0.0, text, transform=_below(axes, right, down), ha=ha, va="center_baseline", fontsize=size, color=color)


def _draw_cameras(axes: Any, view: View, directions: Sequence[FloatArray], x: float, down: float) -> None:
    """Draw the viewing directions of the cameras next to each other; one across the page as a ring with a dot (to the eye) or a cross."""
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
    """Draw the directions of the axes of the robot frame."""
    foot = (5.0, down + SIGN - 9.0)
    for name, (dx, dy) in zip(view.axes, ((1.0, 0.0), (0.0, 1.0))):
        _draw_way(axes, x, foot, (foot[0] + 14.0 * dx, foot[1] - 14.0 * dy), "->", SOFT, 0.9)
        _write(axes, x, foot[0] + 19.5 * dx, foot[1] - 19.5 * dy, name, color=SOFT, size=SIZE - 1, ha="center")


def _draw_way(
    axes: Any, x: float, start: tuple[float, float], end: tuple[float, float], style: str, color: str, width: float
) -> None:
    """Draw an arrow between two places, each given by its shift right of x [mm] and below the axes [pt]."""
    tail, tip = (_below(axes, *place) for place in (start, end))
    arrow = {"arrowstyle": style, "color": color, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(x, 0.0), xycoords=tip, xytext=(x, 0.0), textcoords=tail, arrowprops=arrow, annotation_clip=False)
