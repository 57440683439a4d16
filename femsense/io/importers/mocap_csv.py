"""Exports of OptiTrack Motive and Vicon Nexus as CSV: several lines of header, then positions; empty cells are gaps."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from femsense.core.errors import InputError
from femsense.io.importers.csv_tables import is_cut_off, rows_of
from femsense.io.importers.frames import Frame, Options, Source, check_size, unit_of, upright
from femsense.io.importers.mapping import MARKER

HEAD = 12
"""The headers are in the first lines."""


@dataclass(frozen=True, eq=False, slots=True)
class Export:
    """What the header of an export says."""

    program: str
    """ "optitrack" or "vicon"."""
    markers: tuple[tuple[str, tuple[int, int, int]], ...]
    """Name ("" where the program could not tell which it is) and the columns of x, y, z."""
    unit: str | None
    time: int | None
    """Column of time [s]; None: the frame number over the rate."""
    rate: float | None
    """[1/s]."""
    first: int
    """Row at which the data begin, from 0."""


def is_mocap_csv(path: Path) -> bool:
    """Whether a CSV file begins as an export of Motive or Nexus."""
    head = list(islice(rows_of(path), HEAD))
    first = head[0][0].strip() if head and head[0] else ""
    sections = len(head) > 3 and [cell.strip() for cell in head[3][:2]] == ["Frame", "Sub Frame"]
    return sections or first in ("Format Version", "Trajectories", "Model Outputs", "Devices")


def open_mocap_csv(path: Path, options: Options) -> Source:
    """Return an export as a source. Raises InputError: a header that says nothing, no markers, a unit that nobody says."""
    export = read_export(path)
    chosen = [(name, axes) for name, axes in export.markers if not options.topics or name in options.topics]
    if not chosen:
        raise InputError(
            "no markers",
            where=path,
            found=", ".join(sorted({n for n, _ in export.markers})) or "none",
            expected="positions of markers or bodies",
        )
    renamed = tuple((options.columns.get(name, name).removeprefix("marker."), axes) for name, axes in chosen)
    extent = _extent(path, export)
    scale = unit_of(options, export.unit, path, extent)
    check_size(scale * extent, path)
    rate = export.rate or options.rate
    if export.time is None and rate is None:
        raise InputError("no times", where=path, found="frame numbers without a rate", expected="--rate HZ")
    nameless = sum(not name for name, _ in chosen)
    return Source(
        export.program,
        path,
        partial(_frames, path, export, renamed, scale, rate or 1.0, options.up),
        found={"unit": options.unit or export.unit, "up": options.up or "as in the file"},
        notes=_notes(nameless, len(chosen) - nameless, export, options),
        names={name: MARKER for name, _ in export.markers if name},
    )


def _notes(nameless: int, named: int, export: Export, options: Options) -> list[str]:
    """Return what a person should know: tracks without a name, a rate that was said in vain."""
    notes = []
    if nameless and named:
        notes.append(f"{nameless} tracks have no name: they are left out of frames that show named markers")
    elif nameless:
        notes.append(f"{nameless} tracks have no name: the column marker stays empty, calibration assigns them")
    if options.rate is not None and (export.time is not None or export.rate is not None):
        notes.append("--rate has no effect: the file says its times")
    return notes


def read_export(path: Path) -> Export:
    """Return what the header of an export says. Raises InputError."""
    head = list(islice(rows_of(path), HEAD))
    if head and head[0] and head[0][0].strip() == "Format Version":
        return _optitrack(head, path)
    return _vicon(path)


def _frames(
    path: Path, export: Export, markers: tuple[tuple[str, tuple[int, int, int]], ...], scale: float, rate: float, up: str | None
) -> Iterator[Frame]:
    start: float | None = None
    last = max(j for _, axes in export.markers for j in axes)
    for row in islice(rows_of(path), export.first, None):
        if not any(cell.strip() for cell in row):
            if export.program == "vicon" and start is not None:
                return  # the next section begins
            continue
        if len(row) <= last and is_cut_off(path):
            warnings.warn(f"{path}: the last line was cut off and is left out", stacklevel=2)
            return
        time = _cell(row, export.time) if export.time is not None else _cell(row, 0) / rate
        start = time if start is None else start
        places = [(name, np.array([_cell(row, j) for j in axes])) for name, axes in markers]
        seen = [(name, upright(scale * place, up)[0]) for name, place in places if np.isfinite(place).all() and place.any()]
        # one row has named markers, or markers without a name, or both
        yield Frame(time, markers={n: p for n, p in seen if n}, unlabelled=[p for n, p in seen if not n])


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
    found = tuple((name, (a["x"], a["y"], a["z"])) for (name, _), a in markers.items() if set(a) == set("xyz"))
    rate = pairs.get("Export Frame Rate") or pairs.get("Capture Frame Rate")
    return Export("optitrack", _distinct(found, kinds), pairs.get("Length Units"), 1, _rate(rate or ""), axes_row + 1)


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
    labels = [(_at(names, j), (j, j + 1, j + 2)) for j in range(2, len(axes) - 2) if axes[j : j + 3] == ["X", "Y", "Z"]]
    bare = [label.rpartition(":")[2] for label, _ in labels]
    found = []  # the subject stays before the name where another has a marker of the same name
    for (label, columns), name in zip(labels, bare):
        nameless = name.startswith("*") or not name
        found.append(("" if nameless else label if bare.count(name) > 1 else name, columns))
    unit = next((cell.strip() for cell in units if cell.strip()), None)
    return Export("vicon", tuple(found), unit, None, _rate(section[1][0]), (start or 0) + 5)


def _distinct(
    found: tuple[tuple[str, tuple[int, int, int]], ...], kinds: list[str]
) -> tuple[tuple[str, tuple[int, int, int]], ...]:
    """Return the tracks with each name once: measured markers before the rigid body's constraint of the same name."""
    order = sorted(found, key=lambda item: "rigid body marker" in _at(kinds, item[1][0]).lower())
    taken: dict[str, tuple[int, int, int]] = {}
    for name, axes in order:
        if name:
            taken.setdefault(name, axes)
    return tuple(taken.items()) + tuple(item for item in found if not item[0])


def _extent(path: Path, export: Export) -> float:
    rows = islice(rows_of(path), export.first, export.first + 500)
    values = np.array([_cell(row, j) for row in rows for _, axes in export.markers for j in axes])
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if finite.size else 0.0


def _rate(cell: str) -> float | None:
    """Return frames a second; None where the header does not say it."""
    value = _cell([cell], 0)
    return value if np.isfinite(value) and value > 0 else None


def _at(row: list[str], j: int) -> str:
    return row[j].strip() if j < len(row) else ""


def _cell(row: list[str], j: int) -> float:
    """Return a number; NaN where the cell is empty or no number (a gap)."""
    try:
        return float(row[j])
    except (ValueError, IndexError):
        return np.nan
