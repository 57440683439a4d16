"""Tables of numbers as text: separators, decimal commas, comments, units and times as people's programs write them."""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError

TIMES = ("time", "t", "timestamp", "seconds", "secs", "sec")
"""Names of columns of time, with or without a unit behind."""
SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
"""Seconds in one unit of time."""
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
FORCES = {"n": 1.0, "mn": 1e-3, "kn": 1e3}
PRESSURES = {"pa": 1.0, "hpa": 1e2, "mbar": 1e2, "kpa": 1e3, "mpa": 1e6, "bar": 1e5, "psi": 6894.757}
SINCE_1970 = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))
"""A time without a unit that is as large as this cannot be seconds (10¹¹ s is the year 5138): seconds in one unit of it."""
DECIMAL_COMMA = re.compile(r"\s*[-+]?\d*,\d+(?:[eE][-+]?\d+)?\s*")
BRACKETED = re.compile(r"(.+?)\s*[\[(]\s*([A-Za-zµ]+)\s*[\])]")
ENDED = re.compile(r"(.+?)[_ ](mm|cm|m|ms|us|ns|s|MPa|[hk]?[pP]a|m?bar|psi|m?[nN])")
NO_TEXT = bytes([*range(9), *range(14, 27), *range(28, 32)])
"""Bytes that stand in no text."""
EMPTY = ("", "na", "n/a", "null", "none")
"""What stands in a cell without a number, in small letters; float() reads "nan" itself."""
DAY = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d.*")
MARKS = "\t;,"
LOOKED_AT = 20
"""So many first lines tell what stands between the cells."""


@contextmanager
def open_text(path: Path) -> Iterator[io.TextIOBase]:
    """Open a text file in UTF-8 or UTF-16, gzipped or not. Raises InputError where it cannot be read."""
    try:
        opened = gzip.open if path.suffix.lower() == ".gz" else open
        raw = opened(path, "rb")
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None
    try:
        with raw as stream:
            head = stream.read(256)
            wide = head[:2] in (b"\xff\xfe", b"\xfe\xff")
            if not wide and any(byte in NO_TEXT for byte in head.rstrip(b"\0")):
                raise InputError("no text", where=path, found=f"a file that begins {head[:8]!r}", expected="a table such as CSV")
            stream.seek(0)
            with io.TextIOWrapper(stream, encoding="utf-16" if wide else "utf-8-sig", errors="replace", newline="") as text:
                yield text
    except (EOFError, gzip.BadGzipFile, OSError) as error:
        raise InputError("a broken compressed file", where=path, found=str(error), expected="a whole gzip file") from None


def rows_of(path: Path) -> Iterator[list[str]]:
    """Yield the rows of a table as text; tabs, semicolons or commas between, and beside the first two decimal commas.

    Lines of comment before the table come as empty rows, but for one that names its columns (as NumPy writes them).
    """
    with open_text(path) as stream:
        lines = [line for line in stream.read(8192).splitlines()[:LOOKED_AT] if line.strip() and not _is_comment(line)]
        stream.seek(0)
        mark = next((m for m in MARKS if 2 * sum(m in line for line in lines) >= len(lines)), ",") if lines else ","
        begun, said = False, list[str]()
        for row in csv.reader(stream, delimiter=mark):
            cells = row if mark == "," else [_with_point(cell) for cell in row]
            if begun:
                yield cells
            elif cells and _is_comment(cells[0]):
                said = [cells[0].lstrip("#% ").strip(), *cells[1:]]
            else:
                begun = any(cell.strip() for cell in cells)
                if begun and len(said) == len(cells) > 1 and number_in(cells[0]) is not None:
                    yield said
                elif said:
                    yield []
                yield cells


def _is_comment(text: str) -> bool:
    return text.lstrip().startswith(("#", "%"))


def _with_point(cell: str) -> str:
    """Return a number with a decimal comma as one with a point, anything else as it is."""
    return cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell


def is_cut_off(path: Path) -> bool:
    """Whether a text file ends within a line."""
    if path.suffix.lower() == ".gz" or not path.stat().st_size:
        return False
    with path.open("rb") as stream:
        stream.seek(-min(path.stat().st_size, 2), 2)
        return not stream.read().strip(b"\0").endswith((b"\n", b"\r"))


def header_of(path: Path) -> tuple[list[str], bool]:
    """Return the names of the columns, and whether they stand in the file; a file of bare numbers has 1, 2, …

    Units in a row of their own come behind the names, in brackets.
    """
    rows = (row for row in rows_of(path) if any(cell.strip() for cell in row))
    first = next(rows, [])
    if not first:
        raise InputError("an empty table", where=path, found=f"{path.stat().st_size} bytes", expected="rows of numbers")
    if all(number_in(cell) is not None or not cell.strip() for cell in first):
        return [str(i + 1) for i in range(len(first))], False
    names, units = [cell.strip() for cell in first], next(rows, [])
    if _are_units(units):
        bare = [cell.strip().strip("[]()") for cell in units]
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, bare)] + names[len(bare) :]
    return names, True


def _are_units(cells: Sequence[str]) -> bool:
    """Whether the row below the names says units: words where numbers should stand, one of them a unit."""
    words = [cell.strip().strip("[]()").lower() for cell in cells if cell.strip()]
    known = SECONDS.keys() | LENGTHS.keys() | FORCES.keys() | PRESSURES.keys()
    return any(word in known for word in words) and all(number_in(word) is None for word in words)


def read_numbers(path: Path) -> tuple[list[str], FloatArray]:
    """Return the names of the columns and the table, shape (rows, columns); NaN where a cell is empty. Raises InputError."""
    names, _ = header_of(path)
    rows = list(number_rows(path))
    return names, np.array(rows, dtype=np.float64).reshape(-1, len(names))


def number_rows(path: Path) -> Iterator[list[float]]:
    """Yield the rows of numbers after the header; NaN where a cell is empty.

    A last row that was cut off is left out with a warning.

    Raises:
        InputError: another row that is no row of numbers, with its line.
    """
    names, headed = header_of(path)
    rows = (item for item in enumerate(rows_of(path), start=1) if any(cell.strip() for cell in item[1]))
    if headed:
        next(rows, None)
    for k, (line, cells) in enumerate(rows):
        if headed and k == 0 and _are_units(cells):
            continue
        values = [np.nan if cell.strip().lower() in EMPTY else number_in(cell) for cell in cells[: len(names)]]
        if len(values) == len(names) and all(value is not None for value in values):
            yield [float(value) for value in values if value is not None]
            continue
        if is_cut_off(path) and next(rows, None) is None:
            warnings.warn(f"{path}: the last line was cut off and is left out", stacklevel=2)
            return
        bad = next((cell for cell, value in zip(cells, values) if value is None), f"{len(cells)} cells")
        raise InputError(
            "not a row of numbers",
            where=f"{path}, line {line}",
            found=bad,
            expected=f"{len(names)} numbers",
            hint="decimal points, not commas" if "," in bad else None,
        )


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit in small letters; "" where it names none."""
    match = BRACKETED.fullmatch(name.strip()) or ENDED.fullmatch(name.strip())
    if match is None:
        return name.strip(), ""
    return match[1].strip(), match[2] if match[2] == "mPa" else match[2].lower()


def time_column(names: Sequence[str], path: Path) -> tuple[int, float]:
    """Return the column of time and seconds in one unit of it. Raises InputError."""
    for j, name in enumerate(names):
        bare, unit = split_unit(name)
        if bare.lower() in TIMES and unit in ("", *SECONDS):
            return j, SECONDS[unit] if unit else time_scale(path, j)
    wanted = ", ".join((*TIMES, "time_s", "time_ms", "time [ms]"))
    raise InputError("no column of time", where=path, found=", ".join(names[:12]), expected=wanted)


def is_time(name: str) -> bool:
    """Whether a column's name says that it holds times."""
    bare, unit = split_unit(name)
    return bare.lower() in TIMES and unit in ("", *SECONDS)


def time_scale(path: Path, column: int) -> float:
    """Return seconds in one unit of a time without a unit, by its size."""
    first = next(number_rows(path), None)
    if first is None:
        return 1.0
    return next((scale for least, scale in SINCE_1970 if first[column] > least), 1.0)


def number_in(cell: str) -> float | None:
    """Return the number in a cell, of a date and time the seconds since 1970 (UTC where no zone is named); None else."""
    try:
        return float(cell)
    except ValueError:
        pass
    if not DAY.fullmatch(cell.strip()):
        return None
    try:
        moment = datetime.fromisoformat(cell.strip())
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
