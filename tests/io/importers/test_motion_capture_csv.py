"""CSV of motion capture: exports of Motive and Nexus, raw columns, mappings, and a log of actuation on another clock."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers import DATA, marker_grid

from femsense.core.errors import InputError
from femsense.io.importers.guess import guess_format, open_source
from femsense.io.importers.options import Axis, Options
from femsense.io.importers.tables.actuation import read_actuation_log
from femsense.io.importers.writer import write_recording
from femsense.io.recording_folder import load_recording
from femsense.model.recording import Recording

MOTIVE = """Format Version,1.23,Take Name,Take 7,Take Notes,,Capture Frame Rate,120.000000,Export Frame Rate,120.000000,Capture Start Time,2024-05-01 10.00.00.000 AM,Total Frames in Take,4,Total Exported Frames,4,Rotation Type,Quaternion,Length Units,{unit},Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,Marker,Marker,Marker,Marker,Marker,Marker
,Name,base,base,base,base,base,base,base,base,base:Marker1,base:Marker1,base:Marker1,base:Marker1,tip,tip,tip,Unlabeled 2041,Unlabeled 2041,Unlabeled 2041
,ID,1,1,1,1,1,1,1,1,2,2,2,2,3,3,3,4,4,4
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,Position,Position,Marker Quality,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,,X,Y,Z,X,Y,Z
0,0.000000,0,0,0,1,10,20,30,0.1,11,21,31,1.0,1,2,3,7,8,9
1,0.008333,0,0,0,1,10,20,30,0.1,11,21,31,1.0,,,,7,8,9
2,0.016667,0,0,0,1,10,20,30,0.1,,,,,1,2,5,7,8,9
3,0.025000,,,,,,,,,,,,,,,,7,8,9
"""  # noqa: E501
NEXUS = """Trajectories
100
,,arm:base,,,arm:tip,,,*22,,
Frame,Sub Frame,X,Y,Z,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm,mm,mm,mm
11,0,1,2,3,100,200,300,5,5,5
12,0,1,2,3,,,,5,5,5
13,0,1,2,3,100,200,310,,,

Model Outputs
100
,,arm:Angle,,
Frame,Sub Frame,X,Y,Z
,,deg,deg,deg
11,0,1,2,3
"""


def imported(path: Path, folder: Path, options: Options | None = None, **more: object) -> tuple[Recording, dict]:
    found = write_recording(open_source(path, options), folder, identity={"test": str(path)}, **more)
    return load_recording(folder), found


@pytest.mark.parametrize(("unit", "scale"), [("Meters", 1.0), ("Millimeters", 1e-3), ("Centimeters", 1e-2)])
def test_motive(unit: str, scale: float, tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(MOTIVE.format(unit=unit), encoding="utf-8-sig")
    assert guess_format(tmp_path / "take.csv") == "optitrack"
    recording, found = imported(tmp_path / "take.csv", tmp_path / "out", Options(columns={"base:Marker1": "marker.a"}))
    assert set(recording.marker_names) == {"base", "a", "tip"}
    grid = dict(zip(recording.marker_names, marker_grid(recording).transpose(1, 0, 2)))
    np.testing.assert_allclose(grid["base"][:3], np.tile([10, 20, 30], (3, 1)) * scale)
    np.testing.assert_allclose(grid["a"][:2], np.tile([11, 21, 31], (2, 1)) * scale)
    np.testing.assert_allclose(grid["tip"][[0, 2]], np.array([[1, 2, 3], [1, 2, 5]]) * scale)
    assert np.isnan(grid["tip"][1]).all()
    np.testing.assert_allclose(recording.time_s, [0, 0.008333, 0.016667, 0.025])
    assert found["unit"] == unit
    assert len(recording.unnamed_xyz) == 1  # only where a frame has no named marker


def test_motive_turned_upright(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(MOTIVE.format(unit="Meters"))
    recording, _ = imported(tmp_path / "take.csv", tmp_path / "out", Options(up=Axis.y, topics=["tip"]))
    np.testing.assert_allclose(recording.marker_xyz[0], [1, -3, 2])


def test_nexus(tmp_path: Path) -> None:
    (tmp_path / "trial.csv").write_text(NEXUS)
    assert guess_format(tmp_path / "trial.csv") == "vicon"
    recording, found = imported(tmp_path / "trial.csv", tmp_path / "out")
    assert recording.marker_names == ("base", "tip") and recording.frame_count == 3
    np.testing.assert_allclose(marker_grid(recording)[:, 1], [[0.1, 0.2, 0.3], [np.nan] * 3, [0.1, 0.2, 0.31]])
    np.testing.assert_allclose(recording.time_s, [0, 0.01, 0.02])
    assert found["missing"] == [{"marker": "tip", "share": pytest.approx(1 / 3)}]


def test_a_marker_of_nexus_may_be_mapped_with_its_subject(tmp_path: Path) -> None:
    (tmp_path / "trial.csv").write_text(NEXUS)
    recording, _ = imported(tmp_path / "trial.csv", tmp_path / "out", Options(columns={"arm:tip": "marker.end"}))
    assert recording.marker_names == ("base", "end")


def test_a_table_of_markers_in_another_unit_is_warned_of(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time_s,tip_x,tip_y,tip_z,mid_x,mid_y,mid_z\n0,0,0,500,0,120,500\n0.1,0,0,501,0,120,501\n")
    with pytest.warns(UserWarning, match="the scene is 120 m across"):
        open_source(tmp_path / "a.csv", Options(unit="m"))


def test_sections_before_the_trajectories_are_passed_over(tmp_path: Path) -> None:
    devices = "1000\n,,Force 1,,,Force 2,,\nFrame,Sub Frame,Fx,Fy,Fz,Fx,Fy,Fz\n,,N,N,N,N,N,N\n11,0,1,2,3,4,5,6\n\n"
    (tmp_path / "trial.csv").write_text(f"Joints\n{devices}Devices\n{devices}{NEXUS}")
    assert guess_format(tmp_path / "trial.csv") == "vicon"
    recording, _ = imported(tmp_path / "trial.csv", tmp_path / "out")
    assert recording.marker_names == ("base", "tip") and recording.frame_count == 3


def test_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    text = MOTIVE.format(unit="Meters").replace("1,2,5,7", "1.25,2,5,7")
    (tmp_path / "take.csv").write_text(text.replace(",", ";").replace(".", ","))
    recording, _ = imported(tmp_path / "take.csv", tmp_path / "out", Options(topics=["tip"]))
    np.testing.assert_allclose(recording.marker_xyz, [[1, 2, 3], [1.25, 2, 5]])
    np.testing.assert_allclose(recording.time_s, [0, 0.008333, 0.016667, 0.025])


def test_a_rate_that_is_not_readable_is_asked(tmp_path: Path) -> None:
    (tmp_path / "trial.csv").write_text(NEXUS.replace("\n100\n", "\n1o0\n", 1))
    with pytest.raises(InputError, match="--rate"):
        open_source(tmp_path / "trial.csv")
    recording, _ = imported(tmp_path / "trial.csv", tmp_path / "out", Options(rate=50.0))
    np.testing.assert_allclose(recording.time_s, [0, 0.02, 0.04])


def test_a_header_by_mapping_names_and_units(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t;px;py;pz;motor\n0;1;2;3;4\n0.1;1;2;;5\n")
    mapping = {"px": "tip.x", "py": "tip.y", "pz": "tip.z", "motor": "cable_north*0.5"}
    with pytest.raises(InputError, match="--unit"):
        open_source(tmp_path / "a.csv", Options(columns=mapping))
    recording, _ = imported(tmp_path / "a.csv", tmp_path / "out", Options(columns=mapping, unit="mm"), actuation="tension")
    np.testing.assert_allclose(marker_grid(recording)[:, 0], [[0.001, 0.002, 0.003], [np.nan] * 3])
    np.testing.assert_allclose(recording.inputs[:, 0], [2.0, 2.5])
    with pytest.raises(InputError, match="a name that the source does not have") as caught:
        open_source(tmp_path / "a.csv", Options(columns={"mtor": "cable_a"}, unit="m"))
    assert "motor" in str(caught.value)


@pytest.mark.parametrize(
    "header",
    ["time,tip_x,tip_y,tip_z,q_x,q_y,q_z", "time_ms,tip.x,tip.y,tip.z", "Timestamp,tip:X,tip:Y,tip:Z", "time,xtip,ytip,ztip"],
)
def test_names_of_axes(header: str, tmp_path: Path) -> None:
    cells = len(header.split(","))
    rows = [",".join(str(v) for v in [100 * k, 1, 2, 3, 9, 9, 9][:cells]) for k in range(2)]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    recording, _ = imported(tmp_path / "a.csv", tmp_path / "out", Options(unit="m"))
    assert recording.marker_names == ("tip",)
    assert recording.time_s[1] == pytest.approx(0.1 if "ms" in header else 100)


@pytest.mark.skipif(not (DATA / "tentacle").is_dir(), reason="the real data are not there")
def test_raw_motion_capture_without_names(tmp_path: Path) -> None:
    file = DATA / "tentacle" / "m1_u015.csv"
    recording, found = imported(file, tmp_path / "out", Options(unit="m"))
    table = np.loadtxt(file, delimiter=",")
    assert recording.frame_count == len(table) and found["unlabelled_markers"] == 5 and not recording.marker_names
    np.testing.assert_allclose(recording.unnamed_xyz.reshape(-1, 15), table[:, 2:], atol=1e-12)
    np.testing.assert_allclose(recording.time_s, table[:, 1] - table[0, 1], atol=1e-9)


@pytest.mark.skipif(not (DATA / "trunk").is_dir(), reason="the real data are not there")
def test_observations_and_commands_of_a_trunk(tmp_path: Path) -> None:
    """No times in the file; the motors' angles are an actuation by a radius that a person says."""
    file = DATA / "trunk" / "observations_controlled_1.csv.gz"
    with pytest.raises(InputError, match="--rate"):
        open_source(file, Options(unit="m"))
    columns = {f"phi{i}": f"cable_m{i}*0.0002" for i in range(1, 7)}
    columns |= {f"{axis}{i}": f"disc{i}.{axis}" for i in (1, 2, 3) for axis in "xyz"}
    recording, found = imported(
        file, tmp_path / "out", Options(unit="m", rate=100.0, up=Axis.y, columns=columns), actuation="displacement"
    )
    with gzip.open(file, "rt") as stream:
        names = stream.readline().strip().split(",")
        table = np.loadtxt(stream, delimiter=",")
    assert recording.frame_count == len(table) == 15_001 and recording.marker_names == ("disc1", "disc2", "disc3")
    y = table[:, [names.index(f"y{i}") for i in (1, 2, 3)]]
    np.testing.assert_allclose(marker_grid(recording)[:, :, 2], y, atol=1e-12)
    np.testing.assert_allclose(recording.inputs[:, 3], 2e-4 * table[:, names.index("phi4")], atol=1e-12)
    assert recording.actuation_zero == "unknown" and found["rate_hz"] == pytest.approx(100)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("time,a,b\n0,1,2\n", "nothing that can be taken"),
        ("time,tip_x,tip_y,tip_z\n0,1,2,x\n", "not a row of numbers"),
        ("time,tip_x,tip_y,tip_z\n0,1\n", "not a row of numbers"),
        ("tip_x,tip_y,tip_z\n1,2,3\n", "no column of time"),
        ("Format Version,1.23\nnothing\n", "without its header"),
        ("Trajectories\n", "without trajectories"),
    ],
)
def test_broken_tables(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        write_recording(open_source(tmp_path / "a.csv", Options(unit="m")), tmp_path / "out", identity={})


def test_a_compressed_table_that_is_cut_off(tmp_path: Path) -> None:
    rows = "\n".join(f"{0.01 * k},{k},2,{k % 7}" for k in range(50_000))
    data = gzip.compress(f"time,tip_x,tip_y,tip_z\n{rows}\n".encode())
    (tmp_path / "a.csv.gz").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="broken compressed file"):
        write_recording(open_source(tmp_path / "a.csv.gz", Options(unit="mm")), tmp_path / "out", identity={})


# A log of actuation


def moving_tip(path: Path, times: Sequence[float]) -> Path:
    """Write a marker that follows the input, 100 frames a second."""
    rows = [f"{t},{0.02 * drive(t)},0,1" for t in times]
    path.write_text("\n".join(["time,tip_x,tip_y,tip_z", *rows]))
    return path


def drive(t: float) -> float:
    """Steps of different lengths and heights."""
    edges = np.cumsum([0.7, 1.1, 0.4, 1.6, 0.9, 1.3, 0.5, 2.0])
    return float([0.0, 1.0, 0.3, 0.8, 0.0, 1.0, 0.5, 0.9, 0.2][int(np.searchsorted(edges, t))])


def log_file(path: Path, shift: float) -> Path:
    times = np.arange(0, 10, 0.02)
    path.write_text("\n".join(["time_s,cable_north", *(f"{t - shift},{2 * drive(t)}" for t in times)]))
    return path


@pytest.mark.parametrize("shift", [0.0, 1234.5, -3.17])
def test_the_offset_of_a_log_from_motion(shift: float, tmp_path: Path) -> None:
    moving = moving_tip(tmp_path / "a.csv", np.arange(1, 9, 0.01).tolist())
    log = read_actuation_log(log_file(tmp_path / "log.csv", shift), Options())
    recording, found = imported(moving, tmp_path / "out", Options(unit="m"), log=log, actuation="tension")
    assert found["actuation_offset_s"] == pytest.approx(shift, abs=0.03)
    assert found["actuation_correlation"] > 0.6
    wanted = np.array([2 * drive(t + 1) for t in recording.time_s])
    assert np.median(np.abs(recording.inputs[:, 0] - wanted)) < 1e-9
    assert np.mean(np.abs(recording.inputs[:, 0] - wanted) > 1e-6) < 0.05


def test_markers_that_come_and_go_do_not_hide_the_motion(tmp_path: Path) -> None:
    """Their middle jumps by decimetres then."""
    rng, rows = np.random.default_rng(0), []
    for t in np.arange(1, 9, 0.01):
        gap = rng.random() < 0.2
        rows.append(f"{t},{0.02 * drive(t)},0,1," + (",," if gap else f"{0.01 * drive(t)},0.4,1"))
    (tmp_path / "a.csv").write_text("\n".join(["time,tip_x,tip_y,tip_z,mid_x,mid_y,mid_z", *rows]))
    log = read_actuation_log(log_file(tmp_path / "log.csv", 3.17), Options())
    _, found = imported(tmp_path / "a.csv", tmp_path / "out", Options(unit="m"), log=log, actuation="tension")
    assert found["actuation_offset_s"] == pytest.approx(3.17, abs=0.03)


def test_an_offset_that_is_given(tmp_path: Path) -> None:
    moving = moving_tip(tmp_path / "a.csv", np.arange(1, 9, 0.01).tolist())
    log = read_actuation_log(log_file(tmp_path / "log.csv", 50.0), Options())
    recording, found = imported(moving, tmp_path / "out", Options(unit="m"), log=log, offset=50.0, actuation="tension")
    assert found["actuation_offset_s"] == 50.0 and found["frames_beyond_log"] == 0
    assert recording.inputs[40, 0] == pytest.approx(2 * drive(1.4))
    with pytest.raises(InputError, match="do not overlap"):
        imported(moving, tmp_path / "far", Options(unit="m"), log=log, offset=0.0, actuation="tension")


@pytest.mark.parametrize("seed", [0, 1, 6, 26])
def test_a_short_recording_that_correlates_by_chance_tells_no_offset(seed: int, tmp_path: Path) -> None:
    """A random walk, and ramps of few speeds: some of these correlate by 0.7 to 0.9."""
    rng = np.random.default_rng(seed)
    rows = [f"{5 + 0.5 * k},{x},0,1" for k, x in enumerate(0.001 * rng.normal(size=22).cumsum())]
    (tmp_path / "a.csv").write_text("\n".join(["time,tip_x,tip_y,tip_z", *rows]))
    ramps = [*(2 - abs((k % 6) - 3) * 2 / 3 for k in range(13)), 0.2, 0.4, 0.6, 0.6, 0.6, 0.6, 0.4, 0.2, 0.0]
    (tmp_path / "log.csv").write_text("\n".join(["time,cable_a", *(f"{100 + 0.5 * k},{v}" for k, v in enumerate(ramps))]))
    log = read_actuation_log(tmp_path / "log.csv", Options())
    with pytest.raises(InputError, match="does not determine the offset"):
        imported(tmp_path / "a.csv", tmp_path / "out", Options(unit="m"), log=log, actuation="tension")


@pytest.mark.parametrize("motion", [0.0, 0.02])
def test_motion_that_tells_no_offset_is_said(motion: float, tmp_path: Path) -> None:
    """Noise alone; and 5 mm of noise on 20 mm of motion, whose best correlation is right and only 0.45."""
    rng = np.random.default_rng(0)
    rows = [f"{1 + 0.01 * k},{motion * drive(1 + 0.01 * k) + x},0,1" for k, x in enumerate(rng.normal(size=800) * 0.005)]
    (tmp_path / "a.csv").write_text("\n".join(["time,tip_x,tip_y,tip_z", *rows]))
    log = read_actuation_log(log_file(tmp_path / "log.csv", 0.0), Options())
    with pytest.raises(InputError, match="does not determine the offset") as caught:
        imported(tmp_path / "a.csv", tmp_path / "out", Options(unit="m"), log=log, actuation="tension")
    assert "--offset" in str(caught.value)


def test_a_log_that_does_not_overlap_says_its_own_times(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text("time,cable_a\n100,1\n101,2\n")
    (tmp_path / "take.csv").write_text("time,tip_x_m,tip_y_m,tip_z_m\n5,0,0,1\n6,0,0,1\n")
    log = read_actuation_log(tmp_path / "log.csv", Options())
    with pytest.raises(InputError, match=r"log 100\.000 … 101\.000 s, frames 5\.000 … 6\.000 s, offset 7 s") as caught:
        imported(tmp_path / "take.csv", tmp_path / "out", log=log, offset=7.0, actuation="tension")
    assert "--offset -95.000" in str(caught.value)


def test_a_binary_file_is_no_log(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_bytes(b"\x7fELF\x02\x01\x01" + bytes(100) + b"a,b\n")
    with pytest.raises(InputError, match="no text") as caught:
        read_actuation_log(tmp_path / "log.csv", Options())
    assert "\0" not in str(caught.value)


def test_tracks_without_a_name_beside_named_ones_are_said_to_be_left_out(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(MOTIVE.format(unit="Meters"))
    source = open_source(tmp_path / "take.csv", Options(rate=50.0))
    assert any("left out of frames that show named markers" in note for note in source.notes)
    assert any("--rate has no effect" in note for note in source.notes)
