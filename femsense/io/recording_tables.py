"""The tables of a recording folder: frames.csv, markers.csv, rest.csv and loads.csv, read and written."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray, freeze
from femsense.core.errors import InputError, UnitError
from femsense.core.text import did_you_mean
from femsense.io.files import write_csv
from femsense.io.lost_markers import is_a_place
from femsense.io.recording_columns import columns
from femsense.io.tables import Table, read_csv
from femsense.model.plausibility import RANGES
from femsense.model.recording import Recording
from femsense.model.recording_parts import Drives, LoadRows, MarkerRows, RestMarkers, Timeline, UnnamedRows

GRAVITY_COLUMNS = ("gravity_x_m_s2", "gravity_y_m_s2", "gravity_z_m_s2")
PLACE_COLUMNS = ("x_m", "y_m", "z_m")
FORCE_COLUMNS = ("fx_n", "fy_n", "fz_n")
TOO_FAR = 50.0
"""A marker farther from its camera than this [m] is in another unit."""
TOO_LONG = 5.0
"""A cable displacement beyond this [m] is in another unit."""


def read_frames(path: Path, actuation: str, actuation_zero: str) -> tuple[Timeline, Drives]:
    """Return the content of frames.csv; `actuation` is that of recording.toml. Raises InputError."""
    if not path.is_file():
        raise InputError(
            "frames.csv is missing",
            where=path,
            found="no such file",
            expected="a table frame,time_s,cable_<name>… with one row a frame",
        )
    table = _table(path)
    if not len(table):
        raise InputError("no frames", where=path, found="a header without rows", expected="one row a frame")
    numbers, time_s = table.integers("frame"), table.numbers(["time_s"])[:, 0]
    _check_order(table, numbers, time_s)
    cables = [column for column in table.columns if column.startswith("cable_")]
    chambers = [column for column in table.columns if column.startswith("chamber_")]
    inputs = table.numbers(cables)
    if actuation == "displacement" and inputs.size and np.abs(inputs).max() > TOO_LONG:
        row, column = np.argwhere(np.abs(inputs) > TOO_LONG)[0]
        worst = float(np.abs(inputs).max())
        likely = 1e-3 * worst <= RANGES.displacement_m
        raise InputError(
            "a cable displacement of this size looks like millimetres"
            if likely
            else "a cable displacement of this size is no length",
            where=table.place(row, cables[column]),
            found=f"{inputs[row, column]:g} m",
            expected="metres",
            hint=("divide the column by 1000; or " if likely else "")
            + f"ticks, degrees or steps of a motor? femsense import --map NAME={cables[column]}*FACTOR states metres per unit",
        )
    timeline = Timeline(
        time_s,
        numbers,
        free=_free(table) if "free" in table.columns else None,
        sweep=table.text("sweep") if "sweep" in table.columns else None,
        gravity=_gravity(table),
    )
    drives = Drives(
        [column.removeprefix("cable_") for column in cables],
        inputs,
        actuation,
        actuation_zero,
        chamber_names=[column.removeprefix("chamber_") for column in chambers],
        pressures=table.numbers(chambers),
    )
    return timeline, drives


def read_markers(path: Path, views: tuple[str, ...], numbers: IntArray, noise_m: float | None) -> tuple[MarkerRows, UnnamedRows]:
    """Return the rows of markers.csv: those that name a marker, and those that do not. Raises InputError, DataError."""
    if not path.is_file():
        return MarkerRows((), (), (), (), noise_m=noise_m), UnnamedRows()
    table = _table(path)
    frame = _frame_indices(table, numbers)
    view = _view_indices(table, views)
    xyz = table.numbers(PLACE_COLUMNS)
    measured = is_a_place(path, xyz, table.text("marker"), numbers[frame])
    table, frame, view, xyz = table.without(~measured), frame[measured], view[measured], xyz[measured]
    _check_metres(table, xyz)
    unnamed = _unnamed(table, frame, numbers)
    nameless = UnnamedRows(frame[unnamed], xyz[unnamed], view[unnamed])
    table, frame, view, xyz = table.without(unnamed), frame[~unnamed], view[~unnamed], xyz[~unnamed]
    names, index = _named(table)
    keys = np.stack([frame, index, view], axis=1)
    _, first = np.unique(keys, axis=0, return_index=True)
    if len(first) < len(keys):
        row = int(np.setdiff1d(np.arange(len(keys)), first)[0])
        raise InputError(
            "a marker occurs twice in one frame",
            where=table.place(row),
            found=f"frame {numbers[frame[row]]}, marker {names[index[row]]!r}",
            expected="one row a frame and marker",
        )
    return MarkerRows(names, frame, index, xyz, view, noise_m), nameless


def read_rest(path: Path, views: tuple[str, ...]) -> RestMarkers | None:
    """Return the markers of rest.csv; None where there is no such file. Raises InputError."""
    if not path.is_file():
        return None
    table = _table(path)
    xyz, view = table.numbers(PLACE_COLUMNS), _view_indices(table, views)
    _check_metres(table, xyz)
    std = table.numbers(["std_m"], empty_is_nan=True)[:, 0] if "std_m" in table.columns else np.full(len(table), np.nan)
    if (std < 0).any():
        row = int(np.flatnonzero(std < 0)[0])
        raise InputError(
            "a standard deviation below zero", where=table.place(row, "std_m"), found=float(std[row]), expected="≥ 0 m"
        )
    names, index = _named(table)
    seen = {}
    for row, key in enumerate(zip(index.tolist(), view.tolist())):
        if key in seen:
            raise InputError(
                "a marker occurs twice", where=table.place(row, "marker"), found=names[key[0]], expected="one row a marker"
            )
        seen[key] = row
    return RestMarkers(tuple(names[i] for i in index), freeze(xyz), freeze(std), freeze(view, np.int64))


def read_loads(path: Path, numbers: IntArray) -> LoadRows:
    """Return the rows of loads.csv. Raises InputError."""
    if not path.is_file():
        return LoadRows()
    table = _table(path)
    return LoadRows(_frame_indices(table, numbers), table.numbers(PLACE_COLUMNS), table.numbers(FORCE_COLUMNS))


def write_frames(recording: Recording, path: Path) -> None:
    """Write frames.csv."""
    r = recording
    columns: Mapping[str, Any] = {
        "frame": r.frame_numbers.tolist(),
        "time_s": r.time_s.tolist(),
        **{f"cable_{name}": r.inputs[:, j].tolist() for j, name in enumerate(r.cable_names)},
        **{f"chamber_{name}": r.pressures[:, j].tolist() for j, name in enumerate(r.chamber_names)},
        **({} if r.free is None else {"free": r.free.astype(int).tolist()}),
        **({} if r.sweep is None else {"sweep": r.sweep}),
        **({} if r.gravity is None else {name: r.gravity[:, j].tolist() for j, name in enumerate(GRAVITY_COLUMNS)}),
    }
    write_csv(path, list(columns), zip(*columns.values()))


def write_markers(recording: Recording, path: Path) -> None:
    """Write markers.csv, unless there are none."""
    if not recording.has_markers and not len(recording.unnamed_frame):
        return
    r, named = recording, recording.camera_names != ("",)
    rows = (
        [r.frame_numbers[f], *([r.camera_names[v]] if named else []), r.marker_names[i], *xyz]
        for f, i, v, xyz in zip(r.marker_frame, r.marker_index, r.marker_view, r.marker_xyz.tolist())
    )
    unnamed = (
        [r.frame_numbers[f], *([r.camera_names[v]] if named else []), "", *xyz]
        for f, v, xyz in zip(r.unnamed_frame, r.unnamed_view, r.unnamed_xyz.tolist())
    )
    write_csv(path, ["frame", *(["camera"] if named else []), "marker", *PLACE_COLUMNS], chain(rows, unnamed))


def write_rest(recording: Recording, path: Path) -> None:
    """Write rest.csv, unless there is nothing in it."""
    rest, named = recording.rest, recording.camera_names != ("",)
    if rest is None:
        return
    with_std = bool(np.isfinite(rest.std).any())
    columns = ["marker", *(["camera"] if named else []), *PLACE_COLUMNS, *(["std_m"] if with_std else [])]
    rows = (
        [name, *([recording.camera_names[v]] if named else []), *xyz, *([std] if with_std else [])]
        for name, v, xyz, std in zip(rest.names, rest.view, rest.positions.tolist(), rest.std.tolist())
    )
    write_csv(path, columns, rows)


def write_loads(recording: Recording, path: Path) -> None:
    """Write loads.csv, unless there are none."""
    r = recording
    if not len(r.load_frame):
        return
    rows = ([r.frame_numbers[f], *p, *n] for f, p, n in zip(r.load_frame, r.load_points.tolist(), r.load_forces.tolist()))
    write_csv(path, ["frame", *PLACE_COLUMNS, *FORCE_COLUMNS], rows)


def _table(path: Path) -> Table:
    required, optional, prefixes = columns(path.name)
    return read_csv(path, required=required, optional=optional, prefixes=prefixes)


def _check_order(table: Table, numbers: IntArray, time_s: FloatArray) -> None:
    first: dict[int, int] = {}
    for row, number in enumerate(numbers.tolist()):
        if number in first:
            raise InputError(
                "a frame occurs twice",
                where=table.place(row, "frame"),
                found=number,
                expected="each frame once",
                hint=f"it is already in line {table.lines[first[number]]} too",
            )
        first[number] = row
    bad = np.flatnonzero(np.diff(time_s) <= 0)
    if len(bad):
        row = int(bad[0]) + 1
        raise InputError(
            "time does not increase",
            where=table.place(row, "time_s"),
            found=f"{time_s[row]:g} s after {time_s[row - 1]:g} s",
            expected="rows in order of time",
        )


def _free(table: Table) -> BoolArray:
    cells = table.text("free")
    bad = next((row for row, cell in enumerate(cells) if cell not in ("0", "1")), None)
    if bad is not None:
        raise InputError(
            "neither 0 nor 1",
            where=table.place(bad, "free"),
            found=cells[bad] or "an empty cell",
            expected="1 where nothing touches the robot, else 0",
        )
    return np.array([cell == "1" for cell in cells], dtype=bool)


def _gravity(table: Table) -> FloatArray | None:
    given = [column for column in GRAVITY_COLUMNS if column in table.columns]
    if given and len(given) < 3:
        raise InputError(
            "gravity needs its three columns",
            where=f"{table.path}, header",
            found=", ".join(given),
            expected=", ".join(GRAVITY_COLUMNS),
        )
    return table.numbers(GRAVITY_COLUMNS) if given else None


def _unnamed(table: Table, frame: IntArray, numbers: IntArray) -> BoolArray:
    """Return which rows name no marker, shape (rows,). Raises InputError where a frame has both kinds."""
    empty = np.array([not cell for cell in table.text("marker")], dtype=bool)
    mixed = np.flatnonzero(empty & np.isin(frame, frame[~empty]))
    if len(mixed):
        raise InputError(
            "named and unnamed markers in one frame",
            where=table.place(int(mixed[0]), "marker"),
            found=f"an empty cell in frame {numbers[frame[mixed[0]]]}",
            expected="a name, or empty cells in all rows of a frame with unnamed markers",
        )
    return empty


def _frame_indices(table: Table, numbers: IntArray) -> IntArray:
    """Return the column `frame` as indices into frames.csv, shape (rows,)."""
    row_of = {number: row for row, number in enumerate(numbers.tolist())}
    wanted = table.integers("frame").tolist()
    for row, number in enumerate(wanted):
        if number not in row_of:
            span = f"a frame of frames.csv ({numbers.min()} … {numbers.max()})"
            raise InputError(
                "a frame that frames.csv does not have", where=table.place(row, "frame"), found=number, expected=span
            )
    return np.array([row_of[number] for number in wanted], dtype=np.int64)


def _named(table: Table) -> tuple[list[str], IntArray]:
    """Return the markers in the order of their first appearance, and the index of each row's marker."""
    cells = table.text("marker")
    if "" in cells:
        raise InputError(
            "a marker without a name", where=table.place(cells.index(""), "marker"), found="an empty cell", expected="a name"
        )
    number = {name: i for i, name in enumerate(dict.fromkeys(cells))}
    return list(number), np.array([number[cell] for cell in cells], dtype=np.int64)


def _view_indices(table: Table, views: tuple[str, ...]) -> IntArray:
    if "camera" not in table.columns:
        if len(views) > 1:
            raise InputError(
                "which camera saw these markers?",
                where=f"{table.path}, header",
                found=", ".join(table.columns),
                expected=f"a column camera with one of: {', '.join(views)}",
            )
        return np.zeros(len(table), dtype=np.int64)
    cells = table.text("camera")
    for row, cell in enumerate(cells):
        if cell not in views:
            raise InputError(
                "a camera that recording.toml does not have",
                where=table.place(row, "camera"),
                found=cell or "an empty cell",
                expected=", ".join(views) if views != ("",) else "no column camera, or [cameras.NAME] in recording.toml",
                hint=did_you_mean(cell, views),
            )
    return np.array([views.index(cell) for cell in cells], dtype=np.int64)


def _check_metres(table: Table, xyz: FloatArray) -> None:
    far = np.flatnonzero(np.abs(xyz).max(axis=1, initial=0.0) > TOO_FAR)
    if not len(far):
        return
    most = len(far) > 0.2 * len(xyz)
    what = "coordinates of this size look like millimetres" if most else "a marker this far away is not plausible"
    hint = "divide x, y and z by 1000" if most else "leave the row out where the marker was lost"
    kind = UnitError if most else InputError
    raise kind(
        what,
        where=table.place(int(far[0])),
        found=xyz[far[0]].tolist(),
        expected=f"metres in the camera frame, below {TOO_FAR:g}",
        hint=hint,
    )
