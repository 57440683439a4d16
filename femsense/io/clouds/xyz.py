"""Text files of points (.xyz): x y z in each line, optionally followed by a normal or a colour; separated by blanks, commas, semicolons
or tabs, except for commas also with decimal commas."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.text_numbers import plain_number

SKIPPED = ("#", "//")
DECIMAL_COMMA = re.compile(r"(?:[-+]?\d+,\d+(?:[eE][-+]?\d+)?|[-+]?\d+)")
"""A number with a decimal comma, or a whole one."""


def read_xyz_columns(path: str | Path) -> dict[str, npt.NDArray[np.generic]]:
    """Return the columns x, y, z of a text file, and red, green, blue where it has them, each of shape (n,).

    Three numbers after the place are a colour where none is negative and they are no directions of length 1.
    A first line with one number is a count, one with words is a header.

    Raises:
        InputError: no such file, lines of different lengths, or words that are no numbers.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a text file of points")
    lines = file.read_bytes().decode("utf-8-sig", "replace").splitlines()
    told = [(i, line) for i, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith(SKIPPED)]
    comma = "." if _has_decimal_commas(told[-1][1] if told else "") else " "
    rows = [(i, line.replace(",", comma).replace(";", " ").split()) for i, line in told]
    if rows and (len(rows[0][1]) == 1 or plain_number(rows[0][1][0]) is None):
        first, rows = rows[0][1], rows[1:]
        if len(first) == 1 and plain_number(first[0]) not in (None, len(rows)):
            raise InputError("a broken or shortened file", where=file, found=f"{len(rows)} points", expected=f"{first[0]} points")
    if not rows:
        return {name: np.zeros(0) for name in "xyz"}
    table = _table(rows, file)
    columns: dict[str, npt.NDArray[np.generic]] = {name: table[:, i] for i, name in enumerate("xyz")}
    last = table[:, -3:]
    if table.shape[1] >= 6 and _is_color(last):
        columns |= {name: last[:, i] for i, name in enumerate(("red", "green", "blue"))}
    return columns


def _has_decimal_commas(line: str) -> bool:
    """Whether a line is three numbers or more with decimal commas, kept apart by semicolons, tabs or blanks."""
    words = line.replace(";", " ").split()
    return "," in line and "." not in line and len(words) >= 3 and all(DECIMAL_COMMA.fullmatch(word) for word in words)


def _table(rows: list[tuple[int, list[str]]], file: Path) -> FloatArray:
    width = len(rows[0][1])
    bad = next(((i, row) for i, row in rows if len(row) != width or len(row) < 3 or None in map(plain_number, row)), None)
    if bad is not None:
        raise InputError(
            "not a line of a point",
            where=f"{file}, line {bad[0]}",
            found=" ".join(bad[1])[:80],
            expected=f"{max(width, 3)} numbers: x y z in metres, and what the other lines have",
        )
    return np.array([row for _, row in rows], dtype=np.float64)


def _is_color(values: FloatArray) -> bool:
    directions = np.abs(np.linalg.norm(values, axis=1) - 1.0) < 1e-2
    return bool((values >= 0).all() and not directions.all())
