"""The picture of the demo: the robot with its forces, the forces over time, and the changes by the improved model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.io.files import write_beside
from femsense.report.bodies import Arrows, Key, Panel, best_view, corners_of, draw_panel, frame_body, skin
from femsense.report.drawing import AFTER, BEFORE, INK, add_legend, dress, name_axes, nice, whole_numbers

if TYPE_CHECKING:
    from femsense.sensing.comparison import TrueContact
    from femsense.sensing.types import Run

ARROW_SHARE = 0.35
"""The longest arrow, in sizes of the robot."""
SHAFT = 0.035
"""Width of an arrow [inch]."""
ROBOTS = (("before", "declared robot", BEFORE), ("after", "improved robot", AFTER))


def draw_demo(before: Run, after: Run, truth: Sequence[TrueContact], document: Mapping[str, Any], path: str | Path) -> Path:
    """Draw the demo into a PNG file and return its path.

    Arguments:
        before, after: the runs with the declared and with the improved robot.
        truth: the true contacts, none where they are not known.
        document: of `demo_document`.
        path: the file, replaced in one step.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 5.4), dpi=150, layout="constrained", facecolor="white")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    _draw_robot(figure.add_subplot(grid[:, 0]), before, after, truth)
    _draw_forces(dress(figure.add_subplot(grid[0, 1])), before, after, truth)
    _draw_residuals(dress(figure.add_subplot(grid[1, 1])), document["loop"])
    with write_beside(path) as part:
        figure.savefig(part, format="png", metadata={"Software": "femsense"})
    return Path(path)


def _draw_robot(axes: Any, before: Run, after: Run, truth: Sequence[TrueContact]) -> None:
    """Draw the body in the frame of the strongest force, with the forces on it."""
    number = _strongest_frame(after, truth)
    k = next((i for i, frame in enumerate(after.frames) if frame.frame == number), 0)
    surface = skin(np.asarray(after.states.nodes_m[k], dtype=np.float64), after.states.tets)
    groups: list[tuple[Sequence[Any], str, str]] = [
        (truth, "true", INK),
        (before.contacts, "declared robot", BEFORE),
        (after.contacts, "improved robot", AFTER),
    ]
    forces = [[(c.position_m, c.force_n_xyz) for c in contacts if c.frame == number] for contacts, *_ in groups]
    size = max((float(np.linalg.norm(force)) for group in forces for _, force in group), default=1.0)
    scale = ARROW_SHARE * float(np.ptp(surface.nodes, axis=0).max()) / max(size, 1e-12)
    arrows = []
    for (_, label, color), group in zip(groups, forces):
        for i, (place, force) in enumerate(group):
            arrows.append(Arrows((place - scale * force)[None], scale * force[None], color))
            axes.plot([], [], color=color, linewidth=2.5, label=None if i else f"{label}: {np.linalg.norm(force):.2f} N")
    panel = Panel(surface, tuple(arrows), INK)
    vectors = np.array([force for group in forces for _, force in group]).reshape(-1, 3)
    view = best_view(surface.nodes, vectors)
    draw_panel(axes, panel, view, shaft=SHAFT)
    length = nice(size)
    key = Key(1e3 * scale * length, f"{length:g} N", INK, SHAFT) if arrows else None
    frame_body(axes, view, *corners_of([panel], view), key=key)
    axes.set_title(f"contact forces in frame {number}", pad=24.0 if arrows else None)
    add_legend(axes)


def _draw_forces(axes: Any, before: Run, after: Run, truth: Sequence[TrueContact]) -> None:
    """Draw the sum of the sensed forces of each frame next to the truth."""
    frames = sorted({c.frame for contacts in (before.contacts, after.contacts, truth) for c in contacts})
    for run, (_, label, color), shift in zip((before, after), ROBOTS, (-0.12, 0.12)):
        contacts = [[c for c in run.contacts if c.frame == k] for k in frames]
        std = [2.0 * float(np.sqrt(sum(c.std_n**2 for c in some))) for some in contacts]
        at, sizes = np.asarray(frames) + shift, [_total([c.force_n_xyz for c in some]) for some in contacts]
        axes.errorbar(at, sizes, yerr=std, fmt="o", ms=4, capsize=2, color=color, label=f"{label} ± 2 σ")
    if truth:
        sizes = [_total([c.force_n_xyz for c in truth if c.frame == k]) for k in frames]
        axes.plot(frames, sizes, "_", ms=16, mew=2.5, color=INK, label="true", zorder=0)
    whole_numbers(axes)
    name_axes(axes, "frame", "contact force [N]")
    axes.margins(y=0.2)
    axes.set_ylim(bottom=0.0)
    add_legend(axes)


def _draw_residuals(axes: Any, loop: Mapping[str, Any]) -> None:
    """Draw residuals of the markers, before and after."""
    known = [
        (key, name)
        for key, name in (("train_rms_m", "all sweeps"), ("validation_rms_m", "held-out sweeps"))
        if all((loop.get(when) or {}).get(key) is not None for when, *_ in ROBOTS)
    ]
    for (when, label, color), shift in zip(ROBOTS, (0.18, -0.18)):
        values = [1e3 * loop[when][key] for key, _ in known]
        bars = axes.barh(np.arange(len(known)) + shift, values, height=0.34, color=color, label=label)
        axes.bar_label(bars, fmt=" %.2f mm", fontsize=9)
    axes.set_yticks(range(len(known)), [name for _, name in known])
    axes.margins(x=0.2)
    if loop.get("noise_m") is not None:
        axes.axvline(1e3 * loop["noise_m"], color=INK, lw=1, ls=":", label="noise of a marker")
    lacked = ", ".join(str(effect.get("name", "")).replace("_", " ") for effect in loop.get("effects") or [])
    axes.set_title(f"the model lacked: {lacked}" if lacked else "residual of the model", pad=24.0)
    name_axes(axes, "rms distance of markers from the model [mm]", "")
    add_legend(axes)


def _strongest_frame(run: Run, truth: Sequence[TrueContact]) -> int:
    """Return the frame of the largest true force that was sensed, else of the largest sensed force."""
    found = {c.frame for c in run.contacts}
    sizes = [(float(np.linalg.norm(c.force_n_xyz)), c.frame) for c in truth if c.frame in found]
    sizes = sizes or [(c.force_n, c.frame) for c in run.contacts]
    return max(sizes)[1] if sizes else run.frames[0].frame


def _total(forces: Sequence[FloatArray]) -> float:
    return float(np.linalg.norm(np.sum(forces, axis=0))) if forces else 0.0
