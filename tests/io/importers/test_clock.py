"""Clocks of devices and spreadsheets: counters that wrap, midnight, days, stamps that stand still."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from imported import imported

from femsense.core.errors import InputError
from femsense.core.units import unit_named
from femsense.io.importers.options import Options
from femsense.io.importers.tables.actuation import read_actuation_log
from femsense.io.importers.tables.clock import seconds_of

STEP, COUNT = 0.05, 40
TRUE = STEP * np.arange(COUNT)


def take(path: Path, times: list[str], name: str = "time") -> Path:
    rows = [f"{time},0.1,0.2,{0.9 + 0.001 * k:.4f}" for k, time in enumerate(times)]
    path.write_text("\n".join([f"{name},tip_x_m,tip_y_m,tip_z_m", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("unit", "bits", "start", "said"),
    [("µs", 32, 2**32 - 10**6, "32 bits"), ("ms", 16, 2**16 - 900, "16 bits"), ("µs", 32, 2**31 - 10**6, "32 bits")],
)
def test_a_counter_that_wraps_is_counted_on(unit: str, bits: int, start: int, said: str) -> None:
    known = unit_named(unit)
    assert known is not None
    counts = start + np.rint(TRUE / known.size).astype(np.int64)
    signed = start < 2**31 <= counts[-1] and bits == 32
    read = (counts + 2**31) % 2**32 - 2**31 if signed else counts % 2**bits
    times, notes = seconds_of(read.astype(float), known)
    np.testing.assert_allclose(times - times[0], TRUE, atol=1e-9)
    assert len(notes) == 1 and said in notes[0] and "row" in notes[0]


@pytest.mark.parametrize(("period", "said"), [(86400.0, "midnight"), (43200.0, "twelve hours"), (60.0, "a minute")])
def test_a_time_of_day_goes_on_after_it_begins_again(period: float, said: str) -> None:
    times, notes = seconds_of((period - 1.0 + TRUE) % period, unit_named("s"))
    np.testing.assert_allclose(np.diff(times), STEP, atol=1e-6)
    assert said in notes[0]


def test_a_clock_that_was_set_back_is_no_wrap() -> None:
    read = np.concatenate([TRUE, TRUE])
    times, notes = seconds_of(read, None)
    np.testing.assert_array_equal(times, read)
    assert notes == []


@pytest.mark.parametrize("start", [46110.08332, 0.08332])
def test_days_of_a_spreadsheet_are_read_as_such_and_said(start: float, tmp_path: Path) -> None:
    file = take(tmp_path / "excel.csv", [f"{start + t / 86400.0:.12f}" for t in TRUE])
    recording, found = imported(file, tmp_path)
    np.testing.assert_allclose(recording.time_s, TRUE, atol=1e-5)
    assert found["rate_hz"] == pytest.approx(1.0 / STEP, rel=1e-3)


def test_times_of_day_of_a_log_are_laid_onto_frames_in_another_zone(tmp_path: Path) -> None:
    from femsense.io.importers.guess import open_sources
    from femsense.io.importers.writer import write_recording

    file = take(tmp_path / "take.csv", [f"2026-11-27T08:15:0{t:.3f}" for t in TRUE])
    (tmp_path / "log.csv").write_text("time,cable_a\n" + "".join(f"2026-11-27T10:15:0{t:.3f},{t}\n" for t in TRUE))
    log = read_actuation_log(tmp_path / "log.csv", Options())
    with pytest.raises(InputError, match=r"local time and the other in UTC, 2 hours apart: --offset -7200"):
        write_recording(open_sources([file], Options()), tmp_path / "r", identity={}, actuation="tension", log=log, offset=0.0)


def test_stamps_that_stand_still_are_said_and_a_clock_that_hardly_goes_is_refused(tmp_path: Path) -> None:
    tenths = take(tmp_path / "tenths.csv", [f"{np.floor(t / 0.1 + 1e-6) * 0.1:.1f}" for t in TRUE])
    with pytest.warns(UserWarning, match=r"20 of 40 frames are dropped.*number 2 in the file"):
        recording, _ = imported(tenths, tmp_path)
    assert recording.frame_count == 20
    with pytest.raises(InputError, match="the time does not go on") as error:
        imported(take(tmp_path / "excel.csv", ["1.77500E+12"] * COUNT), tmp_path / "other")
    assert "39 of 40" in str(error.value)


def test_a_log_whose_time_goes_back_says_the_row(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,cable_a\n0,1\n1,2\n1,3\n2,4\n")
    with pytest.raises(InputError, match="time does not increase") as error:
        read_actuation_log(tmp_path / "log.csv", Options())
    assert "row 3" in str(error.value)


@pytest.mark.parametrize(
    "times",
    [
        [f"10:15:{t:06.3f}" for t in TRUE],
        [f"10:15:{t:06.3f} PM" for t in TRUE],
        [f"27.11.2026 10:15:{t:06.3f}" for t in TRUE],
        [f"11/27/2026 10:15:{t:06.3f} AM" for t in TRUE],
        [f"{50 * k}" for k in range(COUNT)],
    ],
    ids=["time of day", "PM", "German", "American", "millis"],
)
def test_times_as_people_write_them(times: list[str], tmp_path: Path) -> None:
    name = "millis" if times[1] == "50" else "time"
    recording, _ = imported(take(tmp_path / "take.csv", times, name), tmp_path)
    np.testing.assert_allclose(recording.time_s, TRUE, atol=1e-6)


def test_a_time_that_is_none_lists_the_times_that_are_read(tmp_path: Path) -> None:
    file = take(tmp_path / "take.csv", ["10:15:00", "10:15:61:07"])
    with pytest.raises(InputError, match=r"times are read as seconds, 10:15:00\.5"):
        imported(file, tmp_path)
