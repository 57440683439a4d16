"""The picture of the demo: the robot with its forces, the forces over time, and what the improved model changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import TetMesh, surface_triangles
from femsense.io.files import write_beside

if TYPE_CHECKING:
    from femsense.app.demo.truth import TrueContact
    from femsense.sensing.types import Run

BODY = np.array([0.62, 0.72, 0.86])
TRUE, DECLARED, IMPROVED = "#222222", "#d9822b", "#1f6f5c"
LIGHT = np.array([0.35, -0.55, 0.76])
ARROW_SHARE = 0.35
"""The longest arrow, in sizes of the robot."""


def draw_demo(before: Run, after: Run, truth: Sequence[TrueContact], document: Mapping[str, Any], path: str | Path) -> Path:
    """Draw the demo into a PNG file and return its path.

    Arguments:
        before, after: the runs with the declared and with the improved robot.
        truth: the true contacts, none where they are not known.
        document: of `demo_document`.
        path: the file, replaced in one step.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 5.4), dpi=150, layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    _draw_robot(figure.add_subplot(grid[:, 0], projection="3d"), before, after, truth)
    _draw_forces(figure.add_subplot(grid[0, 1]), before, after, truth)
    _draw_residuals(figure.add_subplot(grid[1, 1]), document)
    with write_beside(path) as part:
        figure.savefig(part, format="png", metadata={"Software": "femsense"})
    return Path(path)


def _draw_robot(axes: Any, before: Run, after: Run, truth: Sequence[TrueContact]) -> None:
    """Draw the body in the frame of the strongest force, with the forces on it."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    number = _strongest_frame(after, truth)
    k = next((i for i, frame in enumerate(after.frames) if frame.frame == number), 0)
    nodes = np.asarray(after.states.nodes_m[k], dtype=np.float64)
    corners = nodes[surface_triangles(TetMesh(after.states.rest_nodes_m, after.states.tets))[:, :3]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    shade = 0.55 + 0.45 * np.clip(normals @ LIGHT, 0.0, 1.0)
    axes.add_collection3d(
        Poly3DCollection(1e3 * corners, facecolors=np.clip(BODY * shade[:, None], 0, 1), edgecolors="none", zorder=1)
    )
    groups = [
        ([(c.position_m, c.force_n_xyz) for c in truth if c.frame == number], TRUE, "true", 4.0),
        ([(c.position_m, c.force_n_xyz) for c in before.contacts if c.frame == number], DECLARED, "declared robot", 2.0),
        ([(c.position_m, c.force_n_xyz) for c in after.contacts if c.frame == number], IMPROVED, "improved robot", 2.0),
    ]
    largest = max((float(np.linalg.norm(force)) for arrows, *_ in groups for _, force in arrows), default=1.0)
    scale = 1e3 * ARROW_SHARE * float(np.ptp(nodes, axis=0).max()) / max(largest, 1e-12)
    for arrows, color, label, width in groups:
        for i, (place, force) in enumerate(arrows):
            _arrow(axes, 1e3 * place, scale * force, color, width, f"{label}: {np.linalg.norm(force):.2f} N" if i == 0 else None)
    _equal_axes(axes, 1e3 * nodes)
    axes.set_title(f"contact forces in frame {number}")
    if any(arrows for arrows, *_ in groups):
        axes.legend(loc="upper left", frameon=False)


def _arrow(axes: Any, tip: FloatArray, force: FloatArray, color: str, width: float, label: str | None) -> None:
    """Draw a force that ends at the place where it pushes."""
    axes.quiver(*(tip - force), *force, color=color, linewidth=width, arrow_length_ratio=0.2, label=label, zorder=10)


def _equal_axes(axes: Any, points: FloatArray) -> None:
    middle, half = (points.max(axis=0) + points.min(axis=0)) / 2, 0.55 * float(np.ptp(points, axis=0).max())
    low = float(points[:, 2].min())
    axes.set(
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        zlim=(low, low + 1.4 * half),
        xlabel="x [mm]",
        ylabel="y [mm]",
        zlabel="z [mm]",
    )
    axes.set_box_aspect((1, 1, 0.7), zoom=1.15)
    axes.view_init(elev=22, azim=-62)
    axes.computed_zorder = False


def _draw_forces(axes: Any, before: Run, after: Run, truth: Sequence[TrueContact]) -> None:
    """Draw the sum of the sensed forces of each frame next to the truth."""
    frames = sorted({c.frame for c in before.contacts} | {c.frame for c in after.contacts} | {c.frame for c in truth})
    for run, color, label, shift in ((before, DECLARED, "declared robot", -0.12), (after, IMPROVED, "improved robot", 0.12)):
        size = [_total([c.force_n_xyz for c in run.contacts if c.frame == k]) for k in frames]
        std = [float(np.sqrt(sum(c.std_n**2 for c in run.contacts if c.frame == k))) for k in frames]
        axes.errorbar(
            np.asarray(frames) + shift,
            size,
            yerr=2 * np.asarray(std),
            fmt="o",
            ms=4,
            capsize=2,
            color=color,
            label=f"{label} ± 2 σ",
        )
    if truth:
        axes.plot(
            frames,
            [_total([c.force_n_xyz for c in truth if c.frame == k]) for k in frames],
            "_",
            ms=16,
            mew=2.5,
            color=TRUE,
            label="true",
            zorder=0,
        )
    axes.set(xlabel="frame", ylabel="contact force [N]", title="force over the frames")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(y=0.2)
    axes.set_ylim(bottom=0.0)
    if frames:
        axes.legend(frameon=False, fontsize=8)


def _draw_residuals(axes: Any, document: Mapping[str, Any]) -> None:
    """Draw residuals of the markers, before and after."""
    loop = document["loop"]
    keys = [
        (key, name) for key, name in (("train_rms_m", "all sweeps"), ("validation_rms_m", "held-out sweeps")) if _both(loop, key)
    ]
    for i, (key, _) in enumerate(keys):
        for when, color, shift in (("before", DECLARED, 0.18), ("after", IMPROVED, -0.18)):
            value = 1e3 * loop[when][key]
            axes.barh(
                i + shift,
                value,
                height=0.34,
                color=color,
                label={"before": "declared robot", "after": "improved robot"}[when] if i == 0 else None,
            )
            axes.text(value, i + shift, f" {value:.2f} mm", va="center", fontsize=9)
    axes.set_yticks(range(len(keys)), [name for _, name in keys])
    axes.margins(x=0.45)
    axes.set(xlabel="rms distance of markers from the model [mm]", title=_found(loop))
    axes.spines[["top", "right"]].set_visible(False)
    if loop.get("noise_m") is not None:
        axes.axvline(1e3 * loop["noise_m"], color=TRUE, lw=1, ls=":", label="noise of a marker")
    axes.legend(frameon=False, fontsize=8, loc="center right")


def _both(loop: Mapping[str, Any], key: str) -> bool:
    return all((loop.get(when) or {}).get(key) is not None for when in ("before", "after"))


def _found(loop: Mapping[str, Any]) -> str:
    names = ", ".join(str(effect.get("name", "")).replace("_", " ") for effect in loop.get("effects") or [])
    return f"the model lacked: {names}" if names else "residual of the model"


def _strongest_frame(run: Run, truth: Sequence[TrueContact]) -> int:
    """Return the frame of the largest true force that was sensed, else of the largest sensed force."""
    sensed = {c.frame for c in run.contacts}
    sizes = [(float(np.linalg.norm(c.force_n_xyz)), c.frame) for c in truth if c.frame in sensed] or [
        (c.force_n, c.frame) for c in run.contacts
    ]
    return max(sizes)[1] if sizes else run.frames[0].frame


def _total(forces: Sequence[FloatArray]) -> float:
    return float(np.linalg.norm(np.sum(forces, axis=0))) if forces else 0.0
