"""A session on disk: whole at every moment, and what a slow or broken disk does to it."""

from __future__ import annotations

import csv
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from helpers import write_block_robot
from streams import within

from femsense.core.errors import InputError
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.live.events import EventLog, Notice
from femsense.live.frames import Image, ImageKind, Marker, RawFrame, StampedFrame
from femsense.live.growing import empty_recording
from femsense.live.link import LinkState
from femsense.live.recorder import Recorder, write_whole
from femsense.live.sources.source import SourceInfo

COLUMNS = ("cable_top", "cable_side")


@pytest.fixture
def recorder_of(tmp_path: Path):
    robot = load_robot(write_block_robot(tmp_path / "robot"))
    made: list[Recorder] = []

    def make(**more) -> Recorder:
        folder = tmp_path / "session"
        info = SourceInfo("software", (None,), 10.0)
        empty = empty_recording(robot, info, actuation="tension", actuation_zero="unknown", folder=folder, gravity=False)
        made.append(Recorder(folder, empty, COLUMNS, {"robot": str(tmp_path / "robot")}, **more))
        return made[-1]

    yield make


def frame(number: int) -> StampedFrame:
    markers = (Marker("tip", (0.1, 0.2, 0.3)),)
    image = Image(ImageKind.CLOUD, f"cloud {number}".encode(), ".ply")
    return StampedFrame(number, 0.1 * number, 0.0, RawFrame(number, 0.0, (image,), markers))


def test_what_is_kept_opens_as_a_recording_before_it_is_closed(recorder_of) -> None:
    recorder = recorder_of()
    for k in range(3):
        assert recorder.keep(frame(2 * k), np.array([0.1 * k, 1.0]), contact_free=k < 2)
        assert recorder.skip(frame(2 * k + 1), None if k == 0 else np.array([0.1 * k, 1.0]))
    rows = recorder.folder / "frames.csv"
    assert within(5.0, lambda: rows.read_text().count("\n") == 4)
    found = load_recording(recorder.folder)
    assert found.frame_numbers.tolist() == [0, 2, 4] and found.free is not None and found.free.tolist() == [True, True, False]
    assert found.inputs.tolist() == [[0.0, 1.0], [0.1, 1.0], [0.2, 1.0]] and found.actuation_zero == "unknown"
    assert found.marker_names == ("tip",) and found.marker_xyz[0].tolist() == [0.1, 0.2, 0.3]
    assert found.cloud_files[1][0].read_text() == "cloud 2"
    recorder.close()
    skipped = load_recording(recorder.folder / "skipped")
    assert skipped.frame_numbers.tolist() == [3, 5] and (recorder.folder / "skipped/clouds/000001.ply").is_file()


def test_a_disk_that_is_too_slow_loses_frames_that_nobody_sensed_first_and_counts_them(recorder_of) -> None:
    go = Event()

    def slow(path: Path, data: bytes) -> None:
        go.wait(10.0)
        write_whole(path, data)

    recorder = recorder_of(most_waiting=4, write=slow)
    kept = [recorder.skip(frame(k), np.zeros(2)) for k in range(4)]
    kept += [recorder.keep(frame(10 + k), np.zeros(2), contact_free=False) for k in range(3)]
    go.set()
    recorder.close()
    assert kept == [True, True, False, False, True, True, False]
    assert (recorder.lost.skipped, recorder.lost.sensed, recorder.lost.count) == (2, 1, 3)
    assert load_recording(recorder.folder).frame_numbers.tolist() == [10, 11]


def test_a_disk_that_is_full_ends_the_recording_and_not_the_session(recorder_of) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    recorder = recorder_of(write=full)
    recorder.keep(frame(0), np.zeros(2), contact_free=False)
    assert within(5.0, lambda: recorder.error != "")
    assert recorder.error == "recording has stopped: No space left on device"
    assert not recorder.keep(frame(1), np.zeros(2), contact_free=False) and recorder.lost.sensed == 1
    recorder.close()


def test_events_are_kept_with_time_duration_and_count_in_one_row_each(recorder_of) -> None:
    recorder = recorder_of()
    log = EventLog(100.0, clock=lambda: 101.5)
    log.write_to(lambda event: recorder.event(event, log.begun_s))
    log.lasts(LinkState.UNPLUGGED, 'the device is "gone", again')
    log.happened(Notice.DROPPED, "2 so far", 2)
    file = recorder.folder / "events.csv"
    assert within(5.0, lambda: file.read_text().count("\n") == 3)
    running = read_rows(file)
    log.end()
    recorder.close()
    assert running[:2] == [
        ["time_s", "kind", "text", "duration_s", "count"],
        ["1.500", "unplugged", 'the device is "gone", again', "", "1"],
    ]
    over = ["1.500", "unplugged", 'the device is "gone", again', "0.000", "1"]
    assert read_rows(file)[1:] == [over, ["1.500", "frames dropped", "2 so far", "0.000", "2"]]


def read_rows(file: Path) -> list[list[str]]:
    with file.open(newline="") as stream:
        return list(csv.reader(stream))


def test_a_session_replaces_nothing(recorder_of) -> None:
    recorder_of().close()
    with pytest.raises(InputError, match="a session does not replace files"):
        recorder_of()
