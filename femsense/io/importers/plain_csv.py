"""Plain CSV: columns of numbers, named by a header or by a mapping, or raw motion capture without a header."""

from __future__ import annotations

import csv
import gzip
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.importers.frames import Frame, Options, Source, unit_of, upright

TIMES = {
    "time": 1.0,
    "time_s": 1.0,
    "t": 1.0,
    "t_s": 1.0,
    "seconds": 1.0,
    "timestamp": 1.0,
    "time (seconds)": 1.0,
    "time_ms": 1e-3,
    "timestamp_ms": 1e-3,
    "time_us": 1e-6,
    "timestamp_us": 1e-6,
    "time_ns": 1e-9,
    "timestamp_ns": 1e-9,
    "secs": 1.0,
    "sec": 1.0,
}
"""Names of columns of time, and seconds in one unit."""
DECIMAL_COMMA = re.compile(r"\s*[-+]?\d*,\d+(?:[eE][-+]?\d+)?\s*")
NO_PLACES = (
    "q",
    "quat",
    "rot",
    "rotation",
    "orientation",
    "v",
    "vel",
    "velocity",
    "w",
    "omega",
    "a",
    "acc",
    "f",
    "force",
    "torque",
)
"""Stems of columns that end in x, y, z and are no places."""


@contextmanager
def open_text(path: Path) -> Iterator[io.TextIOBase]:
    """Open a text file, gzipped or not. Raises InputError where it cannot be read."""
    try:
        opened = gzip.open if path.suffix.lower() == ".gz" else open
        raw = opened(path, "rb")
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None
    with raw as stream, io.TextIOWrapper(stream, encoding="utf-8-sig", errors="replace", newline="") as text:
        try:
            yield text
        except (EOFError, gzip.BadGzipFile, OSError) as error:
            raise InputError("a broken compressed file", where=path, found=str(error), expected="a whole gzip file") from None


def rows_of(path: Path) -> Iterator[list[str]]:
    """Yield the rows of a CSV file as text; commas, semicolons or tabs between, and beside these two decimal commas."""
    with open_text(path) as stream:
        head = stream.read(4096)
        stream.seek(0)
        lines = head.splitlines()[:20]
        mark = max(",;\t", key=lambda c: sum(line.count(c) for line in lines))
        rows = csv.reader(stream, delimiter=mark)
        yield from rows if mark == "," else ([_with_point(cell) for cell in row] for row in rows)


def _with_point(cell: str) -> str:
    """Return a number with a decimal comma as one with a point, anything else as it is."""
    return cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell


def header_of(path: Path) -> tuple[list[str], bool]:
    """Return the names of the columns, and whether they stand in the file; a file of bare numbers has 1, 2, …"""
    first = next((row for row in rows_of(path) if any(cell.strip() for cell in row)), [])
    if not first:
        raise InputError("an empty table", where=path, found=f"{path.stat().st_size} bytes", expected="rows of numbers")
    if all(_number(cell) is not None or not cell.strip() for cell in first):
        return [str(i + 1) for i in range(len(first))], False
    return [cell.strip() for cell in first], True


def read_numbers(path: Path) -> tuple[list[str], FloatArray]:
    """Return the names of the columns and the table, shape (rows, columns); NaN where a cell is empty. Raises InputError."""
    names, _ = header_of(path)
    rows = list(number_rows(path))
    return names, np.array(rows, dtype=np.float64).reshape(-1, len(names))


def number_rows(path: Path) -> Iterator[list[float]]:
    """Yield the rows of numbers after the header; NaN where a cell is empty. Raises InputError with the line."""
    names, headed = header_of(path)
    rows = (item for item in enumerate(rows_of(path), start=1) if any(cell.strip() for cell in item[1]))
    if headed:
        next(rows, None)
    for line, cells in rows:
        values = [np.nan if not cell.strip() else _number(cell) for cell in cells[: len(names)]]
        if len(values) < len(names) or any(value is None for value in values):
            bad = next((cell for cell, value in zip(cells, values) if value is None), f"{len(cells)} cells")
            raise InputError(
                "not a row of numbers",
                where=f"{path}, line {line}",
                found=bad,
                expected=f"{len(names)} numbers",
                hint="decimal points, not commas" if "," in bad else None,
            )
        yield [float(value) for value in values if value is not None]


def time_column(names: Sequence[str], path: Path) -> tuple[int, float]:
    """Return the column of time and seconds in one unit of it. Raises InputError."""
    for j, name in enumerate(names):
        if name.lower() in TIMES:
            return j, TIMES[name.lower()]
    raise InputError("no column of time", where=path, found=", ".join(names[:12]), expected=", ".join(TIMES))


def named_columns(names: Sequence[str], columns: Mapping[str, str], prefixes: Sequence[str]) -> list[tuple[str, int, float]]:
    """Return (name in the recording, column, factor) of the mapped columns whose new name starts with one of the prefixes."""
    found = []
    for old, new in columns.items():
        name, factor = split_factor(new)
        if name.startswith(tuple(prefixes)) and old in names:
            found.append((name, list(names).index(old), factor))
    return found


def split_factor(target: str) -> tuple[str, float]:
    """Return name and factor of a target such as cable_north*4.615. Raises InputError."""
    name, star, factor = target.partition("*")
    value = _number(factor) if star else 1.0
    if value is None:
        raise InputError("not a factor", where="--map", found=target, expected="NAME=TARGET*NUMBER")
    return name.strip(), value


# As a source


def open_plain_csv(path: Path, options: Options) -> Source:
    """Return a table of positions over time as a source.

    Columns: a time (or `--rate`), markers as NAME_x, NAME_y, NAME_z (also NAME.x, x1 …,
        NAME:X) or mapped by NAME=marker.x, inputs
    as cable_… and chamber_…. A file of bare numbers (counter, time, x, y, z, x, y, z …) holds markers without names.

    Raises:
        InputError: nothing to take, or a unit that nobody says.
    """
    names, headed = header_of(path)
    _check_map(names, options, path)
    raw = not headed and not options.columns
    triples = _raw_triples(path, names) if raw else _mapped_triples(names, options) or _named_triples(names)
    inputs = named_columns(names, options.columns, ("cable_", "chamber_"))
    inputs += [
        (name, j, 1.0) for j, name in enumerate(names) if name.startswith(("cable_", "chamber_")) and name not in options.columns
    ]
    if not triples and not inputs:
        raise InputError(
            "nothing that can be taken",
            where=path,
            found=", ".join(names[:12]) + (" …" if len(names) > 12 else ""),
            expected="columns NAME_x, NAME_y, NAME_z, cable_… or chamber_…",
            hint="--map COLUMN=marker.x names a column, --map COLUMN=cable_north an input",
        )
    clock = _clock(path, names, headed, options)
    chosen = [j for _, axes in triples for j in axes]
    scale = unit_of(options, None, path, _extent(path, chosen)) if triples else 1.0
    label = not raw

    def frames() -> Iterator[Frame]:
        for number, row in enumerate(number_rows(path)):
            time = number / (options.rate or 1.0) if clock is None else row[clock[0]] * clock[1]
            places = {name: scale * np.array([row[j] for j in axes]) for name, axes in triples}
            seen = {name: upright(p, options.up)[0] for name, p in places.items() if np.isfinite(p).all() and p.any()}
            drive = {name: factor * row[j] for name, j, factor in inputs if np.isfinite(row[j])}
            yield Frame(time, markers=seen if label else {}, unlabelled=() if label else list(seen.values()), inputs=drive)

    found = {"unit": options.unit, "up": options.up or "as in the file", "marker_columns": len(triples)}
    notes = () if label else ("the markers have no names: the column marker stays empty, calibration assigns them",)
    return Source("csv", path, frames, found={k: v for k, v in found.items() if v}, notes=notes)


def _clock(path: Path, names: list[str], headed: bool, options: Options) -> tuple[int, float] | None:
    """Return the column of time and its unit; None where a rate stands for it."""
    mapped = named_columns(names, options.columns, ("time",))
    if mapped:
        return mapped[0][1], mapped[0][2]
    if not headed:
        return 1, 1.0
    if options.rate is not None and not any(name.lower() in TIMES for name in names):
        return None
    try:
        return time_column(names, path)
    except InputError as problem:
        raise InputError(
            "no column of time",
            where=path,
            found=", ".join(names[:12]),
            expected="a column time_s, --map COLUMN=time, or --rate HZ",
        ) from problem


def _named_triples(names: Sequence[str]) -> list[tuple[str, tuple[int, int, int]]]:
    """Return markers and their columns where x, y and z differ in one letter of their names."""
    groups: dict[str, dict[str, int]] = {}
    for j, name in enumerate(names):
        match = re.fullmatch(r"(.+?)[ _.:/-]?([xyzXYZ])(?:_m|_mm| \(mm\)| \[m+\])?", name) or re.fullmatch(
            r"([xyzXYZ])[_ ]?(\w+)", name
        )
        if match is None:
            continue
        first, second = match[1], match[2]
        stem, axis = (second, first) if len(first) == 1 and first in "xyzXYZ" and second not in "xyzXYZ" else (first, second)
        groups.setdefault(stem, {}).setdefault(axis.lower(), j)
    return [
        (stem, (axes["x"], axes["y"], axes["z"]))
        for stem, axes in groups.items()
        if set(axes) == set("xyz") and stem.lower() not in NO_PLACES
    ]


def _mapped_triples(names: Sequence[str], options: Options) -> list[tuple[str, tuple[int, int, int]]]:
    groups: dict[str, dict[str, int]] = {}
    for old, new in options.columns.items():
        stem, dot, axis = new.rpartition(".")
        if dot and axis in ("x", "y", "z"):
            groups.setdefault(stem, {})[axis] = list(names).index(old)
    for stem, axes in groups.items():
        if set(axes) != set("xyz"):
            lacking = ", ".join(f"{stem}.{axis}" for axis in "xyz" if axis not in axes)
            raise InputError("a marker without all its axes", where="--map", found=", ".join(axes), expected=lacking)
    return [(stem, (axes["x"], axes["y"], axes["z"])) for stem, axes in groups.items()]


def _raw_triples(path: Path, names: Sequence[str]) -> list[tuple[str, tuple[int, int, int]]]:
    """Return the columns of raw motion capture: counter, time, then x, y, z of each marker."""
    first = [row for row, _ in zip(number_rows(path), range(3))]
    counts = np.array([row[0] for row in first])
    if (
        len(names) < 5
        or (len(names) - 2) % 3
        or (len(first) > 1 and not (np.diff([r[1] for r in first]) > 0).all())
        or (counts % 1).any()
    ):
        raise InputError(
            "numbers without names",
            where=path,
            found=f"{len(names)} columns",
            expected="counter, time [s], then x, y, z of each marker; or --map 3=marker.x (columns count from 1)",
        )
    return [(str(k), (2 + 3 * k, 3 + 3 * k, 4 + 3 * k)) for k in range((len(names) - 2) // 3)]


def _check_map(names: Sequence[str], options: Options, path: Path) -> None:
    for old, new in options.columns.items():
        if old not in names:
            raise InputError(
                "a column that the table does not have",
                where=f"{path}, --map {old}={new}",
                found=old,
                expected=", ".join(names[:20]),
                hint=did_you_mean(old, names),
            )


def _extent(path: Path, columns: Sequence[int]) -> float:
    """Return the span of the first thousand rows in the file's unit."""
    rows = np.array([[row[j] for j in columns] for row, _ in zip(number_rows(path), range(1000))])
    values = rows[np.isfinite(rows)]
    return float(np.ptp(values)) if values.size else 0.0


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
