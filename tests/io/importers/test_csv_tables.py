"""Tables as people's programs write them: separators, decimal commas, comments, units, dates, a last line that was cut off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from imported import imported

from femsense.core.errors import InputError
from femsense.io.clouds.xyz import read_xyz_columns
from femsense.io.importers.actuation import read_actuation_log
from femsense.io.importers.csv_tables import column_unit
from femsense.io.importers.frames import Options
from femsense.model.recording import marker_grid

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
    unit = None if "mm" in TABLES[name] else "m"
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
