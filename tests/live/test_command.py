"""`femsense live` and what goes with it, as a user runs them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from live_block import write_watched_block

from femsense.app.cli import run
from femsense.app.doctor_cameras import camera_checks
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
    assert "broker away" in [notice["kind"] for notice in document["notices"]]
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
