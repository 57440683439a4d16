"""Rows of markers.csv without a measurement: many programs write a lost marker as zeros or another constant."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import DataError

SHOWN = 6
"""Rows that a warning names."""


def is_a_place(path: object, xyz: FloatArray, names: Sequence[str], frame: IntArray) -> BoolArray:
    """Return which rows are positions, shape (rows,): many programs write a lost marker as 0, 0, 0 or another number three times.

    Arguments:
        path: for messages.
        xyz: as the file has them, shape (rows, 3).
        names: of each row's marker, "" without one.
        frame: number of each row's frame.

    Raises:
        DataError: a marker that has no other row.
    """
    lost = np.asarray((xyz == xyz[:, :1]).all(axis=1))
    if not lost.any():
        return np.asarray(~lost)
    cells = np.array(names)
    what = " or ".join(sorted({", ".join([f"{x:g}"] * 3) for x in xyz[lost, 0] + 0.0}))
    never = sorted({str(name) for name in cells[lost]} - {str(name) for name in cells[~lost]})
    if never:
        text = ", ".join(name or "(without a name)" for name in never)
        raise DataError(
            f"{path}: {what} in every row of {text}: these markers were always lost. Remove their rows, or rename the columns"
        )
    warnings.warn(f"{path}: {what} is a lost marker, left out: {_rows(cells[lost], frame[lost])}", stacklevel=4)
    return np.asarray(~lost)


def _rows(names: Sequence[str], frames: Sequence[int] | IntArray) -> str:
    rows = [f"{name or '(without a name)'} in frame {number}" for name, number in zip(names, frames)]
    return ", ".join(rows[:SHOWN]) + (f" and {len(rows) - SHOWN} more" if len(rows) > SHOWN else "")
