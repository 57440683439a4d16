"""The tables of an imported recording: recording.toml, frames.csv, markers.csv and loads.csv, from the journal of its frames."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.files import write_csv, write_toml
from femsense.io.importers.frames import Source
from femsense.io.importers.journal import Journal
from femsense.io.importers.summary import summary
from femsense.io.importers.tables.actuation import ActuationLog, align
from femsense.io.importers.tables.input_samples import spans
from femsense.io.recording_tables import FORCE_COLUMNS, PLACE_COLUMNS
from femsense.io.recording_toml import FORMAT, camera_document

EXACT = 1e-6
"""Times are as exact as this [s]."""


@dataclass(frozen=True, eq=False, slots=True)
class Wanted:
    """Options of the user about the inputs."""

    actuation: str | None = None
    """"tension" or "displacement", if the source does not declare it."""
    zero: str | None = None
    """"absolute" or "unknown"; by default tensions are absolute, displacements count from an unknown zero."""
    log: ActuationLog | None = None
    """Inputs on a clock of their own."""
    offset: float | None = None
    """Source time minus the log's time [s]; None finds it from the motion."""


def write_tables(source: Source, part: Path, journal: Journal, counts: Mapping[str, int], wanted: Wanted) -> dict[str, Any]:
    """Write recording.toml and the tables of the frames that the journal holds, and return what was found.

    Raises:
        InputError: no frames, inputs that are not known, or columns whose meaning nobody said.
    """
    actuation, zero, log, offset = wanted.actuation, wanted.zero, wanted.log, wanted.offset
    times = journal.times()
    if not len(times):
        raise InputError(
            "no frames", where=source.path, found=f"{source.format} without a frame", expected="frames in order of time"
        )
    applied, aligned = (None, {}) if log is None else align(log, journal, offset)
    columns = list(dict.fromkeys([*_input_columns(journal), *(() if applied is None else applied.columns)]))
    kind = actuation_of(source, columns, actuation or (log.actuation if log is not None else None))
    zero_kind = zero or ("unknown" if kind == "displacement" and columns else "absolute")
    write_toml(part / "recording.toml", _document(source, kind, zero_kind, part))
    values = _known_inputs(source, part, journal, columns, {} if applied is None else applied.at(times))
    rows = _frame_rows(journal, times[0], values, source.free)
    write_csv(part / "frames.csv", ["frame", "time_s", *columns, *(["free"] if source.free else [])], rows)
    camera = ["camera"] if source.views else []
    _write_rows(part / "markers.csv", ["frame", *camera, "marker", *PLACE_COLUMNS], _marker_rows(journal))
    _write_rows(part / "loads.csv", ["frame", *PLACE_COLUMNS, *FORCE_COLUMNS], _load_rows(journal))
    return {
        **summary(source, journal, counts),
        **({"frames_left_out": len(journal.left_out)} if journal.left_out else {}),
        "actuation": kind if columns else None,
        "actuation_zero": zero_kind if columns else None,
        "inputs": columns,
        **aligned,
    }


def _input_columns(journal: Journal) -> list[str]:
    columns: dict[str, None] = {}
    for entry in journal.entries():
        columns.update(dict.fromkeys(entry.inputs))
    return sorted(columns)


def _known_inputs(
    source: Source, part: Path, journal: Journal, columns: list[str], applied: Mapping[str, FloatArray]
) -> FloatArray:
    """Return the inputs of all frames, shape (frames, columns); frames with an unknown input are removed with a warning.

    Raises:
        InputError: none are left.
    """
    times = journal.times()
    values = np.full((len(times), len(columns)), np.nan)
    loads = np.ones(len(times), dtype=bool)
    for entry in journal.entries():
        values[entry.number] = [entry.inputs.get(name, np.nan) for name in columns]
        loads[entry.number] = np.isfinite(np.array(entry.loads)).all()
    for name, column in applied.items():
        values[:, columns.index(name)] = column
    lost = np.flatnonzero(~np.isfinite(values).all(axis=1) | ~loads)
    if not len(lost):
        return values
    lacking = [name for name, column in zip(columns, values.T) if not np.isfinite(column).all()]
    told = ", ".join([*lacking, *(() if loads.all() else ("known loads",))])
    if len(lost) == len(times):
        raise InputError(
            "no frame whose inputs are known",
            where=source.path,
            found=f"none of {len(times)} frames, {times[0]:.3f} … {times[-1]:.3f} s, has a value of each of {told}",
            expected="values before and after a frame, on the frames' clock",
            hint="--clock header|record, or --actuation FILE with a row at each end of what is known to be constant",
        )
    warnings.warn(
        f"{source.path}: {len(lost)} of {len(times)} frames are left out, since {told} "
        f"{'are' if ',' in told else 'is'} not known then: {spans(lost.tolist(), times - times[0])}",
        stacklevel=3,
    )
    journal.left_out = frozenset(lost.tolist())
    for folder, ending in (("clouds", "ply"), ("depth", "png"), ("color", "png")):
        for view in source.views or ("",):
            for number in journal.left_out:
                (part / folder / view / f"{number:06d}.{ending}").unlink(missing_ok=True)
    return values


def actuation_of(source: Source, columns: list[str], said: str | None) -> str:
    kind = said or source.actuation
    cables = [name for name in columns if name.startswith("cable_")]
    if cables and source.actuation_by_unit and source.actuation not in (None, kind):
        raise another_kind(source.path, str(said), str(source.actuation))
    if kind is None and cables:
        raise InputError(
            "the quantity of the cable inputs is not known",
            where=source.path,
            found=", ".join(cables[:6]),
            expected="--inputs tension (newtons) or --inputs displacement (metres, > 0 shortens)",
            hint="--map NAME=cable_x*FACTOR converts other units",
        )
    return kind or "tension"


def another_kind(path: Path, said: str, by_unit: str) -> InputError:
    return InputError("the units of the cables' columns disagree", where=f"{path}, --inputs {said}", found=by_unit, expected=said)


def _document(source: Source, actuation: str, zero: str, part: Path) -> dict[str, Any]:
    document: dict[str, Any] = {"format": FORMAT, "actuation": actuation, "actuation_zero": zero}
    if source.views:
        return document | {"cameras": {n: _camera(s, part / "depth" / n) | _pose(s) for n, s in source.views.items()}}
    camera = _camera(source, part / "depth")
    return document | _pose(source) | ({"camera": camera} if camera else {})


def _pose(source: Source) -> dict[str, Any]:
    return {} if source.T_robot_camera is None else {"T_robot_camera": source.T_robot_camera.tolist()}


def _camera(source: Source, images: Path) -> dict[str, Any]:
    """Return the table of a camera; empty where it has no depth images."""
    return camera_document(source.camera) if images.is_dir() else {}


def _frame_rows(
    journal: Journal, start: float, values: FloatArray, free: Sequence[tuple[float, float]]
) -> Iterator[Sequence[object]]:
    for entry in journal.entries():
        time = entry.time - start
        told = [int(any(first - EXACT <= time <= last + EXACT for first, last in free))] if free else []
        yield [entry.number, time, *values[entry.number].tolist(), *told]


def _marker_rows(journal: Journal) -> Iterator[Sequence[object]]:
    for entry in journal.entries():
        for camera, seen in entry.seen.items():
            begin = [entry.number, camera] if camera else [entry.number]
            yield from ([*begin, name, *place] for name, place in seen.markers.items())
            yield from ([*begin, "", *place] for place in seen.unlabelled)


def _load_rows(journal: Journal) -> Iterator[Sequence[object]]:
    for entry in journal.entries():
        yield from ([entry.number, *load] for load in entry.loads)


def _write_rows(path: Path, columns: list[str], rows: Iterator[Sequence[object]]) -> None:
    """Write a table, if it has a row."""
    first = list(islice(rows, 1))
    if not first:
        return

    def all_rows() -> Iterator[Sequence[object]]:
        yield from first
        yield from rows

    write_csv(path, columns, all_rows())
