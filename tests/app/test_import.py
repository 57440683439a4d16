"""`femsense import` as a user types it: answers, choices, what stands in the way, and what inspect says of the same files."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from femsense.app.cli import run
from femsense.io.recording_folder import load_recording

ROWS = "time,tip_x,tip_y,tip_z,cable_north\n" + "".join(f"{0.1 * k},{k},0,1000,{0.5 * k}\n" for k in range(5))


@pytest.fixture
def table(tmp_path: Path) -> Path:
    (tmp_path / "take.csv").write_text(ROWS)
    return tmp_path / "take.csv"


def answer(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict]:
    status = run([*map(str, words), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_the_whole_way(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("import", table, "-o", tmp_path / "out", "--unit", "mm", "--inputs", "tension")
    status, document = answer(capsys, *words)
    assert status == 0 and document["frames"] == 5 and document["rate_hz"] == pytest.approx(10)
    assert document["actuation"] == "tension" and document["markers"] == ["tip"]
    recording = load_recording(tmp_path / "out")
    np.testing.assert_allclose(recording.marker_xyz[:, 0], 1e-3 * np.arange(5))
    status, report = answer(capsys, "inspect", tmp_path / "out")
    assert status == 0 and report["kind"] == "recording"
    before = (tmp_path / "out/frames.csv").stat().st_mtime_ns
    assert answer(capsys, *words)[0] == 0
    assert (tmp_path / "out/frames.csv").stat().st_mtime_ns == before


def test_text_for_people(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["import", str(table), "-o", str(tmp_path / "out"), "--unit", "mm", "--inputs", "tension"]) == 0
    out = capsys.readouterr().out
    for words in ("5 frames", "rate [1/s]", "unit", "written:"):
        assert words in out


def test_what_is_not_known_is_asked_with_status_2(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, document = answer(capsys, "import", table, "-o", tmp_path / "out")
    assert status == 2 and "--unit" in document["error"]
    status, document = answer(capsys, "import", table, "-o", tmp_path / "out", "--unit", "mm")
    assert status == 2 and "--inputs" in document["error"]
    assert not (tmp_path / "out").exists()


def test_another_import_is_replaced_only_when_that_is_said(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["import", table, "-o", tmp_path / "out", "--inputs", "tension"]
    assert answer(capsys, *words, "--unit", "mm")[0] == 0
    status, document = answer(capsys, *words, "--unit", "cm")
    assert status == 2 and "--again" in document["error"]
    assert answer(capsys, *words, "--unit", "cm", "--again")[0] == 0
    assert load_recording(tmp_path / "out").marker_xyz[1, 0] == pytest.approx(0.01)
    assert not list(tmp_path.glob(".part-*"))


def test_again_keeps_the_files_of_others(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["import", table, "-o", tmp_path / "out", "--inputs", "tension", "--unit", "mm"]
    assert answer(capsys, *words)[0] == 0
    for name in ("notes.txt", "thesis/ch1.tex", "thesis/000001.ply", "rest.csv"):
        (tmp_path / "out" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "out" / name).write_text(f"my {name}")
    (tmp_path / "out" / "link").symlink_to(tmp_path)
    (tmp_path / "out" / "rest.csv").write_text("marker,x_m,y_m,z_m\ntip,0,0,0\n")
    assert answer(capsys, *words[:-1], "cm", "--again")[0] == 0
    assert load_recording(tmp_path / "out").marker_xyz[1, 0] == pytest.approx(0.01)
    assert (tmp_path / "out/notes.txt").read_text() == "my notes.txt" and (tmp_path / "out/link").is_symlink()
    assert (tmp_path / "out/thesis/ch1.tex").is_file() and (tmp_path / "out/thesis/000001.ply").is_file()
    assert (tmp_path / "out/rest.csv").is_file() and not list(tmp_path.glob(".part-*"))


@pytest.mark.parametrize("name", ["frames.csv", "recording.toml", "loads.csv"])
def test_again_does_not_undo_changes_of_a_person(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    words = ["import", table, "-o", tmp_path / "out", "--inputs", "tension", "--unit", "mm"]
    assert answer(capsys, *words)[0] == 0
    with (tmp_path / "out" / name).open("a") as stream:
        stream.write("# changed\n")
    changed = (tmp_path / "out" / name).read_text()
    status, document = answer(capsys, *words, "--again")
    assert status == 2 and name in document["error"] and "--free FROM:TO" in document["error"]
    assert (tmp_path / "out" / name).read_text() == changed


def test_a_pipe_is_no_capture_and_a_recording_not_its_own(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "folder/000000.ply")
    for source in (tmp_path / "folder/000000.ply", tmp_path / "folder"):
        status, document = answer(capsys, "import", source, "-o", tmp_path / "out")
        assert status == 2 and "a pipe or a device cannot be read here" in document["error"]
    assert run(["inspect", str(tmp_path / "folder/000000.ply")]) == 2
    words = ["-o", tmp_path / "out", "--inputs", "tension", "--unit", "mm"]
    assert answer(capsys, "import", table, *words)[0] == 0
    for source in (tmp_path / "out", tmp_path / "out/markers.csv"):
        status, document = answer(capsys, "import", source, *words, "--again")
        assert status == 2 and "would replace its own " in document["error"]


def test_what_is_no_import_is_never_replaced(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("precious")
    for extra in ([], ["--again"]):
        status, document = answer(capsys, "import", table, "-o", tmp_path / "mine", "--unit", "mm", "--inputs", "tension", *extra)
        assert status == 2 and "exists and is not an import" in document["error"]
    assert (tmp_path / "mine/notes.txt").read_text() == "precious"
    status, _ = answer(capsys, "import", table, "-o", table, "--unit", "mm", "--inputs", "tension")
    assert status == 2 and table.read_text() == ROWS


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--unit", "furlong"), "--unit"),
        (("--up", "w"), "--up"),
        (("--clock", "sun"), "--clock"),
        (("--rate", "-1"), "--rate"),
        (("--map", "tip"), "--map"),
        (("--format", "rosbag"), "no such format"),
        (("--inputs", "torque"), "--inputs"),
        (("--zero", "one"), "--zero"),
        (("--actuation", "nowhere.csv"), "nothing there"),
    ],
)
def test_wrong_words(words: tuple[str, ...], said: str, table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, document = answer(capsys, "import", table, "-o", tmp_path / "out", *words)
    assert status == 2 and said in document["error"]


def test_a_missing_package_gives_the_line_that_installs_it(
    tmp_path: Path, table: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rosbags", "rosbags.highlevel", "rosbags.typesys", "mcap", "mcap.stream_reader"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    status, document = answer(capsys, "import", tmp_path / "a.bag", "-o", tmp_path / "bag")
    assert status == 2 and "pip install 'femsense[ros]'" in document["error"]
    assert answer(capsys, "import", table, "-o", tmp_path / "out", "--unit", "mm", "--inputs", "tension")[0] == 0


def test_a_log_beside_a_table_with_mappings_for_both(tmp_path: Path, table: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "log.csv").write_text("time_s,m1\n" + "".join(f"{0.05 * k},{k}\n" for k in range(20)))
    words = (
        "--map",
        "m1=cable_south*2",
        "cable_north=tip2.x",
        "tip_y=tip2.y",
        "tip_z=tip2.z",
        "--actuation",
        tmp_path / "log.csv",
        "--offset",
        "0",
    )
    status, document = answer(capsys, "import", table, "-o", tmp_path / "out", "--unit", "mm", "--inputs", "tension", *words)
    assert status == 0 and document["inputs"] == ["cable_south"] and document["markers"] == ["tip2"]
    np.testing.assert_allclose(load_recording(tmp_path / "out").inputs[:, 0], 4 * np.arange(5), atol=1e-9)


def test_a_run_that_is_killed_goes_on(tmp_path: Path) -> None:
    """`kill -9` in the middle: nothing at the final place, and the same command ends with the same files."""
    rows = "".join(f"{0.01 * k},{k % 50},0,1000\n" for k in range(20_000))
    (tmp_path / "long.csv").write_text("time,tip_x,tip_y,tip_z\n" + rows)
    command = [sys.executable, "-m", "femsense", "import", str(tmp_path / "long.csv"), "--unit", "mm", "-o"]
    process = subprocess.Popen([*command, str(tmp_path / "out")], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    journal = tmp_path / ".part-import-out/.import-journal"
    while process.poll() is None and not (journal.is_file() and journal.stat().st_size > 20_000):
        time.sleep(0.01)
    process.kill()
    assert process.wait() == -9 and not (tmp_path / "out").exists()
    for name in ("out", "whole"):
        subprocess.run([*command, str(tmp_path / name)], check=True, capture_output=True)
    assert (tmp_path / "out/markers.csv").read_bytes() == (tmp_path / "whole/markers.csv").read_bytes()
    assert json.loads((tmp_path / "out/import.json").read_text())["found"]["resumed"] > 0


def test_inspect_says_what_is_in_a_capture_and_never_that_nothing_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags")
    from ros_writers import BagWriter, write_camera

    with BagWriter(tmp_path / "take.bag", "1") as bag:
        write_camera(bag, 3)
    assert run(["inspect", str(tmp_path / "take.bag")]) == 0
    out = capsys.readouterr().out
    assert "/camera/depth/image_raw" in out and "depth" in out and "nothing is wrong" not in out
    with BagWriter(tmp_path / "folder", "mcap") as bag:
        write_camera(bag, 3)
    status, report = answer(capsys, "inspect", tmp_path / "folder")
    assert status == 0 and report["kind"] == "capture" and {t["holds"] for t in report["topics"]} == {"depth", "color", "inputs"}
    for name, data in (("a.bag", b"random bytes" * 50), ("b.c3d", b"abc"), ("c.db3", b""), ("d.mcap", b"\x89MCAP0\r\n")):
        (tmp_path / name).write_bytes(data)
        status, report = answer(capsys, "inspect", tmp_path / name)
        assert status == 2 and report["kind"] == "capture" and report["problems"]


def test_a_recording_of_very_many_frames_is_told_how_to_take_fewer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "".join(f"{0.005 * k:.3f},{k % 50},0,1000,{k % 3}\n" for k in range(1200))
    (tmp_path / "long.csv").write_text(ROWS.splitlines(keepends=True)[0] + rows)
    words = ("import", tmp_path / "long.csv", "-o", tmp_path / "out", "--unit", "mm", "--inputs", "tension")
    status, document = answer(capsys, *words)
    assert status == 0 and any("--every 4 keeps about 300 of them, 50 a second" in note for note in document["notes"])
    status, document = answer(capsys, *words, "--every", 4, "--again")
    assert status == 0 and document["frames"] == 300 and not any("--every" in note for note in document["notes"])
    assert any("--free FROM:TO" in note for note in document["notes"])


def test_inspect_knows_a_video_of_depth(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from kinect_writer import write_kinect

    file = write_kinect(tmp_path / "take.mkv", [np.full((288, 320), 900, dtype=np.uint16)])
    status, report = answer(capsys, "inspect", file)
    assert status == 0 and (report["kind"], report["format"]) == ("capture", "kinect")


def test_links_are_followed_and_devices_refused(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "real").mkdir()
    words = ("--unit", "mm", "--inputs", "tension")
    for name, target in (("link", "real"), ("new", "later")):
        (tmp_path / name).symlink_to(tmp_path / target)
        assert answer(capsys, "import", table, "-o", tmp_path / name, *words)[0] == 0
        assert (tmp_path / name).is_symlink() and (tmp_path / target / "recording.toml").is_file()
        assert answer(capsys, "import", table, "-o", tmp_path / name, *words, "--again")[0] == 0
        assert (tmp_path / name).is_symlink() and not list(tmp_path.glob(".part*"))
    os.mkfifo(tmp_path / "pipe")
    for place in ("/dev/null", tmp_path / "pipe", table):
        assert run(["import", str(table), "-o", str(place), *words]) == 2
        assert "stands" in capsys.readouterr().err
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode) and table.read_text() == ROWS


def test_what_a_log_holds_is_asked_before_the_frames_are_read(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.csv").write_text("time,cable_east\n100,0\n101,1\n")
    words = ["import", str(table), "-o", str(tmp_path / "out"), "--unit", "mm", "--actuation", str(tmp_path / "log.csv")]
    assert run(words) == 2
    assert "--inputs tension" in capsys.readouterr().err and not list(tmp_path.glob(".part*"))
    assert run([*words, "--inputs", "tension", "--offset", "-100"]) == 0


def test_options_without_effect_are_said(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("import", table, "-o", tmp_path / "out", "--unit", "mm", "--inputs", "tension")
    status, document = answer(capsys, *words, "--free", "5:9", "--rate", "30", "--clock", "header")
    notes = " ".join(document["notes"])
    assert status == 0 and all(key in notes for key in ("--free 5:9", "--rate has no effect", "--clock has no effect"))


def test_a_mapping_of_times_counts_in_the_table_and_in_its_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "take.csv").write_text("Zeit (ms),tip_x_m,tip_y_m,tip_z_m\n0,0,0,1\n500,0,0,1\n")
    (tmp_path / "log.csv").write_text("Zeit (ms),motor [mN]\n0,1000\n500,2000\n")
    words = ["import", tmp_path / "take.csv", "--actuation", tmp_path / "log.csv", "--offset", "0", "-o", tmp_path / "out"]
    status, _ = answer(capsys, *words, "--map", "Zeit (ms)=time", "--map", "motor [mN]=cable_a")
    assert status == 0
    recording = load_recording(tmp_path / "out")
    assert list(recording.time_s) == [0.0, 0.5] and recording.inputs[:, 0].tolist() == [1.0, 2.0]
    status, document = answer(capsys, *words, "--map", "Zeit (ms)=time", "--map", "motr=cable_a", "--again")
    assert status == 2 and "the log: " in document["error"] and "take.csv: Zeit (ms)" in document["error"]
