"""Tables as people's programs write them: separators, decimal commas, comments, units, dates, a last line that was cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import marker_grid
from imported import imported

from femsense.core.errors import InputError
from femsense.io.clouds.xyz import read_xyz_columns
from femsense.io.importers.guess import open_source
from femsense.io.importers.options import Options
from femsense.io.importers.tables.actuation import read_actuation_log
from femsense.io.importers.tables.csv_tables import column_unit

TIMES = np.arange(4) * 0.25
PLACES = np.array([[0.1, 0.2, 0.9], [0.11, 0.2, 0.9], [0.12, 0.21, 0.9], [0.13, 0.21, 0.91]])


def table(head: str, *, mark: str = ",", point: str = ".", scale: float = 1.0, first: str = "", times: object = TIMES) -> str:
    rows = [[t if isinstance(t, str) else f"{t:.6f}", *(f"{scale * v:.6f}" for v in p)] for t, p in zip(times, PLACES)]
    lines = [mark.join(cell.replace(".", point) if point != "." else cell for cell in row) for row in rows]
    return first + "\n".join([head.replace(",", mark), *lines]) + "\n"


HEAD = "time,tip_x,tip_y,tip_z"
MM = 1000.0
TABLES = {
    "semicolons and decimal commas": table(HEAD, mark=";", point=","),
    "tabs and decimal commas": table(HEAD, mark="\t", point=","),
    "comments before it": table(HEAD, first="# logged by hand\n# 3 markers, 1 robot\n"),
    "names in a comment": "# " + table(HEAD),
    "units in brackets": table("Time [ms],tip_x [mm],tip_y [mm],tip_z [mm]", scale=MM, times=1000 * TIMES),
    "units behind the names": table("t_s,tip_x_mm,tip_y_mm,tip_z_mm", scale=MM),
    "units before the axes": table("time,tip_mm_x,tip_mm_y,tip_mm_z", scale=MM),
    "units in capitals": table("TIME [MS],tip_x [MM],tip_y [MM],tip_z [MM]", scale=MM, times=1000 * TIMES).replace(
        "[MM]", "[Mm]"
    ),
    "units in a row of their own": table(HEAD + "\ns,mm,mm,mm", scale=MM),
    "microseconds since 1970": table(HEAD, times=[f"{1.7e15 + 1e6 * t:.0f}" for t in TIMES]),
    "dates": table(HEAD, times=[f"2024-01-02T03:04:{5 + t:09.6f}" for t in TIMES]),
    "a last line that was cut off": table(HEAD) + "1.0,0.13,0.2",
}


@pytest.mark.parametrize("name", list(TABLES))
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.filterwarnings("ignore:.*cut off")
def test_tables(name: str, encoding: str, tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(TABLES[name], encoding=encoding)
    unit = None if "mm" in TABLES[name].lower() else "m"
    recording, _ = imported(tmp_path / "take.csv", tmp_path, Options(unit=unit))
    np.testing.assert_allclose(np.asarray(recording.time_s), TIMES, atol=1e-6)
    np.testing.assert_allclose(marker_grid(recording)[:, 0], PLACES, atol=1e-9)


def test_places_in_several_units_are_refused(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(table("time,tip_x_mm,tip_y_m,tip_z_m"))
    with pytest.raises(InputError, match="several units"):
        imported(tmp_path / "take.csv", tmp_path)


def test_units_of_inputs(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time_ms,cable_north [mm],chamber_a_kPa,cable_arm_n\n0,5,20,1\n1000,6,30,2\n")
    log = read_actuation_log(tmp_path / "log.csv", Options())
    assert log.columns == ("cable_north", "chamber_a", "cable_arm_n") and log.actuation == "displacement"
    np.testing.assert_allclose(log.values, [[5e-3, 20e3, 1], [6e-3, 30e3, 2]])
    np.testing.assert_allclose(log.time_s, [0, 1])
    assert column_unit("x_in") == ("x_in", None)  # an input, and no inch


def test_a_broken_line_within_a_table_is_no_cut(tmp_path: Path) -> None:
    lines = table(HEAD).splitlines()
    lines[2] = lines[2][:12]
    (tmp_path / "take.csv").write_text("\n".join(lines))
    with pytest.raises(InputError, match="line 3"):
        imported(tmp_path / "take.csv", tmp_path, Options(unit="m"))


@pytest.mark.parametrize("mark", [";", "\t", " "])
def test_points_with_decimal_commas(mark: str, tmp_path: Path) -> None:
    text = "\n".join(mark.join(f"{v:.6f}".replace(".", ",") for v in p) for p in PLACES)
    (tmp_path / "a.xyz").write_text(text + "\n")
    columns = read_xyz_columns(tmp_path / "a.xyz")
    np.testing.assert_allclose(np.stack([columns[a] for a in "xyz"], axis=1), PLACES)


def test_two_subjects_with_markers_of_the_same_name(tmp_path: Path) -> None:
    rows = "".join(f"{k + 1},0,{k},2,3,100,200,{300 + k}\n" for k in range(3))
    head = "Trajectories\n100\n,,arm:tip,,,hand:tip,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n"
    (tmp_path / "take.csv").write_text(head + rows)
    recording, _ = imported(tmp_path / "take.csv", tmp_path)
    grid = dict(zip(recording.marker_names, marker_grid(recording).transpose(1, 0, 2)))
    np.testing.assert_allclose(grid["arm:tip"][2], [0.002, 0.002, 0.003])
    np.testing.assert_allclose(grid["hand:tip"][2], [0.1, 0.2, 0.302])


@pytest.mark.filterwarnings("error:.*cut off")
def test_a_motion_capture_that_was_cut_off_says_so(tmp_path: Path) -> None:
    head = "Trajectories\n100\n,,a,,,b,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n"
    (tmp_path / "take.csv").write_text(head + "1,0,1,2,3,4,5,6\n2,0,1,2,3,4,5,7\n3,0,1,2,3,4,5")
    with pytest.warns(UserWarning, match="cut off"):
        recording, _ = imported(tmp_path / "take.csv", tmp_path)
    assert recording.frame_count == 2


# Numbers and units as people write them


def written(scale: float, form: str, mark: str, head: str = "time,tip_x_mm,tip_y_mm,tip_z_mm") -> str:
    """Return the table with marks between thousands: form is what stands between thousands, and the decimal mark."""

    def cell(value: float) -> str:
        text = f"{scale * value:,.1f}".replace(",", "!").replace(".", form[1]).replace("!", form[0])
        return f'"{text}"' if mark == "," and "," in text else text

    rows = [mark.join([f"{t:.2f}".replace(".", form[1]), *map(cell, p)]) for t, p in zip(TIMES, PLACES)]
    return "\n".join([head.replace(",", mark), *rows]) + "\n"


@pytest.mark.parametrize(("form", "mark"), [(".,", ";"), (",.", ","), ("’.", "\t"), ("\u00a0,", ";"), (" ,", "\t"), (",.", "\t")])
def test_marks_between_thousands_are_read_and_noted(form: str, mark: str, tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(written(5e3, form, mark))
    recording, _ = imported(tmp_path / "take.csv", tmp_path)
    np.testing.assert_allclose(marker_grid(recording)[:, 0], 5.0 * PLACES, atol=1e-4)
    notes = " ".join(open_source(tmp_path / "take.csv").notes)
    assert "thousands separators" in notes and ("decimal commas" in notes) == (form[1] == ",")


def test_decimal_commas_between_commas_are_refused_by_name(tmp_path: Path) -> None:
    rows = "\n".join(f"{k},0,{k}1,0,2{k},0,9" for k in range(3))
    (tmp_path / "take.csv").write_text(f"time,tip_x,tip_y,tip_z\n{rows}\n")
    with pytest.raises(InputError, match="decimal commas between commas"):
        imported(tmp_path / "take.csv", tmp_path, Options(unit="m"))


@pytest.mark.parametrize(
    ("name", "value", "pascals", "absolute"),
    [
        ("chamber_a [KPA]", 20.0, 20e3, False),
        ("chamber_a_barg", 0.2, 20e3, False),
        ("chamber_a (bar(a))", 1.21325, 20e3, True),
        ("chamber_a [psia]", 14.695949, 0.0, True),
        ("chamber_a_mbar", 200.0, 20e3, False),
    ],
)
def test_pressures_in_any_unit_gauge_or_absolute(name: str, value: float, pascals: float, absolute: bool, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(f"time,{name}\n0,{value}\n1,{value}\n")
    log = read_actuation_log(tmp_path / "log.csv", Options())
    assert log.columns == ("chamber_a",)
    np.testing.assert_allclose(log.values, pascals, atol=0.2)
    assert any("101325 Pa are subtracted" in note for note in log.notes) == absolute


@pytest.mark.parametrize("name", ["cable_a_ticks", "cable_a [mA]", "cable_a_rad", "cable_a [V]"])
def test_what_motors_count_is_no_tension_and_no_length(name: str, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(f"time,{name}\n0,1\n1,2\n")
    with pytest.raises(InputError, match="a unit that is not the input's") as error:
        read_actuation_log(tmp_path / "log.csv", Options())
    assert f"--map '{name}=cable_a*FACTOR'" in str(error.value)
    log = read_actuation_log(tmp_path / "log.csv", Options(columns={name: "cable_a*0.5"}))
    np.testing.assert_allclose(log.values[:, 0], [0.5, 1.0])


@pytest.mark.parametrize(
    ("target", "pascals"), [("chamber_a*bar", 2e5), ("chamber_a*1e5-101325", 98675.0), ("chamber_a*bara", 98675.0)]
)
def test_a_unit_or_an_offset_in_a_mapping(target: str, pascals: float, tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,p\n0,2\n1,2\n")
    log = read_actuation_log(tmp_path / "log.csv", Options(columns={"p": target}))
    np.testing.assert_allclose(log.values[:, 0], pascals, rtol=1e-9)


def test_a_unit_that_nobody_says_is_noted(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,chamber_a\n0,2\n1,2\n")
    assert any("no unit for chamber_a: taken as Pa" in note for note in read_actuation_log(tmp_path / "log.csv", Options()).notes)


def test_dates_and_times_in_two_columns(tmp_path: Path) -> None:
    rows = "".join(f"27.11.2026,10:15:0{t:.2f},{p[0]},{p[1]},{p[2]}\n" for t, p in zip(TIMES, PLACES))
    (tmp_path / "take.csv").write_text("Date,Time,tip_x_m,tip_y_m,tip_z_m\n" + rows)
    recording, _ = imported(tmp_path / "take.csv", tmp_path)
    np.testing.assert_allclose(recording.time_s, TIMES, atol=1e-6)


@pytest.mark.parametrize(
    ("days", "order"), [(("03/04/2026", "03/05/2026"), "month/day"), (("03/04/2026", "04/04/2026"), "day/month")]
)
def test_dates_with_slashes_have_one_order_in_all_rows(days: tuple[str, str], order: str, tmp_path: Path) -> None:
    clock = [f"{days[0]} 23:59:58", f"{days[0]} 23:59:59", f"{days[1]} 00:00:00", f"{days[1]} 00:00:01"]
    rows = "".join(f"{time},0.1,0.2,0.{k}\n" for k, time in enumerate(clock))
    (tmp_path / "take.csv").write_text(f"time,tip_x_m,tip_y_m,tip_z_m\n{rows}")
    recording, _ = imported(tmp_path / "take.csv", tmp_path)
    np.testing.assert_allclose(np.diff(recording.time_s), 1.0)
    assert any(f"read as {order}/year" in note for note in open_source(tmp_path / "take.csv").notes)
