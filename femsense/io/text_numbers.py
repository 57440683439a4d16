"""Numbers, dates and times of day as people and their programs write them in text."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, date, datetime
from itertools import pairwise, product

BLANKS = " \u00a0\u202f\u2009'’"
"""Marks between thousands other than comma and point."""
GROUPED = re.compile(
    rf"([-+]?\d{{1,3}})((?P<mark>[.,{BLANKS}])\d{{3}}(?:(?P=mark)\d{{3}})*)(?P<rest>[.,]\d+)?(?P<power>[eE][-+]?\d+)?"
)
DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
FORTRAN = re.compile(r"^(\s*[-+]?\d*\.?\d*)[dD]([-+]?\d+\s*)$")
"""A double-precision number as Fortran writes it: 1.0D-03."""
DAY_FORMS = (
    "%d.%m.%Y",
    "%d.%m.%y",
    "%Y/%m/%d",
    "%Y.%m.%d",
    "%d/%m/%Y",
    "%m/%d/%Y",
    "%d-%m-%Y",
    "%d-%b-%Y",
    "%d %b %Y",
    "%b %d %Y",
)
CLOCK_FORMS = ("%H:%M:%S.%f", "%H:%M:%S", "%H:%M", "%I:%M:%S.%f %p", "%I:%M:%S %p", "%I:%M %p")
CLOCK = re.compile(r"(?:(\d{1,3}):)?(\d{1,2}):(\d{2}(?:[.,]\d+)?)\s*([AaPp]\.?[Mm]\.?)?")
DAY = re.compile(r"\d{1,2}([./-])\d{1,2}\1\d{4}|\d{4}([./-])\d{1,2}\2\d{1,2}")
SLASHED = re.compile(r"(?<![\d/])(\d{1,2})/(\d{1,2})/(\d{4})(?!\d)")
"""A date whose day or month stands first."""
TIMES_READ = (
    "seconds, 10:15:00.5, 10:15:00 PM, 2024-01-31T10:15:00, 31.01.2024 10:15:00, 1/31/2024 10:15:00, or days of a spreadsheet"
)


@dataclass(frozen=True, slots=True)
class Notation:
    """Notation of the numbers of a table."""

    decimal: str = "."
    """"." or ","."""
    grouped: bool = False
    """Whether some numbers have marks between their thousands."""
    commas: bool = False
    """Whether decimal commas were seen."""
    month_first: bool | None = None
    """Of dates such as 03/04/2026, whether the month stands first; None where there are none."""

    def plain(self, cell: str) -> str:
        """Return a number with a decimal point and without marks between thousands; any other cell as it is."""
        if self.month_first:
            cell = SLASHED.sub(r"\3/\1/\2", cell)
        if not self.grouped and "," not in cell and cell.isascii():
            return cell
        text = cell.strip().replace("−", "-")
        if not text or text[0] not in "+-.,0123456789":
            return cell
        match = GROUPED.fullmatch(text)
        if match is not None and self._is_grouped(match):
            whole = match[1] + re.sub(r"\D", "", match[2])
            return whole + (match["rest"] or "").replace(",", ".") + (match["power"] or "")
        return text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else cell

    def _is_grouped(self, match: re.Match[str]) -> bool:
        mark, rest = match["mark"], match["rest"]
        if rest is not None:
            return rest[0] != mark
        several = match[2].count(mark) > 1
        return mark in BLANKS or several or (mark != self.decimal and match[1].lstrip("+-") != "0")


def notation_of(cells: Iterable[str], *, default: str = ".") -> Notation:
    """Return the number notation of some cells: a comma or point that cannot separate thousands is a decimal mark.

    Arguments:
        cells: of a table's first lines.
        default: the decimal mark if the cells do not determine it.
    """
    votes, grouped, cells = {".": 0, ",": 0}, False, [cell.strip() for cell in cells]
    for cell in cells:
        if not cell or not re.fullmatch(rf"[-+−]?[\d.,{BLANKS}]+(?:[eE][-+]?\d+)?", cell):
            continue
        match = GROUPED.fullmatch(cell.replace("−", "-"))
        if match is not None and match["rest"] and match["rest"][0] != match["mark"]:
            votes[match["rest"][0]] += 1
            grouped = True
        elif match is not None and match["mark"] in ".," and match[2].count(match["mark"]) > 1:
            votes["," if match["mark"] == "." else "."] += 1
            grouped = True
        elif match is not None and (match["mark"] in BLANKS or match[1].lstrip("+-") != "0"):
            grouped = grouped or match["mark"] in BLANKS
        elif cell.count(",") + cell.count(".") == 1:
            votes["," if "," in cell else "."] += 1
    if bool(votes["."]) != bool(votes[","]):
        default = "." if votes["."] else ","
        other = re.compile(rf"[-+−]?[1-9]\d{{0,2}}(?:\{',' if default == '.' else '.'}\d{{3}})+")
        grouped = grouped or any(other.fullmatch(cell) for cell in cells)
    return Notation(default, grouped, votes[","] > 0 or (default == "," and any("," in cell for cell in cells)))


def month_stands_first(dates: Iterable[tuple[int, int, int]]) -> bool:
    """Return whether dates (a, b, year), in order of their rows, are month, day, year and not day, month, year.

    The day stands first, unless the calendar has no such date, or the dates then go back or leap farther.
    """
    given = list(dates)

    def leap(days: Iterable[tuple[int, int, int]]) -> float:
        try:
            numbers = [date(year, month, day).toordinal() for day, month, year in days]
        except ValueError:
            return math.inf
        steps = [b - a for a, b in pairwise(numbers)]
        return math.inf if min(steps, default=0) < 0 else max(steps, default=0)

    return leap((b, a, year) for a, b, year in given) < leap(given)


def plain_number(cell: str) -> float | None:
    """Return the number that Python reads in a cell; None where it is none."""
    try:
        return float(cell)
    except ValueError:
        return None


def number_in(cell: str) -> float | None:
    """Return the number in a cell; of a date and time the seconds since 1970 (UTC without a time zone), of a time of day
    the seconds since midnight; None for all else."""
    number = plain_number(cell)
    if number is not None:
        return number
    fortran = FORTRAN.match(cell)
    return float(f"{fortran[1]}e{fortran[2]}") if fortran and fortran[1].strip(" +-.") else moment_in(cell)


def moment_in(cell: str) -> float | None:
    """Return the seconds of a date and time since 1970 (UTC without a time zone), or of a time of day since midnight; else None.

    In 01/02/2024 the day comes first, unless that is not a valid date; tables decide it for all their rows (`month_stands_first`).
    """
    text = cell.strip()
    if DAY.fullmatch(text):
        text += " 00:00:00"
    if ":" not in text and not re.fullmatch(r"\d{8}T\d{4,6}.*", text):
        return None
    clock = CLOCK.fullmatch(text)
    if clock is not None:
        return _time_of_day(*clock.groups())
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        found = _written_date(text)
        if found is None:
            return None
        moment = found
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _time_of_day(hours: str | None, minutes: str, seconds: str, half: str | None) -> float | None:
    """Return seconds since midnight of [HH:]MM:SS[.s] [AM|PM]; HH:MM where there are no seconds is read as MM:SS."""
    hour, rest = int(hours or 0), 60.0 * int(minutes) + float(seconds.replace(",", "."))
    if half is not None:
        if hours is None:
            hour, rest = int(minutes), 60.0 * float(seconds.replace(",", "."))
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + (12 if half[0] in "Pp" else 0)
    return None if rest >= 3600.0 else 3600.0 * hour + rest


def _written_date(text: str) -> datetime | None:
    """Return a date and a time of day in one of the usual forms."""
    text = re.sub(r"(\d),(\d)", r"\1.\2", text).replace(",", " ")
    text = re.sub(r"([AaPp])\.?([Mm])\.?$", r"\1\2", text)
    text = re.sub(r"(\.\d{6})\d+", r"\1", text.replace("T", " "))
    for day, clock in product(DAY_FORMS, CLOCK_FORMS):
        try:
            return datetime.strptime(" ".join(text.split()), f"{day} {clock}")
        except ValueError:
            continue
    return None
