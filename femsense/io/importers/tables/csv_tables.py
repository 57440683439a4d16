"""Tables of numbers as text: separators, decimal commas, comments, units and times as people's programs write them."""

from __future__ import annotations

import csv
import gzip
import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import plain_name
from femsense.core.units import Quantity, Unit, unit_named
from femsense.io.text_numbers import SLASHED, TIMES_READ, Notation, month_stands_first, notation_of, number_in

ENDINGS = (".csv", ".txt", ".tsv", ".trc")
TIMES = (
    "time",
    "t",
    "timestamp",
    "time stamp",
    "ts",
    "elapsed",
    "elapsed time",
    "date time",
    "datetime",
    "clock",
    "epoch",
    "utc",
)
"""Names of columns of time in small letters with blanks, with or without a unit behind; names of units of time are some too."""
FUSED = re.compile(r"(?:time|timestamp|elapsed)(ms|us|ns|s|sec)")
BRACKETED = re.compile(r"(.+?)\s*[\[(]\s*(.+?)\s*[\])]")
ENDED = re.compile(
    r"(.+?)[_ ./]([uµμmc]?m|[munµμ]?s|secs?|seconds|millis(?:econds)?|micros(?:econds)?|days"
    r"|(?:[hkM]?Pa|m?bar|psi)[_ ]?(?:a|g|abs|gauge)?|pascals?|mmHg|[mk]?N|newtons?|k?gf|lbf|rad|deg|degrees|radians|ticks|counts|mA)",
    re.IGNORECASE,
)
"""A unit behind a name without brackets: not those that are words or parts of a robot, such as in, min, g, a."""
NO_TEXT = bytes([*range(9), *range(14, 27), *range(28, 32)])
"""Bytes that do not occur in text."""
EMPTY = ("", "na", "n/a", "null", "none")
"""Cells without a number, in small letters; float() reads "nan" itself."""
MARKS = "\t;,"
LOOKED_AT = 20
"""Number of first lines that decide which mark separates the cells."""


def is_text(path: Path) -> bool:
    """Whether a file has the ending of a table of text, gzipped or not."""
    return path.is_file() and path.name.lower().removesuffix(".gz").endswith(ENDINGS)


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
            head = stream.read(1 << 16)
            encoding = _encoding(head)
            if encoding is None:
                raise InputError("no text", where=path, found=f"a file that begins {head[:8]!r}", expected="a table such as CSV")
            stream.seek(0)
            with io.TextIOWrapper(stream, encoding=encoding, errors="replace", newline="") as text:
                yield text
    except (EOFError, gzip.BadGzipFile, OSError) as error:
        raise InputError("a broken compressed file", where=path, found=str(error), expected="a whole gzip file") from None


def _encoding(head: bytes) -> str | None:
    """Return the encoding of a text by its first bytes: UTF-8, UTF-16 with or without a mark, else that of Windows; None for no text."""
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return "utf-16"
    if len(head) > 3 and not any(head[1:256:2]) and all(head[:256:2]):
        return "utf-16-le"
    if len(head) > 3 and not any(head[:256:2]) and all(head[1:256:2]):
        return "utf-16-be"
    if any(byte in NO_TEXT for byte in head[:256].rstrip(b"\0")):
        return None
    try:
        head[: head.rfind(b"\n") + 1 or len(head)].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


@dataclass(frozen=True, slots=True)
class Layout:
    """Separator and notation of a table."""

    mark: str
    """Between the cells."""
    notation: Notation


def layout_of(path: Path) -> Layout:
    """Return the separator of a table, and the notation of its numbers."""
    with open_text(path) as stream:
        return _layout(stream.read(8192), path)


def _layout(head: str, path: Path) -> Layout:
    lines = [line for line in head.splitlines()[:LOOKED_AT] if line.strip() and not _is_comment(line)]
    mark = next((m for m in MARKS if 2 * sum(m in line for line in lines) >= len(lines)), ",") if lines else ","
    cells = (cell for row in csv.reader(lines, delimiter=mark) for cell in row)
    notation = notation_of(cells, default="." if mark == "," else ",")
    return Layout(mark, replace(notation, month_first=_month_first(path)) if SLASHED.search(head) else notation)


def _month_first(path: Path) -> bool:
    """Return whether the month stands first in the dates with slashes of a whole table."""
    with open_text(path) as stream:
        found = (SLASHED.search(line) for line in stream)
        return month_stands_first([(int(date[1]), int(date[2]), int(date[3])) for date in found if date])


def rows_of(path: Path) -> Iterator[list[str]]:
    """Yield the rows of a table as text, numbers with decimal points; tabs, semicolons or commas between the cells.

    Decimal commas and marks between thousands are those of the table's first lines (see `notation_of`).
    Lines of comment before the table come as empty rows, but for one that names its columns (as NumPy writes them).
    """
    with open_text(path) as stream:
        layout = _layout(stream.read(8192), path)
        stream.seek(0)
        begun, said = False, list[str]()
        for row in csv.reader(stream, delimiter=layout.mark):
            cells = [layout.notation.plain(cell) for cell in row]
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


def is_cut_off(path: Path) -> bool:
    """Whether a text file ends within a line."""
    if path.suffix.lower() == ".gz" or not path.stat().st_size:
        return False
    with path.open("rb") as stream:
        stream.seek(-min(path.stat().st_size, 2), 2)
        return not stream.read().strip(b"\0").endswith((b"\n", b"\r"))


def header_of(path: Path) -> tuple[list[str], bool]:
    """Return the names of the columns, and whether they are in the file; without a header they are 1, 2, …

    Units in a separate row are appended to the names in brackets.
    """
    rows = (row for row in rows_of(path) if any(cell.strip() for cell in row))
    first = next(rows, [])
    if not first:
        raise InputError("an empty table", where=path, found=f"{path.stat().st_size} bytes", expected="rows of numbers")
    if all(number_in(cell) is not None or not cell.strip() for cell in first):
        return [str(i + 1) for i in range(len(first))], False
    names, units = [plain_name(cell) for cell in first], next(rows, [])
    if _are_units(units):
        bare = [cell.strip().strip("[]()") for cell in units]
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, bare)] + names[len(bare) :]
    return names, True


def _are_units(cells: Sequence[str]) -> bool:
    """Whether the row below the names contains units: words instead of numbers, at least one of them a unit."""
    words = [cell.strip().strip("[]()") for cell in cells if cell.strip()]
    return all(number_in(word) is None for word in words) and any(unit_named(word) is not None for word in words)


def read_numbers(path: Path) -> tuple[list[str], FloatArray]:
    """Return the names of the columns and the table, shape (rows, columns); NaN where a cell is empty. Raises InputError."""
    names, _ = header_of(path)
    rows = list(number_rows(path))
    return names, np.array(rows, dtype=np.float64).reshape(-1, len(names))


def number_rows(path: Path) -> Iterator[list[float]]:
    """Yield the rows of numbers after the header; NaN where a cell is empty.

    A truncated last row is removed with a warning.

    Raises:
        InputError: another row that is not numeric, with its line number.
    """
    names, headed = header_of(path)
    rows = (item for item in enumerate(rows_of(path), start=1) if any(cell.strip() for cell in item[1]))
    if headed:
        next(rows, None)
    for k, (line, cells) in enumerate(rows):
        if headed and k == 0 and _are_units(cells):
            continue
        values = [np.nan if cell.strip().lower() in EMPTY else number_in(cell) for cell in cells[: len(names)]]
        more = [cell for cell in cells[len(names) :] if cell.strip()]
        if len(values) == len(names) and not more and all(value is not None for value in values):
            yield [float(value) for value in values if value is not None]
            continue
        if is_cut_off(path) and next(rows, None) is None:
            warnings.warn(f"{path}: the last line was cut off and is left out", stacklevel=2)
            return
        bad = (
            f"{len(cells)} cells"
            if more
            else next((c for c, value in zip(cells, values) if value is None), f"{len(cells)} cells")
        )
        raise InputError(
            "not a row of numbers",
            where=f"{path}, line {line}",
            found=bad,
            expected=f"{len(names)} numbers",
            hint=_row_hint(cells, bad, len(names)),
        )


def _row_hint(cells: Sequence[str], bad: str, width: int) -> str | None:
    """Return the probable error in a row that is not numeric."""
    if len(cells) > width and ("," not in "".join(cells)):
        return "decimal commas between commas? Export with points, or with semicolons between the cells"
    if ":" in bad or re.search(r"\d[./-]\d+[./-]\d", bad):
        return f"times are read as {TIMES_READ}"
    return "decimal points, not commas" if "," in bad else None


def column_unit(name: str) -> tuple[str, Unit | None]:
    """Return a column's name without its unit, and the unit that follows it in brackets or after "_"; None without one.

    Raises:
        InputError: an ambiguous unit.
    """
    text = name.strip()
    for match in (BRACKETED.fullmatch(text), ENDED.fullmatch(text)):
        try:
            unit = unit_named(match[2].replace("_", " ")) if match else None
        except InputError as problem:
            raise InputError(problem.what, where=f"column {name}", found=problem.found, expected=problem.expected) from None
        if match and unit is not None:
            return match[1].strip(), unit
    return text, None


def time_column(names: Sequence[str], path: Path) -> tuple[int, Unit | None]:
    """Return the column of time, and its unit; None without one in its name. Raises InputError."""
    for j, name in enumerate(names):
        found = _as_time(name)
        if found is not None:
            return j, found[0]
    wanted = ", ".join((*TIMES[:5], "time_s", "time_ms", "time [ms]"))
    raise InputError("no column of time", where=path, found=", ".join(names[:12]), expected=wanted)


def is_time(name: str) -> bool:
    """Whether a column's name denotes times."""
    return _as_time(name) is not None


def _as_time(name: str) -> tuple[Unit | None] | None:
    """Return the unit (or None) of a column of time as a tuple; None for any other column."""
    bare, unit = column_unit(name)
    words = re.sub(r"[_\s.-]+", " ", bare).strip().lower()
    if words in TIMES and (unit is None or unit.quantity is Quantity.TIME):
        return (unit,)
    fused = FUSED.fullmatch(words.replace(" ", ""))
    alone = unit_named(fused[1] if fused else bare) if fused or len(bare) > 2 else None
    return (alone,) if alone is not None and alone.quantity is Quantity.TIME and unit is None else None
