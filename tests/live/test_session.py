"""A whole session: calibrated on the fly, sensed, recorded, replayed, zeroed, killed."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_block import write_watched_block
from streams import within

from femsense.calib.calibrate import calibrate
from femsense.calib.files import read_calibration, write_calibration
from femsense.core.errors import DataError, InputError
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.live.actuation import make_actuation
from femsense.live.calibrating import CoverageLimits
from femsense.live.events import Notice
from femsense.live.feed import CameraFeed, FeedOptions
from femsense.live.figures import Snapshot
from femsense.live.growing import make_scratch, remove_scratch
from femsense.live.link import LinkLimits, LinkState
from femsense.live.recorder import session_run
from femsense.live.senser import Answer
from femsense.live.session import Phase, Session, SessionOptions
from femsense.sensing.pipeline import estimate
from femsense.sensing.run_files import read_run
from femsense.sensing.types import Run

FAST = FeedOptions(as_fast_as_possible=True)
WAITS = CoverageLimits(frames=8, wait_s=0.0)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_watched_block(tmp_path_factory.mktemp("block"), free=12, touched=3)


@pytest.fixture(scope="module")
def calibration(block: tuple[Path, Path]) -> Path:
    found = calibrate(load_robot(block[0]), load_recording(block[1]), frames=range(12))
    return write_calibration(found, block[0].parent / "calibration.json")


def run_session(
    robot: Path, camera: str, options: SessionOptions, feed: FeedOptions = FAST, act=lambda _session: None, inputs: str = ""
):
    """Run a session to its end; `act(session)` is called before each step. Return its answers and its last snapshot."""
    answers: list[Answer] = []
    scratch = make_scratch()
    try:
        with CameraFeed(camera, feed) as source:
            body = load_robot(robot)
            actuation = make_actuation(inputs, body) if inputs else None
            session = Session(
                body, source, scratch, actuation=actuation, options=options, on_answer=lambda a, _taken: answers.append(a)
            )
            try:
                while not source.is_over:
                    act(session)
                    session.step(0.1)
            finally:
                session.close()
            return answers, session.snapshot()
    finally:
        remove_scratch(scratch)


def events_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "events.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def rows(run: Run) -> list[tuple]:
    """Return all numbers of a run but its times of computing."""
    contacts = [
        (c.frame, c.track, c.force_n, c.std_n, c.source, *c.position_m, *c.normal, *c.force_n_xyz, *c.force_std_n_xyz, c.radius_m)
        for c in run.contacts
    ]
    return contacts + [(f.frame, f.time_s, f.status, f.contacts, f.matched, f.rms_before_m, f.rms_after_m) for f in run.frames]


def test_a_session_calibrates_senses_and_replays_to_the_same_numbers(block: tuple[Path, Path], tmp_path: Path) -> None:
    robot, recording = block
    told: list[Snapshot] = []
    folder = tmp_path / "session"
    options = SessionOptions(folder=folder, coverage=WAITS)
    answers, last = run_session(robot, str(recording), options, act=lambda session: told.append(session.snapshot()))
    todo = " ".join(snapshot.todo for snapshot in told)
    assert "move the cables, touch nothing: 7 of 8 frames missing" in todo and last.phase == Phase.ENDED
    notes = {event.kind: event.text for snapshot in told for event in snapshot.notices}
    assert "has no column `free`: until the calibration, all its frames" in notes[Notice.CONTACT_FREE]
    events = events_of(folder)
    assert [row["kind"] for row in events] == ["warm-up", "contact-free frames", "calibration", "ended"]
    assert events[0]["time_s"] < events[1]["time_s"] and events[1]["text"] == notes[Notice.CONTACT_FREE]
    assert events[2]["text"].startswith("from frames 0–7: Calibration(")
    assert [answer.report.frame for answer in answers] == list(range(8, 15)) and last.used == 15
    assert all(answer.is_ok for answer in answers) and [bool(a.contacts) for a in answers] == [False] * 4 + [True] * 3
    assert answers[-1].contacts[0].force_n == pytest.approx(0.3, abs=0.1)
    replayed = load_recording(folder)
    assert replayed.free is not None and replayed.free.tolist() == [True] * 8 + [False] * 7
    live = read_run(session_run(folder))
    again = estimate(load_robot(robot), replayed, read_calibration(folder / "calibration.json"))
    assert rows(live) == rows(again) and np.array_equal(live.states.nodes_m, again.states.nodes_m)


def test_with_a_calibration_a_few_contact_free_frames_come_first_and_the_inputs_may_rest(
    block: tuple[Path, Path], calibration: Path
) -> None:
    told: list[str] = []
    options = SessionOptions(calibration=calibration, contact_free_frames=5)
    answers, _ = run_session(block[0], str(block[1]), options, act=lambda session: told.append(session.snapshot().todo))
    assert "touch nothing: 4 of 5 frames missing" in told and answers[0].report.frame == 5


def test_a_tare_begins_a_part_of_its_own_that_replays_too(block: tuple[Path, Path], calibration: Path, tmp_path: Path) -> None:
    robot, recording = block
    folder = tmp_path / "session"
    seen: list[int] = []

    def act(session: Session) -> None:
        answer = session.snapshot().answer
        if answer is not None and answer.report.frame == 5 and not seen:
            seen.append(5)
            session.tare()

    options = SessionOptions(calibration=calibration, folder=folder, contact_free_frames=4)
    run_session(robot, str(recording), options, act=act)
    first, second = load_recording(folder), load_recording(folder / "tare-1")
    assert first.frame_numbers.tolist() == [0, 1, 2, 3, 4, 5] and second.frame_numbers.tolist() == list(range(6, 15))
    live = read_run(session_run(folder / "tare-1"))
    again = estimate(load_robot(robot), second, read_calibration(folder / "tare-1" / "calibration.json"))
    assert rows(live) == rows(again) and max(c.force_n for c in live.contacts) == pytest.approx(0.3, abs=0.15)


def test_a_zero_during_a_contact_is_refused_unless_it_is_asked_for_all_the_same(
    block: tuple[Path, Path], calibration: Path, tmp_path: Path
) -> None:
    told: dict[int, tuple[str, str]] = {}

    def act(session: Session) -> None:
        answer = session.snapshot().answer
        if answer is not None and answer.report.frame in (12, 13) and answer.report.frame not in told:
            said = {event.kind: event.text for event in session.snapshot().notices}
            told[answer.report.frame] = said.get(Notice.NOT_ZEROED, ""), session.snapshot().recording
            session.tare(anyway=answer.report.frame == 13)

    options = SessionOptions(calibration=calibration, folder=tmp_path / "session", contact_free_frames=4)
    _, last = run_session(block[0], str(block[1]), options, act=act)
    assert told[12][0] == "" and told[13][0].startswith("a contact of 0.") and "press t again; T zeroes" in told[13][0]
    assert last.parts == (str(tmp_path / "session" / "tare-1"),) and last.recording == str(tmp_path / "session")
    zeros = [row for row in events_of(tmp_path / "session") if row["kind"] in ("zero", "not zeroed")]
    assert [row["kind"] for row in zeros] == ["not zeroed", "zero"]
    assert zeros[1]["text"].startswith("reference 1, which hides a contact of 0.") and float(zeros[1]["time_s"]) > 0.0


def test_a_zero_is_refused_while_the_camera_is_lost(block: tuple[Path, Path], calibration: Path, tmp_path: Path) -> None:
    asked: list[LinkState] = []

    def act(session: Session) -> None:
        snapshot = session.snapshot()
        if snapshot.answer is not None and snapshot.link.state is LinkState.UNPLUGGED:
            asked.append(snapshot.link.state)
            if len(asked) == 3:  # the last frame has been processed
                session.tare()

    options = SessionOptions(calibration=calibration, folder=tmp_path / "session", contact_free_frames=2)
    feed = FeedOptions(link=LinkLimits(first_retry_s=0.1, longest_retry_s=0.2, retries=3))
    run_session(block[0], f"software:{block[1]}?unplug=150+600", options, feed, act)
    events = {row["kind"]: row for row in events_of(tmp_path / "session")}
    assert asked and events["not zeroed"]["text"] == "the camera is lost: press t again when its frames arrive"
    assert float(events["unplugged"]["duration_s"]) > 0.0 and events["gave up"]["duration_s"] == "0.000"


def with_free(recording: Path, folder: Path, free: set[int]) -> Path:
    """Return a copy of a recording that declares these frames contact-free."""
    shutil.copytree(recording, folder)
    head, *lines = (folder / "frames.csv").read_text().splitlines()
    marked = [f"{line},{int(k in free)}" for k, line in enumerate(lines)]
    (folder / "frames.csv").write_text("\n".join([f"{head},free", *marked, ""]))
    return folder


def test_the_column_free_of_a_recording_decides_which_frames_calibrate_and_the_session_says_so(
    block: tuple[Path, Path], calibration: Path, tmp_path: Path
) -> None:
    told: list[Snapshot] = []
    some = with_free(block[1], tmp_path / "some", {0, 1, 2, 5, 7})
    options = SessionOptions(calibration=calibration, contact_free_frames=5)
    answers, _ = run_session(block[0], str(some), options, act=lambda session: told.append(session.snapshot()))
    notes = {event.kind: event.text for snapshot in told for event in snapshot.notices}
    assert notes[Notice.CONTACT_FREE] == "only frames 0–2, 5, 7, by the column `free` of the recording"
    assert answers[0].report.frame == 8
    with pytest.raises(InputError, match="no frame is declared contact-free"):
        run_session(block[0], str(with_free(block[1], tmp_path / "none", set())), options)


def test_constant_inputs_need_not_move_and_others_are_waited_for(block: tuple[Path, Path], tmp_path: Path) -> None:
    still = tmp_path / "still"
    shutil.copytree(block[1], still)
    head, *lines = (still / "frames.csv").read_text().splitlines()
    (still / "frames.csv").write_text(
        "\n".join([head, *(",".join([*line.split(",")[:2], "1.0", *line.split(",")[3:]]) for line in lines), ""])
    )
    loose = SessionOptions(coverage=replace(WAITS, frames=4, position_m=1.0, rotation_rad=1.0))
    answers, last = run_session(block[0], str(still), loose)
    assert not answers and last.todo == "move the cables, touch nothing: still to be moved: cable_top by 0.5 N"
    described = (still / "recording.toml").read_text()
    (still / "recording.toml").write_text(described.replace('"tension"', '"displacement"'))
    _, last = run_session(block[0], str(still), loose)
    assert last.todo.endswith("still to be moved: cable_top by 0.00109 m")  # a hundredth of the body's diagonal
    (still / "recording.toml").write_text(described)
    accepted, _ = run_session(block[0], str(still), loose, act=lambda session: session.accept_fixed())
    assert accepted[0].report.frame == 4
    constant, _ = run_session(block[0], str(still), loose, inputs="fixed:top=1,side=0.5")
    assert constant[0].report.frame == 4


def test_a_calibration_that_never_suffices_says_what_is_known(block: tuple[Path, Path]) -> None:
    hopeless = SessionOptions(coverage=replace(WAITS, frames=3, position_m=1e-9))
    with pytest.raises(
        DataError, match=r"no sufficient calibration after \d+ contact-free frames: the camera pose: standard deviations of"
    ):
        run_session(block[0], f"software:{block[1]}", hopeless, FeedOptions())


def test_a_camera_without_inputs_needs_an_actuation(block: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "000000.ply").write_bytes(b"ply")
    time.sleep(0.05)

    def act(_session: Session) -> None:
        for number in range(1, 200):
            if not (tmp_path / "clouds" / f"{number:06d}.ply").exists():
                (tmp_path / "clouds" / f"{number:06d}.ply").write_bytes(b"ply")
                return

    with pytest.raises(InputError, match="--actuation SOURCE"):
        run_session(block[0], str(tmp_path), SessionOptions(), FeedOptions(), act)


def test_a_session_that_is_killed_is_a_recording_and_a_run(block: tuple[Path, Path], calibration: Path, tmp_path: Path) -> None:
    robot, recording = block
    folder = tmp_path / "session"
    words = ["live", str(robot), "--camera", f"software:{recording}?usb2=0+600", "-c", str(calibration)]
    words += ["--contact-free", "4", "-o", str(folder), "--no-page"]
    process = subprocess.Popen([sys.executable, "-m", "femsense", *words], stderr=subprocess.DEVNULL)
    journal = folder / "run" / "journal.jsonl"
    try:
        assert within(60.0, lambda: journal.is_file() and journal.read_bytes().count(b"\n") > 8)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert within(60.0, lambda: (folder / "run" / "run.json").is_file() and not journal.exists())
    found, run = load_recording(folder), read_run(folder / "run")
    assert found.frame_count >= len(run.frames) > 8 and len(run.states.nodes_m) == len(run.frames)
    assert json.loads((folder / "session.json").read_text())["link"] == "USB 2.1"
    again = estimate(load_robot(robot), found, read_calibration(folder / "calibration.json"))
    count = len(run.frames)
    assert [f.rms_after_m for f in again.frames[:count]] == [f.rms_after_m for f in run.frames]
    assert [c.force_n for c in again.contacts if c.frame <= run.frames[-1].frame] == [c.force_n for c in run.contacts]
