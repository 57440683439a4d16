"""The report on a run: forces over time, contacts, what became of each frame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray
from femsense.io.tables import read_csv
from femsense.report import words
from femsense.report.compare import load_error
from femsense.report.documents import KnownLoad, RunFacts, read_document
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    MANY,
    SERIES,
    SOFT,
    Key,
    add_legend,
    as_image,
    best_view,
    body_height,
    clipped,
    draw_body,
    frame_body,
    name_axes,
    new_axes,
    nice,
    skin,
    whole_numbers,
)
from femsense.report.page import Chapter, Html, panels, paragraph, section, table, tiles, together
from femsense.sensing.run_files import CONTACT_COLUMNS, FRAME_COLUMNS, MORE_CONTACT_COLUMNS, RUN_FORMAT, read_states

ROWS = 150
"""So many contacts are listed one by one."""
SHOWN = len(SERIES)
LISTED = 40
ARROW_SHARE = 0.3


@dataclass(frozen=True, eq=False, slots=True)
class ContactTable:
    """contacts.csv."""

    frame: IntArray
    contact: IntArray
    time_s: FloatArray
    place_m: FloatArray
    """shape (k, 3)."""
    force_n: FloatArray
    """shape (k, 3)."""
    size_n: FloatArray
    std_n: FloatArray
    source: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, eq=False, slots=True)
class FrameTable:
    """frames.csv."""

    frame: IntArray
    time_s: FloatArray
    status: tuple[str, ...]
    contacts: IntArray
    matched: IntArray
    before_m: FloatArray
    after_m: FloatArray
    ms: FloatArray
    tension_n: dict[str, FloatArray]
    pressure_pa: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def good(self) -> npt.NDArray[np.bool_]:
        return np.array([status == "ok" for status in self.status], dtype=bool)


def run_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a run.

    Arguments:
        file: run.json; contacts.csv, frames.csv and states.npz beside it are shown if they are there.
        title: of the chapter.

    Raises:
        InputError: one of them is broken.
    """
    facts = read_document(file, RunFacts, RUN_FORMAT)
    folder = file.parent
    contacts = _contacts(folder / "contacts.csv") if (folder / "contacts.csv").is_file() else None
    frames = _frames(folder / "frames.csv") if (folder / "frames.csv").is_file() else None
    body = together(
        _summary(facts, contacts, frames),
        section("Contact forces", _forces(contacts, frames, folder)),
        section("Known loads", _known_loads(facts.known_loads)),
        section("Contacts", _contact_rows(contacts)),
        section("Frames", _statuses(frames), _frame_panels(frames)),
        section("Made from", _origin(facts)),
    )
    return Chapter(title, body, _headline(facts, contacts, frames), facts.robot)


def _contacts(file: Path) -> ContactTable:
    table_ = read_csv(file, required=CONTACT_COLUMNS, optional=MORE_CONTACT_COLUMNS)
    values = table_.numbers(("time_s", *CONTACT_COLUMNS[3:14]), empty_is_nan=True)
    return ContactTable(
        table_.integers("frame"),
        table_.integers("contact"),
        values[:, 0],
        values[:, 1:4],
        values[:, 7:10],
        values[:, 10],
        values[:, 11],
        table_.text("source"),
    )


def _frames(file: Path) -> FrameTable:
    table_ = read_csv(file, required=FRAME_COLUMNS, prefixes=("tension_", "pressure_"))
    cables = [c for c in table_.columns if c.startswith("tension_")]
    chambers = [c for c in table_.columns if c.startswith("pressure_")]
    values = table_.numbers(("time_s", "rms_before_m", "rms_after_m", "ms", *cables, *chambers), empty_is_nan=True)
    tension = {c.removeprefix("tension_").removesuffix("_n"): values[:, 4 + j] for j, c in enumerate(cables)}
    pressure = {c.removeprefix("pressure_").removesuffix("_pa"): values[:, 4 + len(cables) + j] for j, c in enumerate(chambers)}
    return FrameTable(
        table_.integers("frame"),
        values[:, 0],
        table_.text("status"),
        table_.integers("contacts"),
        table_.integers("matched"),
        values[:, 1],
        values[:, 2],
        values[:, 3],
        tension,
        pressure,
    )


# On top


def _headline(facts: RunFacts, contacts: ContactTable | None, frames: FrameTable | None) -> str:
    base = f"{words.counted(facts.contacts, 'contact')} in {words.counted(facts.frames, 'frame')}"
    doubted = 0 if frames is None else int((~frames.good & np.isfinite(frames.after_m)).sum())
    lost = facts.frames - facts.frames_ok - doubted
    if lost:
        base += f", {lost} of them without a result"
    if doubted:
        base += f", {doubted} of them not to be trusted"
    strongest = _strongest(contacts, frames)
    if contacts is None or strongest is None:
        return f"{base}."
    return f"{base}; largest force {_force(contacts.size_n[strongest], contacts.std_n[strongest])} in frame {contacts.frame[strongest]}."


def _strongest(contacts: ContactTable | None, frames: FrameTable | None) -> int | None:
    """Return the row of the largest force of the frames that are ok; None where there is none."""
    if contacts is None:
        return None
    bad = [] if frames is None else frames.frame[~frames.good].tolist()
    size = np.where(np.isin(contacts.frame, bad), np.nan, contacts.size_n)
    return None if not np.isfinite(size).any() else int(np.nanargmax(size))


def _force(size: float, std: float) -> str:
    factor, unit = words.force_unit(abs(size))
    return words.joined(words.with_std(factor * float(size), factor * float(std)), unit)


def _summary(facts: RunFacts, contacts: ContactTable | None, frames: FrameTable | None) -> Html:
    items = [("Frames ok", f"{facts.frames_ok} of {facts.frames}", "")]
    touched = 0 if contacts is None else len(set(contacts.frame.tolist()))
    items.append(("Contacts", str(facts.contacts), f"in {words.counted(touched, 'frame')}" if contacts is not None else ""))
    if frames is not None and len(frames):
        rows = frames.good & (frames.contacts > 0) if (frames.good & (frames.contacts > 0)).any() else frames.good
        before, after = _median(frames.before_m[rows]), _median(frames.after_m[rows])
        items.append(("Residual with the forces", words.length(after), f"{words.length(before)} without them; median rms"))
    if words.known(facts.timing.ms_per_frame_median):
        items.append(("Time a frame", words.joined(words.number(facts.timing.ms_per_frame_median), "ms"), "median"))
    return tiles(items)


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


# Forces


def _forces(contacts: ContactTable | None, frames: FrameTable | None, folder: Path) -> Html | None:
    if contacts is None or not np.isfinite(contacts.size_n).any():
        return None
    numbers = _largest_series(contacts)
    times = contacts.time_s if frames is None or not len(frames) else frames.time_s
    more = len(set(contacts.contact.tolist())) - len(numbers)
    rest = f" The {len(numbers)} strongest of {len(numbers) + more}." if more > 0 else ""
    strongest = _strongest(contacts, frames) or 0
    over_time = as_image(
        _force_figure(contacts, frames, numbers, (float(times.min()), float(times.max()))),
        alt=f"Force of {words.counted(len(numbers), 'contact')} over time; the largest {_force(contacts.size_n[strongest], contacts.std_n[strongest])}.",
        caption=f"Size of each force; the bands are ± 1 and ± 2 standard deviations.{rest}",
    )
    return panels(over_time, _force_on_body(contacts, frames, folder, contacts.frame[strongest]))


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


def _force_on_body(contacts: ContactTable, frames: FrameTable | None, folder: Path, number: int) -> Html | None:
    """Draw the body in the frame of the strongest force, with the forces on it."""
    file = folder / "states.npz"
    if not file.is_file() or frames is None:
        return None
    states = read_states(file)
    index = np.flatnonzero(frames.frame == number)
    if not len(index) or index[0] >= len(states.nodes_m) or not np.isfinite(states.nodes_m[index[0]]).all():
        return None
    surface = skin(np.asarray(states.nodes_m[index[0]], dtype=np.float64), states.tets)
    rows = np.flatnonzero(
        (contacts.frame == number) & np.isfinite(contacts.force_n).all(axis=1) & np.isfinite(contacts.place_m).all(axis=1)
    )
    if not len(rows) or not contacts.size_n[rows].max() > 0:
        return None
    view = best_view(surface.nodes, contacts.force_n[rows])
    largest = float(contacts.size_n[rows].max())
    scale = ARROW_SHARE * float(np.linalg.norm(np.ptp(surface.nodes, axis=0))) / max(largest, 1e-12)
    tips = contacts.place_m[rows]
    tails = tips - scale * contacts.force_n[rows]
    flat = 1e3 * view.flat(np.vstack([surface.nodes, tips, tails]))
    low, high = flat.min(axis=0), flat.max(axis=0)
    figure, axes = new_axes(height=body_height(low, high))
    draw_body(axes, surface, view)
    for i, tail, tip in zip(rows, 1e3 * view.flat(tails), 1e3 * view.flat(tips)):
        color = SERIES[int(contacts.contact[i]) % len(SERIES)]
        axes.annotate(
            "",
            xy=tuple(tip),
            xytext=tuple(tail),
            arrowprops={
                "arrowstyle": "-|>,head_length=0.55,head_width=0.28",
                "color": color,
                "linewidth": 2.2,
                "shrinkA": 0,
                "shrinkB": 0,
            },
            zorder=6,
        )
    factor, unit = words.force_unit(largest)
    bar = nice(largest)
    frame_body(axes, view, low, high, key=Key(1e3 * scale * bar, f"{factor * bar:g} {unit}", SERIES[0], None))
    text = "; ".join(f"contact {contacts.contact[i]} {_force(contacts.size_n[i], contacts.std_n[i])}" for i in rows)
    return as_image(
        figure,
        alt=f"The deformed body in frame {number} with the forces on it: {text}.",
        caption=f"Frame {number}, with the strongest force: {text}.",
    )


def _known_loads(loads: Sequence[KnownLoad]) -> Html | None:
    rows = [
        [str(load.frame), words.number(load.declared_n), words.number(load.sensed_n), _signed(load.error_percent)]
        for load in loads[:ROWS]
    ]
    error = load_error(loads)
    text = paragraph(f"The median size of the error is {error}.") if error != words.NOTHING else None
    caption = "Declared loads at the given places next to the forces that were sensed there." + _cut(len(loads), ROWS, "run.json")
    return (
        together(text, table(("Frame", "Declared [N]", "Sensed [N]", "Error [%]"), rows, caption=caption, numeric=(1, 2, 3)))
        or None
    )


def _signed(value: float | None) -> str:
    return words.NOTHING if value is None or not words.known(value) else f"{value:+.1f}".replace("-", "−")


def _cut(count: int, shown: int, file: str) -> str:
    return f" The first {shown} of {count}; all of them are in {file}." if count > shown else ""


def _contact_rows(contacts: ContactTable | None) -> Html | None:
    if contacts is None or not len(contacts):
        return None
    factor, unit = words.force_unit(float(np.nanmax(contacts.size_n, initial=0.0)))
    rows = [
        [
            str(contacts.frame[i]),
            words.number(float(contacts.time_s[i])),
            str(contacts.contact[i]),
            words.with_std(factor * float(contacts.size_n[i]), factor * float(contacts.std_n[i])),
            _vector(factor * contacts.force_n[i]),
            _vector(1e3 * contacts.place_m[i], 1),
            contacts.source[i] or words.NOTHING,
        ]
        for i in range(min(len(contacts), ROWS))
    ]
    headers = ("Frame", "Time [s]", "Contact", f"Force [{unit}]", f"Components x, y, z [{unit}]", "Place x, y, z [mm]", "Source")
    caption = "Force on the body and its place on the deformed body, robot frame." + _cut(len(contacts), ROWS, "contacts.csv")
    return table(headers, rows, caption=caption, numeric=(1, 2, 3, 4, 5))


def _vector(values: FloatArray, decimals: int | None = None) -> str:
    if decimals is None:
        return ", ".join(words.number(float(v), 2) for v in values)
    return ", ".join(f"{v:.{decimals}f}".replace("-", "−") if np.isfinite(v) else words.NOTHING for v in values)


# Frames


def _statuses(frames: FrameTable | None) -> Html | None:
    """Return the table of frames without a result by their reason."""
    if frames is None or not len(frames):
        return None
    counts = Counter(frames.status)
    reasons = sorted(counts, key=lambda status: (status != "ok", -counts[status]))
    rows = []
    for status in reasons[:LISTED]:
        members = [int(f) for f, s in zip(frames.frame, frames.status) if s == status]
        rows.append(["with a result" if status == "ok" else f"none: {status}", str(counts[status]), words.frame_list(members)])
    caption = "What became of the frames." + _cut(len(reasons), LISTED, "frames.csv")
    return table(("Result", "Frames", "Which"), rows, caption=caption, numeric=(1,))


def _frame_panels(frames: FrameTable | None) -> Html | None:
    if frames is None or not frames.good.any():
        return None
    return panels(_residual_panel(frames), _time_panel(frames), _tension_panel(frames), _pressure_panel(frames))


def _residual_panel(frames: FrameTable) -> Html | None:
    if not np.isfinite(frames.before_m).any():
        return None
    figure, axes = new_axes()
    for values, color, name in ((frames.before_m, BEFORE, "without forces"), (frames.after_m, AFTER, "with the forces")):
        _dots(axes, frames, 1e3 * values, color, name)
    axes.set_ylim(0.0, 1.08 * max(1e3 * float(np.nanmax([frames.before_m, frames.after_m])), 1e-9))
    whole_numbers(axes)
    name_axes(axes, "frame", "rms residual [mm]")
    add_legend(axes)
    before, after = (words.length(_median(values)) for values in (frames.before_m, frames.after_m))
    return as_image(
        figure,
        alt=f"Residual of each frame without and with the contact forces; medians {before} and {after}.",
        caption=f"Residual of the model; median {before} without forces, {after} with them.",
    )


def _dots(axes: Any, frames: FrameTable, values: FloatArray, color: str, name: str) -> None:
    size = 3.8 if len(frames) <= 150 else 2.0
    axes.plot(
        frames.frame, values, "o", color=color, markersize=size, markeredgewidth=0, label=name, rasterized=len(frames) > MANY
    )


def _time_panel(frames: FrameTable) -> Html | None:
    times = frames.ms[np.isfinite(frames.ms)]
    if not len(times):
        return None
    figure, axes = new_axes()
    _dots(axes, frames, frames.ms, SERIES[0], "one frame")
    median = float(np.median(times))
    axes.axhline(median, color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="median")
    axes.set_ylim(0.0, 1.08 * float(times.max()))
    whole_numbers(axes)
    name_axes(axes, "frame", "time [ms]")
    add_legend(axes)
    span = f"median {words.number(median)} ms, {words.number(float(times.min()))} to {words.number(float(times.max()))} ms"
    return as_image(figure, alt=f"Computing time of each frame: {span}.", caption=f"Computing time of each frame; {span}.")


def _tension_panel(frames: FrameTable) -> Html | None:
    return _drive_panel(frames, frames.tension_n, "tension [N]", "Tension of the cables")


def _pressure_panel(frames: FrameTable) -> Html | None:
    return _drive_panel(frames, frames.pressure_pa, "pressure [Pa]", "Pressure in the chambers")


def _drive_panel(frames: FrameTable, drives: dict[str, FloatArray], label: str, title: str) -> Html | None:
    shown = [(name, values) for name, values in drives.items() if np.isfinite(values).any()][:SHOWN]
    if not shown:
        return None
    figure, axes = new_axes()
    for color, (name, values) in zip(SERIES, shown):
        axes.plot(frames.frame, values, color=color, linewidth=1.5, label=clipped(name, 14), rasterized=len(frames) > MANY)
    whole_numbers(axes)
    name_axes(axes, "frame", label)
    add_legend(axes, columns=min(len(shown), 4))
    return as_image(figure, alt=f"{title} {', '.join(name for name, _ in shown)} over the frames.", caption=f"{title}.")


def _origin(facts: RunFacts) -> Html | None:
    recording = Path(facts.inputs.recording.path or "").name
    rows = [
        ["Robot", facts.robot],
        ["Recording", recording],
        ["Time in all", f"{words.number(facts.timing.seconds)} s" if words.known(facts.timing.seconds) else ""],
        ["Versions", ", ".join(f"{name} {version}" for name, version in facts.versions.items())],
    ]
    return table(("Item", "Value"), [row for row in rows if row[1]], caption="run.json beside this file has the hashes.")
