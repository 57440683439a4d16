"""Plain CSV: columns of numbers, named by a header or by a mapping, or raw motion capture without a header."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from femsense.core.errors import InputError
from femsense.io.importers.csv_tables import LENGTHS, header_of, is_time, number_rows, split_unit, time_column, time_scale
from femsense.io.importers.frames import Frame, Options, Source, unit_of, upright
from femsense.io.importers.input_samples import Samples, samples_of
from femsense.io.importers.mapping import (
    Column,
    cable_kind,
    check_names,
    kind_of_target,
    mappable,
    mapped_inputs,
    resolved,
    split_factor,
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
        InputError: nothing to take, or a unit that nobody says.
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
    clock = _clock(path, names, headed, options)
    chosen = [j for _, axes in triples for j in axes]
    declared = _declared_unit(names, chosen, path)
    scale = unit_of(options, declared, path, _extent(path, chosen)) if triples else 1.0
    label = not raw

    def frames() -> Iterator[Frame]:
        between: Samples | None = None
        for number, row in enumerate(number_rows(path)):
            time = number / (options.rate or 1.0) if clock is None else row[clock[0]] * clock[1]
            places = {name: scale * np.array([row[j] for j in axes]) for name, axes in triples}
            seen = {name: upright(p, options.up)[0] for name, p in places.items() if np.isfinite(p).all() and p.any()}
            drive = {name: factor * row[j] for name, j, factor in inputs if np.isfinite(row[j])}
            if len(drive) < len(inputs):
                between = between or _input_samples(path, inputs, clock or (None, 1.0 / (options.rate or 1.0)))
                filled = zip(inputs, between.at(time)[0].tolist())
                drive = {name: value for (name, _, _), value in filled if np.isfinite(value)}
            yield Frame(time, markers=seen if label else {}, unlabelled=() if label else list(seen.values()), inputs=drive)

    found = {"unit": options.unit or declared, "up": options.up or "as in the file", "marker_columns": len(triples)}
    notes = [] if label else ["the markers have no names: the column marker stays empty, calibration assigns them"]
    notes += ["--rate has no effect: the table says its times"] if options.rate is not None and clock is not None else []
    return Source(
        "csv", path, frames, found={k: v for k, v in found.items() if v}, actuation=actuation, notes=notes, names=mappable(names)
    )


def _input_samples(path: Path, inputs: Sequence[Column], clock: tuple[int | None, float]) -> Samples:
    """Return all inputs of a table; without a column of time its rows count."""
    column, scale = clock
    taken = [[k if column is None else row[column], *(row[j] for _, j, _ in inputs)] for k, row in enumerate(number_rows(path))]
    rows = np.array(taken, dtype=np.float64)
    return samples_of(rows[:, 0] * scale, rows[:, 1:] * [factor for _, _, factor in inputs])


def _clock(path: Path, names: list[str], headed: bool, options: Options) -> tuple[int, float] | None:
    """Return the column of time and its unit; None where a rate stands for it."""
    mapped = mapped_time(names, options.columns, path)
    if mapped is not None:
        return mapped
    if not headed:
        return 1, 1.0
    if options.rate is not None and not any(map(is_time, names)):
        return None
    if not any(map(is_time, names)):
        raise InputError(
            "no column of time",
            where=path,
            found=", ".join(names[:12]),
            expected="a column time_s, --map COLUMN=time, or --rate HZ",
        )
    return time_column(names, path)


def mapped_time(names: Sequence[str], columns: Mapping[str, str], path: Path) -> tuple[int, float] | None:
    """Return the column that is mapped to the time and seconds in one unit of it; None where none is. Raises InputError."""
    for old, new in columns.items():
        if kind_of_target(new) == "time" and old in names:
            column = list(names).index(old)
            if "*" in new:
                return column, split_factor(new)[1]
            scale, unit = unit_beside(old, "time")
            return column, scale if unit else time_scale(path, column)
    return None


def input_columns(names: Sequence[str], mapping: Mapping[str, str], path: Path) -> tuple[list[Column], str | None]:
    """Return (name in the recording, column, factor) of the inputs, mapped or named cable_… and chamber_…, and what cables hold.

    A unit behind a name gives the factor, and says whether cables hold tensions or displacements.

    Raises:
        InputError: a unit that is none of the input's, or cables in newtons beside others in metres.
    """
    found, kinds = mapped_inputs(names, mapping)
    for j, name in enumerate(names):
        if name in mapping or not name.startswith(("cable_", "chamber_")):
            continue
        factor, unit = unit_beside(name, name, mapped=False)
        bare = split_unit(name)[0] if unit else name
        found.append((bare, j, factor))
        kinds |= cable_kind(bare, unit)
    taken = [name for name, _, _ in found]
    if len(set(taken)) < len(taken):
        twice = next(name for name in taken if taken.count(name) > 1)
        raise InputError("two columns become the same", where=path, found=twice, expected="a name each")
    if len(kinds) > 1:
        raise InputError(
            "cables that hold tensions beside others that hold displacements",
            where=path,
            found=", ".join(names[j] for name, j, _ in found if name.startswith("cable_")),
            expected="one of both in all columns",
        )
    return found, next(iter(kinds), None)


def _declared_unit(names: Sequence[str], columns: Sequence[int], path: Path) -> str | None:
    """Return the unit of length that the names of places say; None where they say none. Raises InputError: several."""
    units = {unit for unit in (split_unit(names[j])[1] for j in columns) if unit in LENGTHS}
    if len(units) > 1:
        raise InputError("places in several units", where=path, found=", ".join(sorted(units)), expected="one unit")
    return units.pop() if units else None


def _named_triples(names: Sequence[str]) -> list[tuple[str, tuple[int, int, int]]]:
    """Return markers and their columns where x, y and z differ in one letter of their names."""
    groups: dict[str, dict[str, int]] = {}
    for j, full in enumerate(names):
        bare, unit = split_unit(full)
        if unit and unit not in LENGTHS:
            continue
        name = bare if unit else full
        match = re.fullmatch(r"(.+?)[ _.:/-]?([xyzXYZ])", name) or re.fullmatch(r"([xyzXYZ])[_ ]?(\w+)", name)
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


def _extent(path: Path, columns: Sequence[int]) -> float:
    """Return the span of the first thousand rows in the file's unit."""
    rows = np.array([[row[j] for j in columns] for row, _ in zip(number_rows(path), range(1000))])
    values = rows[np.isfinite(rows)]
    return float(np.ptp(values)) if values.size else 0.0
