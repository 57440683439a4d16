"""Text files of points (.xyz): x y z in a line, then perhaps a normal or a colour; blanks or commas between."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError

SKIPPED = ("#", "//")


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
    lines = file.read_bytes().decode("utf-8-sig", "replace").replace(",", " ").replace(";", " ").splitlines()
    rows = [(i, line.split()) for i, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith(SKIPPED)]
    if rows and (len(rows[0][1]) == 1 or not _is_number(rows[0][1][0])):
        rows = rows[1:]
    if not rows:
        return {name: np.zeros(0) for name in "xyz"}
    table = _table(rows, file)
    columns: dict[str, npt.NDArray[np.generic]] = {name: table[:, i] for i, name in enumerate("xyz")}
    last = table[:, -3:]
    if table.shape[1] >= 6 and _is_color(last):
        columns |= {name: last[:, i] for i, name in enumerate(("red", "green", "blue"))}
    return columns


def _table(rows: list[tuple[int, list[str]]], file: Path) -> FloatArray:
    width = len(rows[0][1])
    bad = next(((i, row) for i, row in rows if len(row) != width or len(row) < 3 or not all(map(_is_number, row))), None)
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


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
