"""Numbers, dates and times of day as text: decimal commas, marks between thousands, the forms of several countries."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from femsense.io.text_numbers import moment_in, month_stands_first, notation_of, number_in

DAY = datetime(2026, 11, 27, tzinfo=UTC).timestamp()
MORNING, EVENING = 10 * 3600.0 + 15 * 60.0, 22 * 3600.0 + 15 * 60.0


@pytest.mark.parametrize(
    ("cells", "default", "plain"),
    [
        (["0,5", "1.234,5", "1.234"], ".", ["0.5", "1234.5", "1234"]),
        (["0.5", "1,234.5", "1,234"], ",", ["0.5", "1234.5", "1234"]),
        (["1’234.5", "0.5"], ".", ["1234.5", "0.5"]),
        (["1\u00a0234,5"], ".", ["1234.5"]),
        (["1.234.567"], ".", ["1234567"]),
        (["1.234,5", "1,234"], ".", ["1234.5", "1.234"]),
        (["0,512"], ".", ["0.512"]),
        (["1,234"], ",", ["1.234"]),
        (["−3,5e-3"], ",", ["-3.5e-3"]),
        (["north", "0,5"], ",", ["north", "0.5"]),
        (["0,5", "12.345"], ".", ["0.5", "12345"]),
        (["0,5", "0.25", "12.345"], ",", ["0.5", "0.25", "12.345"]),
        (["12.345", "1.250"], ",", ["12.345", "1.250"]),
    ],
)
def test_marks_within_numbers(cells: list[str], default: str, plain: list[str]) -> None:
    notation = notation_of(cells, default=default)
    assert [notation.plain(cell) for cell in cells] == plain


@pytest.mark.parametrize(
    ("cell", "seconds"),
    [
        ("10:15:00.5", MORNING + 0.5),
        ("10:15:00,5", MORNING + 0.5),
        ("10:15:00 PM", EVENING),
        ("12:00:01 a.m.", 1.0),
        ("00:05.25", 5.25),
        ("27.11.2026 10:15:00.5", DAY + MORNING + 0.5),
        ("27.11.2026 10:15:00,5", DAY + MORNING + 0.5),
        ("11/27/2026 10:15:00 PM", DAY + EVENING),
        ("27-Nov-2026 10:15:00", DAY + MORNING),
        ("20261127T101500", DAY + MORNING),
        ("2026-11-27T10:15:00+02:00", DAY + MORNING - 7200.0),
        ("27.11.2026", DAY),
        (" 1.5D+01", 15.0),
    ],
)
def test_dates_and_times_of_day(cell: str, seconds: float) -> None:
    assert number_in(cell) == pytest.approx(seconds)


@pytest.mark.parametrize("cell", ["a:b", "99:99", "13:00:00 PM", "31.31.2026 10:00:00", "1.2.3"])
def test_what_is_no_time(cell: str) -> None:
    assert moment_in(cell) is None


@pytest.mark.parametrize(
    ("dates", "month"),
    [
        ([(3, 4, 2026), (3, 5, 2026)], True),
        ([(3, 12, 2026), (3, 13, 2026)], True),
        ([(3, 4, 2026), (4, 4, 2026)], False),
        ([(30, 4, 2026), (1, 5, 2026)], False),
        ([(3, 4, 2026), (3, 4, 2026)], False),
        ([(12, 31, 2025), (1, 1, 2026)], True),
        ([], False),
    ],
)
def test_the_order_of_day_and_month_is_that_of_all_rows(dates: list[tuple[int, int, int]], month: bool) -> None:
    assert month_stands_first(dates) is month
