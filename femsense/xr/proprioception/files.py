"""SENSORS.csv and MARKERS.csv.

SENSORS.csv: `time_s`, optionally `frame`, and one column a channel, with any name and in any unit.
MARKERS.csv: `frame,marker,x_m,y_m,z_m`, as in a recording; a hidden marker has no row. Frames are those of SENSORS.csv, there the
rows from 0 where it has no such column.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.tables import read_csv, read_text
from femsense.xr.proprioception.labelled import Labelled, labelled

NOT_CHANNELS = ("frame", "time_s")
AXES = ("x_m", "y_m", "z_m")


def read_labelled(sensors: str | Path, markers: str | Path) -> Labelled:
    """Return readings with their markers from two CSV files; rows without all markers are left out.

    Raises:
        InputError: what cannot be read, no channel, times that decrease, frames that are in one file only.
    """
    frames, time_s, channels, readings = read_sensors(sensors)
    names, places = _read_markers(Path(markers), frames)
    return labelled(time_s, readings, places, channels=channels, marker_names=names)


def read_sensors(path: str | Path) -> tuple[IntArray, FloatArray, tuple[str, ...], FloatArray]:
    """Return frames (n,), times [s] (n,), names of channels and readings (n, c) of SENSORS.csv; an empty cell is nan.

    Raises InputError.
    """
    file = Path(path)
    header = next(csv.reader(io.StringIO(read_text(file))), [])
    columns = tuple(cell.strip() for cell in header)
    channels = tuple(name for name in columns if name not in NOT_CHANNELS)
    table = read_csv(file, required=("time_s",), optional=("frame", *channels))
    if not channels:
        raise InputError(
            "no channel", where=f"{file}, header", found=", ".join(columns), expected="time_s and a column for each sensor"
        )
    frames = table.integers("frame") if "frame" in columns else np.arange(len(table))
    again = np.flatnonzero(np.bincount(frames) > 1)
    if len(again):
        raise InputError("a frame stands twice", where=f"{file}, column frame", found=int(again[0]))
    return frames, table.numbers(("time_s",))[:, 0], channels, table.numbers(channels, empty_is_nan=True)


def _read_markers(path: Path, frames: IntArray) -> tuple[tuple[str, ...], FloatArray]:
    """Return names in the order in which they first come, and places (n, m, 3), nan where a marker is hidden."""
    table = read_csv(path, required=("frame", "marker", *AXES))
    labels, numbers = table.text("marker"), table.integers("frame")
    names = tuple(dict.fromkeys(labels))
    if not names or "" in names:
        raise InputError("a marker without a name", where=path, found=names or "no row", expected="a name in each row")
    row_of = {int(frame): row for row, frame in enumerate(frames)}
    unknown = [int(number) for number in numbers if int(number) not in row_of]
    if len(unknown) == len(numbers):
        hint = did_you_mean(str(unknown[0]), [str(frame) for frame in frames[:50]])
        raise InputError(
            "no frame is in both files",
            where=path,
            found=f"frames {unknown[0]} … {unknown[-1]}",
            expected=f"frames {frames[0]} … {frames[-1]}" if len(frames) else "rows",
            hint=hint,
        )
    places = np.full((len(frames), len(names), 3), np.nan)
    for label, number, place in zip(labels, numbers, table.numbers(AXES)):
        if int(number) in row_of:
            places[row_of[int(number)], names.index(label)] = place
    return names, places
