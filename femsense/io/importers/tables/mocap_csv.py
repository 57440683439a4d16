"""Exports of motion capture as text (OptiTrack Motive, Vicon Nexus, TRC, Qualisys TSV): a header, then positions; empty cells are gaps."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.errors import InputError
from femsense.core.text import plain_name
from femsense.io.importers.frames import Format, Source
from femsense.io.importers.motion_capture import Row, Track, capture_source, tracks_of
from femsense.io.importers.options import Options
from femsense.io.importers.tables.csv_tables import is_cut_off, is_text, rows_of
from femsense.io.text_numbers import plain_number

HEAD = 20
"""The headers are in the first lines."""


class Program(StrEnum):
    """Program that wrote an export; the values are names of formats."""

    OPTITRACK = "optitrack"
    VICON = "vicon"
    TRC = "trc"
    QUALISYS = "qualisys"


BEGINS = {
    "Format Version": Program.OPTITRACK,
    "Trajectories": Program.VICON,
    "Model Outputs": Program.VICON,
    "Devices": Program.VICON,
    "PathFileType": Program.TRC,
    "NO_OF_FRAMES": Program.QUALISYS,
}
"""First cell of an export → its program."""


Axes = tuple[int, int, int]
"""Columns of x, y, z."""


@dataclass(frozen=True, eq=False, slots=True)
class Export:
    """Header of an export."""

    program: Program
    markers: tuple[tuple[Track, Axes], ...]
    unit: str | None
    time: int | None
    """Column of time [s]; None: the frame number over the rate."""
    counter: int | None
    """Column of the frame number; None: the rows are counted."""
    rate: float | None
    """[1/s]."""
    first: int
    """Row at which the data begin, from 0."""
    frames: int | None = None
    """Frames that the header announces."""
    count: int | None = None
    """Markers that the header announces."""


def program_of(path: Path) -> Program | None:
    """Return the program that wrote an export of motion capture, by its first lines; None for any other table."""
    head = list(islice(rows_of(path), HEAD))
    first = head[0][0].strip() if head and head[0] else ""
    sections = len(head) > 3 and [cell.strip() for cell in head[3][:2]] == ["Frame", "Sub Frame"]
    return Program.VICON if sections else BEGINS.get(first)


def list_mocap_csv(path: Path) -> dict[str, Any]:
    """Return the header of an export. Raises InputError."""
    export = read_export(path)
    return {
        "markers": [track.name or "(unnamed)" for track, _ in export.markers],
        "unit": export.unit,
        "rate_hz": export.rate,
        "frames_announced": export.frames,
    }


def open_mocap_csv(path: Path, options: Options) -> Source:
    """Return an export as a source. Raises InputError: an empty header, no markers, a unit that is not known."""
    export = read_export(path)
    if not export.markers:
        raise InputError("no markers", where=path, found="none", expected="positions of markers or bodies")
    rate = export.rate or options.rate
    if export.time is None and rate is None:
        raise InputError("no times", where=path, found="frame numbers without a rate", expected="--rate HZ")
    return capture_source(
        path,
        [track for track, _ in export.markers],
        partial(_rows, path, export, rate or 1.0),
        options,
        unit=export.unit,
        found={},
        count=export.frames,
        notes=_notes(export, options, _step(path, export)),
    )


def _notes(export: Export, options: Options, step: float | None) -> list[str]:
    """Return where header and rows disagree, and a rate that has no effect."""
    notes = []
    if export.count is not None and export.count != len(export.markers):
        notes.append(f"the header announces {export.count} markers, {len(export.markers)} stand there")
    if export.rate and step and abs(step * export.rate - 1.0) > 0.05:
        notes.append(f"the header says {export.rate:g} frames a second, the times {1.0 / step:.4g}: the times count")
    if options.rate is not None and (export.time is not None or export.rate is not None):
        notes.append("--rate has no effect: the file contains times")
    return notes


def read_export(path: Path) -> Export:
    """Return the header of an export. Raises InputError."""
    head = list(islice(rows_of(path), HEAD))
    readers = {Program.OPTITRACK: _optitrack, Program.TRC: _trc, Program.QUALISYS: _qualisys}
    reader = readers.get(program_of(path) or Program.VICON)
    return _vicon(path) if reader is None else reader(head, path)


def _rows(path: Path, export: Export, rate: float) -> Iterator[Row]:
    begun, columns = False, [j for _, axes in export.markers for j in axes]
    count = 0
    for row in islice(rows_of(path), export.first, None):
        if not any(cell.strip() for cell in row):
            if export.program is Program.VICON and begun:
                return  # the next section begins
            continue
        if len(row) <= max(columns) and is_cut_off(path):
            warnings.warn(f"{path}: the last line was cut off and is left out", stacklevel=2)
            return
        begun = True
        number = float(count) if export.counter is None else _cell(row, export.counter)
        time = number / rate if export.time is None else _cell(row, export.time)
        count += 1
        yield Row(time, np.array([_cell(row, j) for j in columns]).reshape(-1, 3), {})


def _optitrack(head: list[list[str]], path: Path) -> Export:
    pairs = dict(zip(head[0][::2], head[0][1::2]))
    rows = {row[1].strip().lower(): row for row in head[1:] if len(row) > 1 and row[1].strip()}
    axes_row = next((i for i, row in enumerate(head) if row and row[0].strip() == "Frame"), None)
    if axes_row is None or axes_row == 0 or "name" not in rows:
        raise InputError(
            "an OptiTrack export without its header",
            where=path,
            found=f"{len(head)} lines",
            expected="rows Type, Name, ID, and Frame,Time (Seconds),X,Y,Z …",
        )
    kinds, names, what, axes = rows.get("type", []), rows["name"], head[axes_row - 1], head[axes_row]
    markers: dict[tuple[str, int], dict[str, int]] = {}
    group, last = -1, ""
    for j in range(2, len(axes)):
        key = f"{_at(names, j)}|{_at(kinds, j)}|{_at(what, j)}"
        if key != last or axes[j].strip().upper() == "X":
            group, last = group + 1, key
        kind = _at(kinds, j).lower()
        if _at(what, j).lower() != "position" or kind == "bone":
            continue
        unnamed = "unlabeled" in _at(names, j).lower() or "unlabeled" in kind
        markers.setdefault(("" if unnamed else _at(names, j), group), {})[axes[j].strip().lower()] = j
    found = [(Track(name, name), (a["x"], a["y"], a["z"])) for (name, _), a in markers.items() if set(a) == set("xyz")]
    rate = pairs.get("Export Frame Rate") or pairs.get("Capture Frame Rate")
    announced = _whole(pairs.get("Total Exported Frames") or pairs.get("Total Frames in Take") or "")
    unit = pairs.get("Length Units")
    return Export(Program.OPTITRACK, _distinct(found, kinds), unit, 1, 0, _rate(rate or ""), axes_row + 1, announced)


def _trc(head: list[list[str]], path: Path) -> Export:
    """Read the header of a TRC file (Motion Analysis, OpenSim): keys and values in lines 2 and 3, names in line 4, axes in line 5."""
    if len(head) < 5:
        raise InputError(
            "a TRC file without its header", where=path, found=f"{len(head)} lines", expected="five lines, then frames"
        )
    said = dict(zip((cell.strip() for cell in head[1]), (cell.strip() for cell in head[2])))
    names = [(j, plain_name(cell)) for j, cell in enumerate(head[3]) if j > 1 and cell.strip()]
    found = tuple((Track(name, name), (j, j + 1, j + 2)) for j, name in names)
    rate, frames, count = _rate(said.get("DataRate", "")), _whole(said.get("NumFrames", "")), _whole(said.get("NumMarkers", ""))
    first = next((i for i, row in enumerate(head) if i > 3 and row and plain_number(row[0]) is not None), 5)
    return Export(Program.TRC, found, said.get("Units"), 1, 0, rate, first, frames, count)


def _qualisys(head: list[list[str]], path: Path) -> Export:
    """Read the header of a TSV file of Qualisys Track Manager: a key and its values a line, then perhaps names of columns; millimetres."""
    said = {
        row[0].strip(): [cell.strip() for cell in row[1:]] for row in head if row and re.fullmatch(r"[A-Z_0-9]+", row[0].strip())
    }
    kind = " ".join(said.get("DATA_INCLUDED", ["3D"]))
    if kind != "3D" or "MARKER_NAMES" not in said:
        raise InputError(
            "an export of Qualisys without places of markers",
            where=path,
            found=f"DATA_INCLUDED {kind}",
            expected="DATA_INCLUDED 3D with MARKER_NAMES",
            hint="export the 3D data as TSV, with the header",
        )
    names = [plain_name(name) for name in said["MARKER_NAMES"] if name]
    first = next((i for i, row in enumerate(head) if row and plain_number(row[0]) is not None), len(head))
    titles = [cell.strip().lower() for cell in head[first - 1]]
    shift = len([title for title in titles if title in ("frame", "time")]) if titles[:1] == ["frame"] else 0
    time = titles.index("time") if shift and "time" in titles else None
    found = tuple((Track(name, name), (shift + 3 * k, shift + 3 * k + 1, shift + 3 * k + 2)) for k, name in enumerate(names))
    value = {key: _whole(row[0]) if row else None for key, row in said.items()}
    rate = _rate(said.get("FREQUENCY", [""])[0])
    return Export(
        Program.QUALISYS,
        found,
        "mm",
        time,
        0 if shift else None,
        rate,
        first,
        value.get("NO_OF_FRAMES"),
        value.get("NO_OF_MARKERS"),
    )


def _whole(cell: str) -> int | None:
    """Return a count from a header; None without one."""
    value = _cell([cell], 0)
    return int(value) if np.isfinite(value) and value >= 0 else None


def _vicon(path: Path) -> Export:
    """Find the section Trajectories: its rate, a row of names, a row of axes, a row of units."""
    rows = enumerate(rows_of(path))
    start = next((i for i, row in rows if row and row[0].strip() == "Trajectories"), None)
    section = list(islice(rows_of(path), start, (start or 0) + 6)) if start is not None else []
    if len(section) < 5 or not section[1]:
        raise InputError(
            "a Vicon export without trajectories",
            where=path,
            found="no section Trajectories",
            expected="Trajectories, rate, names, Frame,Sub Frame,X,Y,Z …, units",
        )
    names, axes, units = section[2], [cell.strip().upper() for cell in section[3]], section[4]
    starts = [j for j in range(2, len(axes) - 2) if axes[j : j + 3] == ["X", "Y", "Z"]]
    found = zip(tracks_of([_at(names, j) for j in starts]), [(j, j + 1, j + 2) for j in starts])
    unit = next((cell.strip() for cell in units if cell.strip()), None)
    return Export(Program.VICON, tuple(found), unit, None, 0, _rate(section[1][0]), (start or 0) + 5)


def _distinct(found: list[tuple[Track, Axes]], kinds: list[str]) -> tuple[tuple[Track, Axes], ...]:
    """Return the tracks with each name once: measured markers before the rigid body's constraint of the same name."""
    order = sorted(found, key=lambda item: "rigid body marker" in _at(kinds, item[1][0]).lower())
    first = {track.name: (track, axes) for track, axes in reversed(order) if track.name}
    return (*first.values(), *(item for item in found if not item[0].name))


def _step(path: Path, export: Export) -> float | None:
    """Return the median step of the times of the first rows [s]; None where there are no times."""
    if export.time is None:
        return None
    times = np.array([_cell(row, export.time) for row in islice(rows_of(path), export.first, export.first + 50)])
    steps = np.diff(times[np.isfinite(times)])
    return float(np.median(steps)) if len(steps) else None


def _rate(cell: str) -> float | None:
    """Return the frame rate [1/s]; None if the header does not contain it."""
    value = _cell([cell], 0)
    return value if np.isfinite(value) and value > 0 else None


def _at(row: list[str], j: int) -> str:
    return row[j].strip() if j < len(row) else ""


def _cell(row: list[str], j: int) -> float:
    """Return a number; NaN where the cell is empty or no number (a gap)."""
    number = plain_number(_at(row, j))
    return np.nan if number is None else number


def _is_export(program: Program, path: Path, head: bytes) -> bool:
    return (is_text(path) or head.startswith(b"Format Version,")) and program_of(path) is program


EXPORTS = tuple(
    Format(
        program.value,
        open_mocap_csv,
        partial(_is_export, program),
        unused=("--clock",),
        list=list_mocap_csv,
        endings=(".trc",) if program is Program.TRC else (),
    )
    for program in Program
)
