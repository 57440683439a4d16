"""Contact forces of a run: over time, on the body, next to declared loads, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray, diagonal
from femsense.report import words
from femsense.report.bodies import Arrows, DrawnSurface, Key, Panel, best_view, body_figure, skin
from femsense.report.drawing import INK, MANY, SERIES, add_legend, as_image, name_axes, new_axes, nice
from femsense.report.run.document import SavedRun
from femsense.report.run.frames import column
from femsense.report.text import strongest_contact
from femsense.sensing.run_arrays import NOISE, sensed, undetermined, undetermined_text
from femsense.sensing.run_files import read_states
from femsense.sensing.types import ContactForce, FrameReport

ROWS = 150
"""Number of contacts that are listed one by one."""
SHOWN = len(SERIES)
"""Contacts that get a colour: those with the largest forces."""
ARROW_SHARE = 0.3
"""The longest arrow, in sizes of the body."""
SHAFT = 0.03
"""Width of an arrow [inch]."""


def force_text(size: float, std: float) -> str:
    """Return a force with its standard deviation, in N or mN."""
    factor, unit = words.force_unit(abs(size))
    return words.joined(words.with_std(factor * float(size), factor * float(std)), unit)


def force_pictures(run: SavedRun) -> list[Markup | None]:
    """Return the forces over time, and on the body in the frame of the strongest."""
    contacts = [c for c in run.contacts or () if np.isfinite(c.force_n)]
    if not contacts:
        return []
    tracks, shown = len({c.track for c in contacts}), len(largest_tracks(contacts))
    rest = f" The {shown} strongest of {tracks}." if tracks > shown else ""
    strongest = strongest_contact(contacts, run.frames or ())
    largest = "none of them above the noise"
    if strongest is not None:
        largest = f"the largest {force_text(strongest.force_n, strongest.std_n)}"
    over_time = as_image(
        forces_figure(contacts, run.frames or ()),
        alt=f"Force of {words.counted(shown, 'contact')} over time; {largest}.",
        caption=f"Size of each force; the bands are ± 1 and ± 2 standard deviations.{rest}",
    )
    return [over_time, None if strongest is None else _force_on_body(run, contacts, strongest.frame)]


def largest_tracks(contacts: Sequence[ContactForce]) -> list[int]:
    """Return the tracks to draw: those with the largest forces, in order."""
    largest: dict[int, float] = {}
    for c in contacts:
        largest[c.track] = max(largest.get(c.track, 0.0), c.force_n)
    return sorted(sorted(largest, key=lambda track: -largest[track])[:SHOWN])


def forces_figure(contacts: Sequence[ContactForce], frames: Sequence[FrameReport]) -> Any:
    """Return a matplotlib figure of the size of each force over time, with bands of one and two standard deviations.

    A point is hollow where its frame is not ok.

    Arguments:
        contacts: with sizes that are finite.
        frames: of the run; none where they are not known.
    """
    figure, axes = new_axes()
    size, std = column(contacts, "force_n"), np.nan_to_num(column(contacts, "std_n"))
    factor, unit = words.force_unit(float(size.max()))
    order = {frame: i for i, frame in enumerate(sorted({row.frame for row in frames or contacts}))}
    doubtful = {frame.frame for frame in frames if frame.status != "ok"}
    for color, track in zip(SERIES, largest_tracks(contacts)):
        rows = sorted((c for c in contacts if c.track == track), key=lambda c: c.frame)
        at = np.array([order.get(c.frame, -1) for c in rows])
        time, own, spread = (column(rows, name) for name in ("time_s", "force_n", "std_n"))
        for run in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(at) != 1) + 1):
            _draw_run(axes, time[run], factor * own[run], factor * spread[run], color)
        dots = {"markersize": 2.0 if len(rows) > 150 else 3.8, "rasterized": len(rows) > MANY, "zorder": 4}
        axes.plot(time, factor * own, "o", color=color, markeredgewidth=0, label=f"contact {track}", **dots)
        hollow = np.array([c.frame in doubtful for c in rows])
        axes.plot(time[hollow], factor * own[hollow], "o", mfc="white", mec=color, **dots)
    if any(c.frame in doubtful for c in contacts):
        axes.plot([], [], "o", markersize=3.8, mfc="white", mec=INK, label="frame not ok")
    top = factor * min(float((size + 2 * std).max()), 2.5 * float(size.max()))
    times = column(frames or contacts, "time_s")
    margin = 0.03 * float(np.ptp(times)) or 1.0
    axes.set(ylim=(0.0, 1.06 * max(top, 1e-3)), xlim=(times.min() - margin, times.max() + margin))
    name_axes(axes, "time [s]", f"force [{unit}]")
    add_legend(axes)
    return figure


def _draw_run(axes: Any, time: FloatArray, size: FloatArray, std: FloatArray, color: str) -> None:
    """Draw the bands of frames that follow each other; of a single frame as bars."""
    if len(time) == 1:
        axes.vlines(time, size - 2 * std, size + 2 * std, color=color, alpha=0.35, linewidth=1.6)
        axes.vlines(time, size - std, size + std, color=color, alpha=0.6, linewidth=3.2)
        return
    many = len(time) > MANY
    axes.fill_between(time, size - 2 * std, size + 2 * std, color=color, alpha=0.14, linewidth=0, rasterized=many)
    axes.fill_between(time, size - std, size + std, color=color, alpha=0.26, linewidth=0, rasterized=many)
    axes.plot(time, size, color=color, linewidth=1.3, rasterized=many)


def _force_on_body(run: SavedRun, contacts: Sequence[ContactForce], number: int) -> Markup | None:
    """Draw the body in the frame of the strongest force, with the forces on it."""
    surface = _surface_at(run.folder / "states.npz", run.frames or (), number)
    shown = [c for c in contacts if c.frame == number and np.isfinite([c.force_n_xyz, c.position_m]).all()]
    if surface is None or not shown or not max(c.force_n for c in shown) > 0:
        return None
    text = "; ".join(f"contact {c.track} {force_text(c.force_n, c.std_n)}" for c in shown)
    return as_image(
        _draw_forces(surface, shown),
        alt=f"The deformed body in frame {number} with the forces on it: {text}.",
        caption=f"Frame {number}, with the strongest force: {text}.",
    )


def _surface_at(file: Path, frames: Sequence[FrameReport], number: int) -> DrawnSurface | None:
    """Return the surface of the body in a frame; None where its state is not known."""
    k = next((k for k, frame in enumerate(frames) if frame.frame == number), None)
    if not file.is_file() or k is None:
        return None
    states = read_states(file)
    if k >= len(states.nodes_m) or not np.isfinite(states.nodes_m[k]).all():
        return None
    return skin(np.asarray(states.nodes_m[k], dtype=np.float64), states.tets)


def _draw_forces(surface: DrawnSurface, contacts: Sequence[ContactForce]) -> Any:
    largest = max(c.force_n for c in contacts)
    scale = ARROW_SHARE * diagonal(surface.nodes) / max(largest, 1e-12)
    arrows = []
    for c in contacts:
        vector = scale * c.force_n_xyz
        arrows.append(Arrows((c.position_m - vector)[None], vector[None], SERIES[c.track % len(SERIES)]))
    factor, unit = words.force_unit(largest)
    length = nice(largest)
    key = Key(1e3 * scale * length, f"{factor * length:g} {unit}", INK, SHAFT)
    view = best_view(surface.nodes, np.array([c.force_n_xyz for c in contacts]))
    return body_figure([[Panel(surface, tuple(arrows), INK)]], view, key)


@dataclass(frozen=True, eq=False, slots=True)
class ListedContacts:
    """Contacts one by one."""

    unit: str
    """Of their forces."""
    rows: Sequence[tuple[str, ...]]
    """Frame, time, contact, force, its components, its place, its source."""
    note: str
    """How many are not listed, and why."""


def listed_contacts(contacts: Sequence[ContactForce]) -> ListedContacts | None:
    """Return the significant contacts one by one, the first of many, and the visible ones whose size is not determined.

    Other forces that noise may make are counted. None where there are none.
    """
    weak = {id(c) for c in undetermined(contacts)}
    felt = weak | {id(c) for c in sensed(contacts)}
    shown = [c for c in contacts if id(c) in felt]
    if not shown:
        return None
    factor, unit = words.force_unit(float(np.nanmax(column(contacts, "force_n"), initial=0.0)))
    rows = [
        (
            str(c.frame),
            words.number(c.time_s),
            str(c.track),
            undetermined_text(c.force_n, c.std_n) if id(c) in weak else words.with_std(factor * c.force_n, factor * c.std_n),
            _vector(factor * c.force_n_xyz),
            _vector(1e3 * c.position_m, 1),
            c.source or words.NOTHING,
        )
        for c in shown[:ROWS]
    ]
    note = first_of(len(shown), ROWS, "contacts.csv")
    if len(shown) < len(contacts):
        left_out = words.counted(len(contacts) - len(shown), "row")
        note += f" Of less than {NOISE:g} standard deviations, and so none: {left_out} more of contacts.csv."
    return ListedContacts(unit, rows, note)


def first_of(count: int, shown: int, file: str) -> str:
    """Return a note on what a table leaves out; empty where it shows all."""
    return f" The first {shown} of {count}; all of them are in {file}." if count > shown else ""


def _vector(values: FloatArray, decimals: int | None = None) -> str:
    if decimals is None:
        return ", ".join(words.number(float(v), 2) for v in values)
    return ", ".join(f"{v:.{decimals}f}".replace("-", "−") if np.isfinite(v) else words.NOTHING for v in values)
