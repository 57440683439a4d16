"""What a file says of itself is compared with what is read: counts, groups, padding, viewpoints, bit depths."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import marker_grid
from imported import imported
from ros_writers import START_NS, STEP_NS, BagWriter, depth_of

from femsense.core.errors import InputError
from femsense.io.clouds.cloud_files import read_cloud, viewpoint_doubt
from femsense.io.clouds.ply import read_ply_vertices
from femsense.io.clouds.xyz import read_xyz_columns
from femsense.io.importers.guess import contents, guess_format, open_source
from femsense.io.importers.options import Options

# C3D


def text_parameter(group: int, name: str, texts: list[bytes]) -> bytes:
    width = max(map(len, texts))
    data = b"".join(text.ljust(width, b"\0") for text in texts)
    body = struct.pack("<bB", -1, 2) + bytes([width, len(texts)]) + data + b"\0"
    return struct.pack("<bb", len(name), group) + name.encode() + struct.pack("<h", len(body) + 2) + body


def write_c3d(
    path: Path, labels: list[bytes], frames: np.ndarray, *, unit: bytes = b"mm\0\0", more: bytes = b"", used: int = 0
) -> Path:
    """Write floats (frames, points, 3) of 100 frames a second, texts padded with NUL."""
    group = struct.pack("<bb", 5, -1) + b"POINT" + struct.pack("<h", 3) + b"\0"
    number = struct.pack("<bb", 4, 1) + b"USED" + struct.pack("<hbBh", 7, 2, 0, used) + b"\0" if used else b""
    parameters = b"\x01\x50" + bytes([4, 84]) + group + text_parameter(1, "LABELS", labels) + text_parameter(1, "UNITS", [unit])
    parameters += number + more + b"\0\0"
    points = len(labels)
    head = struct.pack("<BBHHHHHfHHf", 2, 0x50, points, 0, 1, len(frames), 0, -1.0, 6, 0, 100.0)
    rows = np.concatenate([frames, np.zeros((*frames.shape[:2], 1))], axis=2).astype("<f4")
    path.write_bytes(head.ljust(512, b"\0") + parameters.ljust(4 * 512, b"\0") + rows.tobytes())
    return path


def places(points: int, count: int = 5) -> np.ndarray:
    return 100.0 * np.arange(1, points + 1)[None, :, None] + np.arange(count)[:, None, None] + np.arange(3.0)


def test_texts_of_c3d_are_padded_with_nul_or_blanks(tmp_path: Path) -> None:
    file = write_c3d(tmp_path / "a.c3d", [b"tip\0\0", b"left "], places(2))
    recording, found = imported(file, tmp_path)
    assert found["unit"] == "mm" and recording.marker_names == ("tip", "left")
    np.testing.assert_allclose(marker_grid(recording)[0, 0], [0.1, 0.101, 0.102], atol=1e-7)


@pytest.mark.parametrize("group", ["ANGLES", "FORCES", "MY_RESULTS"])
def test_results_of_a_model_are_no_places(group: str, tmp_path: Path) -> None:
    more = text_parameter(1, group, [b"TipAngles"])
    more += text_parameter(1, "TYPE_GROUPS", [b"MY_RESULTS"]) if group == "MY_RESULTS" else b""
    file = write_c3d(tmp_path / "a.c3d", [b"*0", b"*1", b"TipAngles"], places(3), more=more)
    recording, _ = imported(file, tmp_path)
    assert not recording.marker_names and len(recording.unnamed_frame) == 10
    assert "TipAngles" in " ".join(open_source(file).notes)
    assert contents(file)["no_places"] == ["TipAngles"]


def test_a_header_of_c3d_and_its_parameters_that_disagree_are_noted(tmp_path: Path) -> None:
    file = write_c3d(tmp_path / "a.c3d", [b"tip", b"left"], places(2), used=5)
    assert any("POINT:USED says 5" in note for note in open_source(file).notes)


# Exports of motion capture


def trc(frames: int = 5, markers: int = 2, *, announced: int = 5, rate: int = 100, blank: str = "\n") -> str:
    head = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
    said = f"{rate}\t{rate}\t{announced}\t{markers}\tmm\t{rate}\t1\t{announced}"
    rows = [f"{k + 1}\t{0.01 * k:.3f}\t{100 + k}\t200\t300\t10\t20\t{30 + k}" for k in range(frames)]
    names = "Frame#\tTime\ttip\t\t\tleft\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2"
    return f"PathFileType\t4\t(X/Y/Z)\ttake.trc\n{head}\n{said}\n{names}\n{blank}" + "\n".join(rows) + "\n"


def qualisys(frames: int = 5, *, announced: int = 5, titles: bool = True, kind: str = "3D") -> str:
    head = f"NO_OF_FRAMES\t{announced}\nNO_OF_CAMERAS\t6\nNO_OF_MARKERS\t2\nFREQUENCY\t100\nDESCRIPTION\t--\n"
    head += f"TIME_STAMP\t2026-11-27, 10:15:00\t1.5\nDATA_INCLUDED\t{kind}\nMARKER_NAMES\ttip\tleft\n"
    head += "Frame\tTime\ttip X\ttip Y\ttip Z\tleft X\tleft Y\tleft Z\n" if titles else ""
    rows = [f"{100 + 5 * (k % 2)}\t200\t300\t10\t20\t{30 + k}" for k in range(frames)]  # x is no counter
    rows = [f"{k + 1}\t{0.01 * k:.5f}\t{row}" for k, row in enumerate(rows)] if titles else rows
    return head + "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("name", "text", "kind", "x"),
    [
        ("take.trc", trc(), "trc", 0.104),
        ("take.txt", trc(blank=""), "trc", 0.104),
        ("take.tsv", qualisys(), "qualisys", 0.1),
        ("bare.tsv", qualisys(titles=False), "qualisys", 0.1),
    ],
)
def test_trc_and_qualisys(name: str, text: str, kind: str, x: float, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert guess_format(tmp_path / name) == kind and contents(tmp_path / name)["markers"] == ["tip", "left"]
    recording, _ = imported(tmp_path / name, tmp_path)
    assert recording.marker_names == ("tip", "left")
    np.testing.assert_allclose(marker_grid(recording)[4], [[x, 0.2, 0.3], [0.01, 0.02, 0.034]], atol=1e-9)
    np.testing.assert_allclose(recording.time_s, 0.01 * np.arange(5), atol=1e-9)


@pytest.mark.parametrize("text", [trc(announced=50), qualisys(announced=50)])
def test_fewer_frames_than_announced_are_said(text: str, tmp_path: Path) -> None:
    (tmp_path / "take.tsv").write_text(text)
    with pytest.warns(UserWarning, match="50 frames are announced, 5 were read"):
        imported(tmp_path / "take.tsv", tmp_path)


def test_counts_and_rates_of_a_header_that_are_not_those_of_the_rows_are_noted(tmp_path: Path) -> None:
    (tmp_path / "take.trc").write_text(trc(markers=3, rate=50))
    notes = " ".join(open_source(tmp_path / "take.trc").notes)
    assert "announces 3 markers, 2 stand there" in notes and "50 frames a second, the times 100" in notes


def test_an_export_of_bodies_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "take.tsv").write_text(qualisys(kind="6D"))
    with pytest.raises(InputError, match="without places of markers"):
        open_source(tmp_path / "take.tsv")


# Clouds

CLOUD = np.array([[0.1, 0.0, 0.5], [0.0, 0.1, 0.5], [0.0, 0.0, 0.6]])


def pcd(path: Path, *, viewpoint: str = "0 0 0 1 0 0 0", width: int = 3) -> Path:
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {width}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS 3\n"
    path.write_text(head + "DATA ascii\n" + "\n".join(" ".join(map(str, point)) for point in CLOUD) + "\n")
    return path


def ply(path: Path, *, camera: str = "", count: int = 3) -> Path:
    keys = [*(f"view_p{a}" for a in "xyz"), *(f"{a}_axis{part}" for part in "xyz" for a in "xyz")]
    element = "element camera 1\n" + "".join(f"property float {key}\n" for key in keys) if camera else ""
    head = f"ply\nformat ascii 1.0\nelement vertex {count}\n" + "".join(f"property float {a}\n" for a in "xyz") + element
    path.write_text(head + "end_header\n" + "\n".join(" ".join(map(str, point)) for point in CLOUD) + f"\n{camera}\n")
    return path


@pytest.mark.parametrize("kind", ["pcd", "ply"])
def test_where_a_cloud_says_that_its_sensor_stood_is_said(kind: str, tmp_path: Path) -> None:
    turned, at_origin = tmp_path / f"turned.{kind}", tmp_path / f"origin.{kind}"
    if kind == "pcd":
        pcd(turned, viewpoint="0.1 -0.25 0.3 0 1 0 0")
        pcd(at_origin)
    else:
        ply(turned, camera="0.1 -0.25 0.3 1 0 0 0 -1 0 0 0 -1")
        ply(at_origin, camera="0 0 0 1 0 0 0 1 0 0 0 1")
    assert "0.1, -0.25, 0.3 and turned" in str(viewpoint_doubt(turned))
    assert viewpoint_doubt(at_origin) is None
    np.testing.assert_allclose(read_cloud(turned).points, CLOUD, atol=1e-6)
    with pytest.warns(UserWarning, match="VIEWPOINT"):
        open_source(turned, Options(unit="m"))


def test_counts_of_a_cloud_that_are_not_those_of_its_points(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="contradicts itself"):
        read_cloud(pcd(tmp_path / "a.pcd", width=2))
    with pytest.warns(UserWarning, match="1 lines more than the header announces"):
        assert len(read_ply_vertices(ply(tmp_path / "a.ply", count=2))["x"]) == 2
    (tmp_path / "a.xyz").write_text("5\n0.1 0.2 0.5\n0.1 0.2 0.6\n")
    with pytest.raises(InputError, match="broken or shortened") as error:
        read_xyz_columns(tmp_path / "a.xyz")
    assert "2 points" in str(error.value)


# Depth in bags


@pytest.mark.parametrize("packing", [".jpg", ".png"])
def test_depth_that_was_packed_as_8_bits_is_refused_and_leaves_nothing(packing: str, tmp_path: Path) -> None:
    form = {".jpg": "16UC1; jpeg compressed ", ".png": "16UC1; png compressed "}[packing]
    with BagWriter(tmp_path / "bag", "sqlite3") as bag:
        for k in range(2):
            stamp = START_NS + k * STEP_NS
            data = cv2.imencode(packing, (depth_of(k) // 4).astype(np.uint8))[1].tobytes()
            bag.write("/camera/depth/image_raw/compressed", stamp, bag.compressed(data, form, stamp))
            bag.write("/camera/depth/camera_info", stamp, bag.info(stamp))
    with pytest.raises(InputError, match="packed as 8 bits: it is lost"):
        imported(tmp_path / "bag", tmp_path)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["bag"]


def test_depth_images_of_8_bits_are_named_where_nothing_else_is_there(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", "sqlite3") as bag:
        bag.write("/camera/depth/image_raw", START_NS, bag.image((depth_of(0) // 4).astype(np.uint8), "8UC1", START_NS))
    with pytest.raises(InputError, match="nothing that can be taken") as error:
        open_source(tmp_path / "bag")
    assert "/camera/depth/image_raw has 8 bits" in str(error.value)


# Inputs in bags


def pressures(bag: BagWriter, topic: str, values: list[float]) -> None:
    kind = bag.type("sensor_msgs/msg/FluidPressure")
    for k, value in enumerate(values):
        stamp = START_NS + k * STEP_NS
        bag.write(topic, stamp, kind(bag.header(stamp), value, 0.0))


def test_pressures_of_two_topics_have_two_names_and_absolute_ones_are_said(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", "sqlite3") as bag:
        pressures(bag, "/left/pressure", [101325.0, 102325.0, 103325.0])
        pressures(bag, "/right/pressure", [0.0, 2000.0, 3000.0])
    with pytest.warns(UserWarning, match=r"chamber 'left' never falls below 101325 Pa: is it absolute\?"):
        recording, _ = imported(tmp_path / "bag", tmp_path)
    assert recording.chamber_names == ("left", "right")
    columns = {"/left/pressure": "chamber_l*Pa_abs", "/right/pressure": "chamber_r"}
    mapped, _ = imported(tmp_path / "bag", tmp_path / "mapped", Options(columns=columns))
    np.testing.assert_allclose(mapped.pressures, [[0, 0], [1000, 2000], [2000, 3000]], atol=1e-6)


def motors(path: Path, *, position: float = 0.0, effort: float = 0.0) -> Path:
    with BagWriter(path, "sqlite3") as bag:
        for k in range(4):
            stamp = START_NS + k * STEP_NS
            bag.write("/camera/depth/image_raw", stamp, bag.image(depth_of(k), "16UC1", stamp))
            bag.write("/camera/depth/camera_info", stamp, bag.info(stamp))
            message = bag.joints(["top"], stamp, position=[position * (1 + 0.1 * k)], effort=[effort * (1 + 0.1 * k)])
            bag.write("/joint_states", stamp, message)
    return path


def test_ticks_are_refused_as_no_length_and_leave_nothing(tmp_path: Path) -> None:
    file = motors(tmp_path / "bag", position=2048.0)
    with pytest.raises(InputError, match="is no length") as error:
        imported(file, tmp_path)
    assert "--map NAME=cable_top*FACTOR" in str(error.value) and "millimetres" not in str(error.value)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["bag"]


@pytest.mark.parametrize(
    ("field", "said"), [("position", "m or rad by its message, is taken as metres"), ("effort", "taken as newtons")]
)
def test_the_field_and_the_unit_that_are_assumed_of_motors_are_noted(field: str, said: str, tmp_path: Path) -> None:
    file = motors(tmp_path / "bag", **{field: 0.2})
    assert any(said in note and "--map NAME=cable_top*FACTOR" in note for note in open_source(file).notes)
    scaled = open_source(file, Options(columns={f"top.{field}": "cable_top*0.01"}))
    assert not any(said in note for note in scaled.notes)


def test_tensions_of_hundreds_of_newtons_are_asked_about(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="reaches 260 N; is it in .*milliampere of a motor"):
        imported(motors(tmp_path / "bag", effort=200.0), tmp_path)
