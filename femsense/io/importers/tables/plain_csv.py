"""Plain CSV: columns of numbers, named by a header or by a mapping, or raw motion capture without a header."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import plain_name
from femsense.core.units import Quantity, Unit
from femsense.io.importers.frames import Format, Source
from femsense.io.importers.motion_capture import Row, Track, capture_source
from femsense.io.importers.options import Options
from femsense.io.importers.tables.clock import seconds_of
from femsense.io.importers.tables.csv_tables import column_unit, header_of, is_text, is_time, layout_of, number_rows, time_column
from femsense.io.importers.tables.input_samples import Samples, samples_of
from femsense.io.importers.tables.mapping import (
    Becomes,
    Column,
    cable_kind,
    check_names,
    kind_of_target,
    mappable,
    mapped_inputs,
    parse_target,
    resolved,
    unit_beside,
)

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


# As a source


def open_plain_csv(path: Path, options: Options) -> Source:
    """Return a table of positions over time as a source.

    Columns: a time (or `--rate`), markers as NAME_x, NAME_y, NAME_z (also NAME.x, x1 …,
        NAME:X) or mapped by NAME=marker.x, inputs
    as cable_… and chamber_…. A file of bare numbers (counter, time, x, y, z, x, y, z …) holds markers without names.

    Raises:
        InputError: nothing to take, or a unit that is not known.
    """
    names, headed = header_of(path)
    options = replace(options, columns=resolved(options.columns, names))
    check_names(options.columns, mappable(names), path, options.log_names)
    raw = not headed and not options.columns
    triples = _raw_triples(path, names) if raw else _mapped_triples(names, options) or _named_triples(names)
    inputs, actuation = input_columns(names, options.columns, path)
    if not triples and not inputs:
        raise InputError(
            "nothing that can be taken",
            where=path,
            found=", ".join(names[:12]) + (" …" if len(names) > 12 else ""),
            expected="columns NAME_x, NAME_y, NAME_z, cable_… or chamber_…",
            hint="--map COLUMN=marker.x names a column, --map COLUMN=cable_north an input",
        )
    times, notes = _times(path, names, headed, options)
    places = [j for _, axes in triples for j in axes]

    def rows() -> Iterator[Row]:
        between: Samples | None = None
        for time, row in zip(times.tolist(), number_rows(path)):
            values = {column.name: float(column.values(row)) for column in inputs}
            drive = {name: value for name, value in values.items() if np.isfinite(value)}
            if len(drive) < len(inputs):
                between = between or _input_samples(path, inputs, times)
                filled = zip(inputs, between.at(time)[0].tolist())
                drive = {column.name: value for column, value in filled if np.isfinite(value)}
            yield Row(time, np.array([row[j] for j in places]).reshape(-1, 3), drive)

    return capture_source(
        path,
        [Track("" if raw else name, name) for name, _ in triples],
        rows,
        replace(options, columns={}, topics=()),
        unit=_declared_unit(names, places, path),
        found={"marker_columns": len(triples) or None},
        notes=notes + notation_notes(path) + unit_notes(inputs, names, options.columns),
        names=mappable(names),
        actuation=actuation,
        actuation_by_unit=True,
    )


def list_plain_csv(path: Path) -> dict[str, Any]:
    """Return the columns of a table. Raises InputError."""
    names, headed = header_of(path)
    return {"columns": names if headed else len(names)}


def notation_notes(path: Path) -> list[str]:
    """Return the assumptions about the notation of a table's numbers."""
    notation = layout_of(path).notation
    decimal = ["numbers are read with decimal commas"] if notation.commas else []
    order = "month/day/year" if notation.month_first else "day/month/year"
    dates = [] if notation.month_first is None else [f"dates with slashes are read as {order}"]
    return dates + decimal + (["thousands separators are ignored"] if notation.grouped else [])


def unit_notes(inputs: Sequence[Column], names: Sequence[str], columns: Mapping[str, str]) -> list[str]:
    """Return the assumptions about units of inputs: absolute pressures that became gauge pressures, and units that are not declared."""
    absolute = [
        column.name for column in inputs if column.offset and not parse_target(columns.get(names[column.index], "")).scaled
    ]
    bare = [
        column.name
        for column in inputs
        if column.factor == 1.0
        and not column.offset
        and column_unit(names[column.index])[1] is None
        and not parse_target(columns.get(names[column.index], "")).scaled
    ]
    notes = [f"{', '.join(absolute)}: absolute pressures, 101325 Pa are subtracted"] if absolute else []
    units = " and ".join(
        dict.fromkeys("Pa" if name.startswith("chamber_") else "N, or m for --inputs displacement" for name in bare)
    )
    return notes + ([f"no unit for {', '.join(bare)}: taken as {units}; --map NAME=TARGET*UNIT states another"] if bare else [])


def _input_samples(path: Path, inputs: Sequence[Column], times: FloatArray) -> Samples:
    """Return all inputs of a table at the times [s] of its rows."""
    taken = [[column.values(row) for column in inputs] for row in number_rows(path)]
    return samples_of(times, np.array(taken, dtype=np.float64).reshape(len(times), -1))


def _times(path: Path, names: list[str], headed: bool, options: Options) -> tuple[FloatArray, list[str]]:
    """Return the time of each row [s], and the assumptions made."""
    clock = mapped_time(names, options.columns)
    if clock is None and not headed:
        clock = (1, None)
    if clock is None and any(map(is_time, names)):
        clock = time_column(names, path)
    if clock is None and options.rate is None:
        raise InputError(
            "no column of time",
            where=path,
            found=", ".join(names[:12]),
            expected="a column time_s, --map COLUMN=time, or --rate HZ",
        )
    if clock is None:
        return np.arange(sum(1 for _ in number_rows(path))) / (options.rate or 1.0), []
    times, notes = seconds_of(np.fromiter((row[clock[0]] for row in number_rows(path)), dtype=np.float64), clock[1])
    return times, notes + (["--rate has no effect: the table contains times"] if options.rate is not None else [])


def mapped_time(names: Sequence[str], columns: Mapping[str, str]) -> tuple[int, Unit | None] | None:
    """Return the column that is mapped to the time, and its unit where one is declared; None where none is mapped. Raises InputError."""
    for old, new in columns.items():
        if kind_of_target(new) is Becomes.TIME and old in names:
            target = parse_target(new)
            said = Unit("", Quantity.TIME, target.factor) if target.scaled else unit_beside(old, "time")
            return list(names).index(old), said
    return None


def input_columns(names: Sequence[str], mapping: Mapping[str, str], path: Path) -> tuple[list[Column], str | None]:
    """Return the inputs, mapped or named cable_… and chamber_…, and the quantity of the cables.

    A unit after a name determines the factor and the quantity.

    Raises:
        InputError: a unit of another quantity, or cables in newtons together with cables in metres.
    """
    found, kinds = mapped_inputs(names, mapping)
    for j, name in enumerate(names):
        if name in mapping or not name.startswith(("cable_", "chamber_")):
            continue
        unit = unit_beside(name, name, mapped=False)
        bare = column_unit(name)[0] if unit else name
        found.append(Column(bare, j, unit.size if unit else 1.0, unit.zero if unit else 0.0))
        kinds |= cable_kind(bare, unit)
    taken = [column.name for column in found]
    if len(set(taken)) < len(taken):
        twice = next(name for name in taken if taken.count(name) > 1)
        raise InputError("two columns become the same", where=path, found=twice, expected="a name each")
    if len(kinds) > 1:
        raise InputError(
            "cables with tensions together with cables with displacements",
            where=path,
            found=", ".join(names[column.index] for column in found if column.name.startswith("cable_")),
            expected="one of both in all columns",
        )
    return found, next(iter(kinds), None)


def _declared_unit(names: Sequence[str], columns: Sequence[int], path: Path) -> str | None:
    """Return the unit of length in the names of position columns; None without one. Raises InputError if there are several."""
    units = [unit for unit in (_place_unit(names[j]) for j in columns) if unit is not None and unit.quantity is Quantity.LENGTH]
    said = sorted({unit.name for unit in units})
    if len(said) > 1 or 0 < len(units) < len(columns):
        raise InputError(
            "places in several units",
            where=path,
            found=", ".join(said) + (" and none" if len(units) < len(columns) else ""),
            expected="one unit",
        )
    return said[0] if said else None


def _place_unit(name: str) -> Unit | None:
    """Return the unit of a position column, after its name or before the axis (tip_mm_x)."""
    place, unit = _as_place(name), column_unit(name)[1]
    return unit if unit is not None or place is None else place[2]


def _as_place(full: str) -> tuple[str, str, Unit | None] | None:
    """Return the marker, the axis and the unit of a column whose name has x, y or z at its end or beginning; None for any other."""
    bare, unit = column_unit(full)
    match = re.fullmatch(r"(.+?)[ _.:/-]?([xyzXYZ])", bare) or re.fullmatch(r"([xyzXYZ])[_ ]?(\w+)", bare)
    if match is None:
        return None
    first, second = match[1], match[2]
    stem, axis = (second, first) if len(first) == 1 and first in "xyzXYZ" and second not in "xyzXYZ" else (first, second)
    inner, before = column_unit(stem)
    if unit is None and before is not None and before.quantity is Quantity.LENGTH and before.name != "m":
        stem, unit = inner, before
    return stem, axis.lower(), unit


def _named_triples(names: Sequence[str]) -> list[tuple[str, tuple[int, int, int]]]:
    """Return markers and their columns where x, y and z differ in one letter of their names."""
    groups: dict[str, dict[str, int]] = {}
    for j, full in enumerate(names):
        place = _as_place(full)
        if place is not None and (place[2] is None or place[2].quantity is Quantity.LENGTH):
            groups.setdefault(place[0], {}).setdefault(place[1], j)
    return [
        (stem, (axes["x"], axes["y"], axes["z"]))
        for stem, axes in groups.items()
        if set(axes) == set("xyz") and stem.lower() not in NO_PLACES
    ]


def _mapped_triples(names: Sequence[str], options: Options) -> list[tuple[str, tuple[int, int, int]]]:
    groups: dict[str, dict[str, int]] = {}
    for old, new in options.columns.items():
        stem, dot, axis = plain_name(new).rpartition(".")
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


CSV = Format(
    "csv",
    open_plain_csv,
    lambda path, head: is_text(path),
    ("--clock", "--topic"),
    list_plain_csv,
    (".gz",),
    columns=lambda path: header_of(path)[0],
)
