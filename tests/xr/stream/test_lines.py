"""Lines of sensors as firmware writes them: decimal commas between semicolons, and a comma that could be either."""

from __future__ import annotations

import math
from functools import partial
from threading import Event

import numpy as np
import pytest

from femsense.xr.stream.readings import Readings, read_line


@pytest.mark.parametrize(
    ("line", "channels", "time", "values"),
    [
        (b"0,512;0,25\r\n", ["a", "b"], math.nan, [0.512, 0.25]),
        (b"1,5;0,512;0,25", ["a", "b"], 1.5, [0.512, 0.25]),
        (b"0,512\t0,25", ["a", "b"], math.nan, [0.512, 0.25]),
        (b"1.5,0.512", ["a"], 1.5, [0.512]),
        (b"512,3", ["a", "b"], math.nan, [512.0, 3.0]),
        (b"0.512", ["a"], math.nan, [0.512]),
    ],
)
def test_numbers_of_a_line(line: bytes, channels: list[str], time: float, values: list[float]) -> None:
    reading = read_line(line, channels)
    assert reading is not None
    np.testing.assert_equal(reading[0], time)
    np.testing.assert_allclose(reading[1], values)


def test_a_decimal_comma_is_not_taken_for_a_time_and_a_value() -> None:
    assert read_line(b"0,512", ["a"]) is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"0,512\r\n", "'0,512' is read as two values, 0 and 512; with a decimal comma, write semicolons between numbers"),
        (b"0.1,2", ""),
    ],
)
def test_how_a_comma_between_two_channels_is_read_is_said(line: bytes, said: str) -> None:
    readings = Readings(partial(read_line, channels=["a", "b"]), Event())
    readings.hear(line)
    assert readings.assumed == said
