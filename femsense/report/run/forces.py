"""Contact forces of a run: over time, on the body, beside declared loads, one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from femsense.core.arrays import FloatArray, IntArray
from femsense.report import words
from femsense.report.bodies import Arrows, DrawnSurface, Key, Panel, best_view, body_figure, skin
from femsense.report.drawing import INK, MANY, SERIES, add_legend, as_image, name_axes, new_axes, nice
from femsense.report.run.tables import ContactTable, FrameTable, first_of, strongest_contact
from femsense.sensing.run_arrays import NOISE, undetermined_text
from femsense.sensing.run_files import read_states

ROWS = 150
"""So many contacts are listed one by one."""
SHOWN = len(SERIES)
ARROW_SHARE = 0.3
"""The longest arrow, in sizes of the body."""
SHAFT = 0.03
"""Width of an arrow [inch]."""


def force_text(size: float, std: float) -> str:
    """Return a force with its deviation, in N or mN."""
    factor, unit = words.force_unit(abs(size))
    return words.joined(words.with_std(factor * float(size), factor * float(std)), unit)


def force_pictures(contacts: ContactTable | None, frames: FrameTable | None, folder: Path) -> list[Markup | None]:
    """Return the forces over time, and on the body in the frame of the strongest."""
    if contacts is None or not np.isfinite(contacts.size_n).any():
        return []
    numbers = _largest_series(contacts)
    times = contacts.time_s if frames is None or not len(frames) else frames.time_s
    more = len(set(contacts.contact.tolist())) - len(numbers)
    rest = f" The {len(numbers)} strongest of {len(numbers) + more}." if more > 0 else ""
    strongest = strongest_contact(contacts, frames)
    largest = (
        "none of them above the noise"
        if strongest is None
        else f"the largest {force_text(contacts.size_n[strongest], contacts.std_n[strongest])}"
    )
    over_time = as_image(
        _force_figure(contacts, frames, numbers, (float(times.min()), float(times.max()))),
        alt=f"Force of {words.counted(len(numbers), 'contact')} over time; {largest}.",
        caption=f"Size of each force; the bands are ± 1 and ± 2 standard deviations.{rest}",
    )
    return [over_time, None if strongest is None else _force_on_body(contacts, frames, folder, contacts.frame[strongest])]


def _largest_series(contacts: ContactTable) -> list[int]:
    """Return the numbers of the contacts to draw: those with the largest forces, in order."""
    largest = {int(c): float(np.nanmax(contacts.size_n[contacts.contact == c], initial=0.0)) for c in np.unique(contacts.contact)}
    return sorted(sorted(largest, key=lambda c: -largest[c])[:SHOWN])


def _force_figure(contacts: ContactTable, frames: FrameTable | None, numbers: Sequence[int], span: tuple[float, float]) -> Any:
    figure, axes = new_axes()
    factor, unit = words.force_unit(float(np.nanmax(contacts.size_n)))
    order = contacts.frame if frames is None else frames.frame
    place = {int(frame): i for i, frame in enumerate(np.unique(order))}
    for color, number in zip(SERIES, numbers):
        rows = np.flatnonzero((contacts.contact == number) & np.isfinite(contacts.size_n))
        rows = rows[np.argsort(contacts.frame[rows], kind="stable")]
        at = np.array([place.get(int(f), -1) for f in contacts.frame[rows]])
        for run in np.split(rows, np.flatnonzero(np.diff(at) != 1) + 1):
            _draw_run(axes, contacts.time_s[run], factor * contacts.size_n[run], factor * contacts.std_n[run], color)
        many = len(rows) > MANY
        axes.plot(
            contacts.time_s[rows],
            factor * contacts.size_n[rows],
            "o",
            color=color,
            markersize=2.0 if len(rows) > 150 else 3.8,
            markeredgewidth=0,
            label=f"contact {number}",
            rasterized=many,
            zorder=4,
        )
    size, std = factor * contacts.size_n, factor * np.nan_to_num(contacts.std_n)
    top = min(float(np.nanmax(size + 2 * std)), 2.5 * float(np.nanmax(size)))
    margin = 0.03 * (span[1] - span[0]) or 1.0
    axes.set(ylim=(0.0, 1.06 * max(top, 1e-3)), xlim=(span[0] - margin, span[1] + margin))
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


def _force_on_body(contacts: ContactTable, frames: FrameTable | None, folder: Path, number: int) -> Markup | None:
    """Draw the body in the frame of the strongest force, with the forces on it."""
    surface = None if frames is None else _surface_at(folder / "states.npz", frames, number)
    whole = np.isfinite(contacts.force_n).all(axis=1) & np.isfinite(contacts.place_m).all(axis=1)
    rows = np.flatnonzero((contacts.frame == number) & whole)
    if surface is None or not len(rows) or not contacts.size_n[rows].max() > 0:
        return None
    text = "; ".join(f"contact {contacts.contact[i]} {force_text(contacts.size_n[i], contacts.std_n[i])}" for i in rows)
    return as_image(
        _draw_forces(surface, contacts, rows),
        alt=f"The deformed body in frame {number} with the forces on it: {text}.",
        caption=f"Frame {number}, with the strongest force: {text}.",
    )


def _surface_at(file: Path, frames: FrameTable, number: int) -> DrawnSurface | None:
    """Return the surface of the body in a frame; None where its state is not known."""
    index = np.flatnonzero(frames.frame == number)
    if not file.is_file() or not len(index):
        return None
    states = read_states(file)
    if index[0] >= len(states.nodes_m) or not np.isfinite(states.nodes_m[index[0]]).all():
        return None
    return skin(np.asarray(states.nodes_m[index[0]], dtype=np.float64), states.tets)


def _draw_forces(surface: DrawnSurface, contacts: ContactTable, rows: IntArray) -> Any:
    forces, tips = contacts.force_n[rows], contacts.place_m[rows]
    largest = float(contacts.size_n[rows].max())
    scale = ARROW_SHARE * float(np.linalg.norm(np.ptp(surface.nodes, axis=0))) / max(largest, 1e-12)
    colors = [SERIES[int(contact) % len(SERIES)] for contact in contacts.contact[rows]]
    arrows = tuple(Arrows((tip - scale * f)[None], scale * f[None], color) for tip, f, color in zip(tips, forces, colors))
    factor, unit = words.force_unit(largest)
    length = nice(largest)
    key = Key(1e3 * scale * length, f"{factor * length:g} {unit}", INK, SHAFT)
    return body_figure([[Panel(surface, arrows, INK)]], best_view(surface.nodes, forces), key)


@dataclass(frozen=True, eq=False, slots=True)
class ListedContacts:
    """Contacts one by one."""

    unit: str
    """Of their forces."""
    rows: Sequence[tuple[str, ...]]
    """Frame, time, contact, force, its components, its place, its source."""
    note: str
    """What is not listed."""


def listed_contacts(contacts: ContactTable) -> ListedContacts | None:
    """Return the contacts one by one, the first of many, also those that were seen and whose size is not determined.

    Other forces that noise may make are counted. None where there are none.
    """
    if not (contacts.sensed | contacts.undetermined).any():
        return None
    felt = np.flatnonzero(contacts.sensed | contacts.undetermined)
    factor, unit = words.force_unit(float(np.nanmax(contacts.size_n, initial=0.0)))
    rows = [
        (
            str(contacts.frame[i]),
            words.number(float(contacts.time_s[i])),
            str(contacts.contact[i]),
            undetermined_text(contacts.size_n[i], contacts.std_n[i]) if contacts.undetermined[i] else size,
            _vector(factor * contacts.force_n[i]),
            _vector(1e3 * contacts.place_m[i], 1),
            contacts.source[i] or words.NOTHING,
        )
        for i in felt[:ROWS]
        for size in [words.with_std(factor * float(contacts.size_n[i]), factor * float(contacts.std_n[i]))]
    ]
    note = first_of(len(felt), ROWS, "contacts.csv")
    if len(felt) < len(contacts):
        left_out = words.counted(len(contacts) - len(felt), "row")
        note += f" Of less than {NOISE:g} standard deviations, and so none: {left_out} more of contacts.csv."
    return ListedContacts(unit, rows, note)


def _vector(values: FloatArray, decimals: int | None = None) -> str:
    if decimals is None:
        return ", ".join(words.number(float(v), 2) for v in values)
    return ", ".join(f"{v:.{decimals}f}".replace("-", "−") if np.isfinite(v) else words.NOTHING for v in values)
