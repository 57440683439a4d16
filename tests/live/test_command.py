"""`femsense live` and what goes with it, as a user runs them."""

from __future__ import annotations

import datetime
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from live_block import write_watched_block
from streams import within

from femsense.app.cli import run
from femsense.app.doctor_cameras import camera_checks
from femsense.app.live_command import page_of_session, summary_text
from femsense.core.errors import InputError
from femsense.live.sources.source import FoundCamera
from femsense.sensing.run_files import read_run


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_watched_block(tmp_path_factory.mktemp("block"), free=12, touched=3)


def femsense(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "femsense", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_a_recording_is_replayed_into_a_session_that_every_command_takes(block: tuple[Path, Path], tmp_path: Path) -> None:
    robot, recording = block
    session = tmp_path / "session"
    words = [
        "live",
        robot,
        "--camera",
        recording,
        "--as-fast-as-possible",
        "-o",
        session,
        "--no-page",
        "--json",
        "--mqtt",
        "mqtt://127.0.0.1:1",
    ]
    done = femsense(*words)
    document = json.loads(done.stdout)
    assert done.returncode == 0 and document["frames_received"] == 15 and document["link"] == "ended", done.stderr
    assert "broker away" in [event["kind"] for event in document["events"]]
    assert any("linear tetrahedra make this body too stiff" in text for text in document["warnings"])
    assert "calibrating" in done.stderr and "time-out" not in done.stderr
    assert len(read_run(session / "run").frames) == document["frames_used"]
    assert run(["export", str(session), "-o", str(tmp_path / "robot.glb")]) == 0 and (tmp_path / "robot.glb").is_file()
    assert run(["inspect", str(session)]) == 0
    again = femsense(*words)
    assert again.returncode == 2 and "a session does not replace files" in json.loads(again.stdout)["error"]


def test_wrong_words_are_refused_with_what_to_try(
    block: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot, recording = block
    assert run(["live", str(robot), "--camera", "realsens", "--no-page"]) == 2
    assert "no such source of frames" in capsys.readouterr().err
    assert run(["live", str(robot), "--camera", str(recording), "--actuation", "fixed:tip=1", "--no-page"]) == 2
    assert "the robot has no such input" in capsys.readouterr().err
    assert run(["view", "--live", str(tmp_path)]) == 2
    assert "no session runs there" in capsys.readouterr().err


def test_a_session_that_was_killed_is_said_to_have_ended_and_when(block: tuple[Path, Path], tmp_path: Path) -> None:
    session = tmp_path / "session"
    words = ["live", str(block[0]), "--camera", f"software:{block[1]}", "-o", str(session)]
    process = subprocess.Popen([sys.executable, "-m", "femsense", *words], stderr=subprocess.DEVNULL)
    try:
        assert within(60.0, (session / "live.json").is_file)
        url = json.loads((session / "live.json").read_text())["url"]
        assert page_of_session(session) == url
    finally:
        process.kill()
        process.wait()
    assert within(60.0, lambda: not (session / "live.json").exists())
    (session / "live.json").write_text(json.dumps({"url": url}))  # as after a power failure
    long_ago = datetime.datetime(2024, 3, 1, 12, 30, 5).timestamp()
    for table in session.rglob("*"):
        os.utime(table, (long_ago, long_ago))
    with pytest.raises(InputError) as ended:
        page_of_session(session)
    said = str(ended.value)
    assert "the session has ended" in said and "its last frame at 2024-03-01 12:30:05" in said
    assert f"femsense view {session} shows what was recorded" in said


def test_the_summary_names_every_part_and_every_kind_of_event() -> None:
    event = {"kind": "stamps jump", "text": "by 100 s", "time_s": 4.0, "duration_s": 1.5, "lasts": False, "count": 3}
    document = {
        "frames_received": 90,
        "frames_used": 60,
        "frames_skipped": 30,
        "frames_missed": 4,
        "frames_dropped": 2,
        "todo": "",
        "recording": "here",
        "parts": ["here/tare-1", "here/tare-2"],
        "events": [event, event | {"kind": "warm-up", "count": 1}],
    }
    assert summary_text(document).splitlines() == [
        "60 of 90 received frames sensed, 30 skipped",
        "4 frames missed: this machine was too busy to receive them",
        "2 frames not delivered by the device or its link",
        "stamps jump (3 times, last at 4.0 s for 1.5 s): by 100 s",
        "",
        "recorded: here",
        "recorded: here/tare-1",
        "recorded: here/tare-2",
        "look at it: femsense view here",
        "look at it: femsense view here/tare-1",
        "look at it: femsense view here/tare-2",
    ]


def test_doctor_lists_cameras_their_links_and_what_the_bus_carries() -> None:
    slow = FoundCamera("realsense:1", "D435", "USB 2.1", True, 490.0)
    fast = FoundCamera("oak:2", "OAK-D", "USB 3", False, 300.0)
    found = {
        check["name"]: check for check in camera_checks(lambda: ((slow, fast), {"orbbec": "missing\n  try:      pip install x"}))
    }
    assert found["camera realsense:1"]["level"] == "warning" and "USB 3 port" in found["camera realsense:1"]["hint"]
    assert found["camera oak:2"]["level"] == "ok" and "needs 300 Mbit/s" in found["camera oak:2"]["found"]
    assert "790 Mbit/s are needed" in found["bandwidth of the bus"]["found"]
    assert found["cameras: orbbec"]["hint"] == "pip install x" and "MB/s" in found["disk for sessions"]["found"]
    nothing = camera_checks(lambda: ((), {}))
    assert nothing[0]["found"] == "none found" and "--camera RECORDING" in nothing[0]["hint"]
