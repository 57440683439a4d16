"""Writes a session while it runs: a recording of the processed frames, one of the skipped frames, and the results.

An image file is complete before its row is appended, and a row is appended in one write, so that a session killed at any time
opens as a recording. Results go to a journal, from which `finish_session` writes the run.
"""

from __future__ import annotations

import csv
import io
import json
import os
import queue
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Lock, Thread
from typing import Any, BinaryIO

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import InputError
from femsense.io.files import write_json, write_toml
from femsense.io.recording_folder import load_recording
from femsense.io.recording_toml import recording_document
from femsense.io.robot_toml import load_robot
from femsense.live.events import SessionEvent
from femsense.live.frames import StampedFrame
from femsense.live.growing import image_file
from femsense.live.senser import Answer
from femsense.model.recording import Recording

SESSION_FORMAT = "femsense-session-1"
SKIPPED, RUN, JOURNAL, STATES, EVENTS = "skipped", "run", "journal.jsonl", "states.f32", "events.csv"
CALIBRATION, DESCRIPTION, LIVE = "calibration.json", "session.json", "live.json"
EVENT_COLUMNS = ("time_s", "kind", "text", "duration_s", "count")


@dataclass(frozen=True, slots=True)
class Lost:
    """Number of frames that were not written because the disk was too slow."""

    sensed: int = 0
    """Processed frames; without them a replay gives different results from there on."""
    skipped: int = 0

    @property
    def count(self) -> int:
        return self.sensed + self.skipped


@dataclass(frozen=True, eq=False, slots=True)
class _Job:
    """A pending write of a frame or of a row."""

    run: Callable[[], None]
    has_image: bool


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it."""
    part = path.with_name(f".{path.name}.part")
    part.write_bytes(data)
    os.replace(part, path)


def check_session(folder: Path) -> None:
    """Raise InputError if a folder is not empty: sessions never replace files."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "the folder is not empty, and a session does not replace files",
            where=folder,
            found="a file" if folder.is_file() else ", ".join(sorted(item.name for item in folder.iterdir())[:3]),
            expected="a new folder",
            hint="another -o",
        )


class Recorder:
    """Writes one session in its own thread."""

    def __init__(
        self,
        folder: Path,
        empty: Recording,
        columns: Sequence[str],
        about: Mapping[str, object],
        *,
        most_waiting: int = 256,
        write: Callable[[Path, bytes], None] = write_whole,
    ) -> None:
        """Create the folder and start.

        Arguments:
            folder: new.
            empty: the recording without frames.
            columns: of the inputs of a frame, as in frames.csv.
            about: content of session.json: robot, camera, …
            most_waiting: maximum number of pending frames; skipped frames are dropped from half of it on.
            write: writes one file.
        """
        check_session(folder)
        self.folder, self._columns, self._write = folder, tuple(columns), write
        self._most = most_waiting
        self._lock = Lock()
        self._lost = Lost()
        self._waiting = 0
        self._has_skipped = False
        self._views = empty.camera_names
        self.error = ""
        """Why writing has stopped; empty while it works."""
        (folder / RUN).mkdir(parents=True)
        self._files: dict[str, BinaryIO] = {}
        self._document = recording_document(empty)
        self._begin(folder, "free")
        self._append(folder / EVENTS, EVENT_COLUMNS)
        write_json(folder / DESCRIPTION, {"format": SESSION_FORMAT, **about})
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread = Thread(target=self._work, daemon=True, name="femsense-recorder")
        self._thread.start()

    @property
    def lost(self) -> Lost:
        """Frames that were not written."""
        return self._lost

    def keep(self, frame: StampedFrame, values: FloatArray, *, contact_free: bool) -> bool:
        """Record a processed frame with its inputs, shape (columns,); return whether it was accepted."""
        row = [frame.number, frame.time_s, *values.tolist(), int(contact_free)]
        if not self._put(_Job(lambda: self._frame(self.folder, frame, row), True), self._most):
            self._lost = replace(self._lost, sensed=self._lost.sensed + 1)
            return False
        return True

    def skip(self, frame: StampedFrame, values: FloatArray | None) -> bool:
        """Record a skipped frame with its inputs, if known; return whether it was accepted."""
        known = np.full(len(self._columns), np.nan) if values is None else values
        row = [frame.number, frame.time_s, *known.tolist()]
        if not self._has_skipped:
            self._has_skipped = True
            self._put(_Job(lambda: self._begin(self.folder / SKIPPED), False), self._most)
        if not self._put(_Job(lambda: self._frame(self.folder / SKIPPED, frame, row), True), self._most // 2):
            self._lost = replace(self._lost, skipped=self._lost.skipped + 1)
            return False
        return True

    def answer(self, answer: Answer) -> None:
        """Record the result of a frame."""
        contacts = [_plain(asdict(contact)) for contact in answer.contacts]
        line = json.dumps({"report": asdict(answer.report), "contacts": contacts}).encode() + b"\n"
        states = answer.positions.astype("<f4").tobytes()
        self._put(_Job(lambda: self._answer(line, states), False), self._most)

    def event(self, event: SessionEvent, begun_s: float) -> None:
        """Record an event that begins or is over; `begun_s`: start of the session [s, monotonic clock]."""
        lasts = event.ended_s == float("inf")
        duration = "" if lasts else f"{event.ended_s - event.begun_s:.3f}"
        row = [f"{event.begun_s - begun_s:.3f}", event.kind.value, event.text, duration, event.count]
        self._put(_Job(lambda: self._append(self.folder / EVENTS, row), False), self._most)

    def copy(self, file: Path, name: str) -> None:
        """Copy a file into the session, synchronously."""
        part = self.folder / f".{name}.part"
        shutil.copyfile(file, part)
        os.replace(part, self.folder / name)

    def close(self) -> None:
        """Complete pending writes and write the run."""
        self._jobs.put(None)
        self._thread.join()
        for file in self._files.values():
            file.close()
        finish_session(self.folder)

    def _put(self, job: _Job, most: int) -> bool:
        with self._lock:
            if job.has_image and (self._waiting >= most or self.error):
                return False
            self._waiting += job.has_image
        self._jobs.put(job)
        return True

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                if not self.error:
                    job.run()
            except OSError as error:  # for example a full disk: sensing continues
                self.error = f"recording has stopped: {error.strerror or error}"
            with self._lock:
                self._waiting -= job.has_image

    def _begin(self, folder: Path, *more: str) -> None:
        folder.mkdir(exist_ok=True)
        write_toml(folder / "recording.toml", self._document)
        self._append(folder / "frames.csv", ["frame", "time_s", *self._columns, *more])

    def _frame(self, folder: Path, frame: StampedFrame, row: Sequence[object]) -> None:
        for image in frame.raw.images:
            file = folder / image_file(image, frame.number, self._views)
            file.parent.mkdir(parents=True, exist_ok=True)
            self._write(file, image.data)
        if any(isinstance(value, float) and np.isnan(value) for value in row):
            return  # without inputs an image has no row
        self._append(folder / "frames.csv", row)
        if frame.raw.markers:  # after the row: a marker of a missing frame would be an error
            named = self._views != ("",)
            if str(folder / "markers.csv") not in self._files:
                self._append(folder / "markers.csv", ["frame", *(["camera"] if named else []), "marker", "x_m", "y_m", "z_m"])
            for one in frame.raw.markers:
                view = [self._views[one.view]] if named else []
                self._append(folder / "markers.csv", [frame.number, *view, one.name, *one.xyz_m])

    def _answer(self, line: bytes, states: bytes) -> None:
        for name, data in ((STATES, states), (JOURNAL, line)):
            self._file(self.folder / RUN / name).write(data)

    def _append(self, path: Path, cells: Sequence[object]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(cells)
        self._file(path).write(text.getvalue().encode())

    def _file(self, path: Path) -> BinaryIO:
        """Return an open file that writes each piece immediately and completely."""
        if str(path) not in self._files:
            self._files[str(path)] = path.open("ab", buffering=0)
        return self._files[str(path)]


# The run of a session


def finish_session(folder: Path) -> bool:
    """Write the run of a session from its journal, and those of its tares; return whether there was one.

    Killed sessions are completed too, up to the last complete line of the journal.
    """
    from femsense.calib.files import read_calibration
    from femsense.sensing.run_files import run_inputs, write_run
    from femsense.sensing.types import ContactForce, FrameReport, Run, States

    for part in sorted(folder.glob("tare-*")):
        finish_session(part)
    _merge_events(folder / EVENTS)
    journal, states = folder / RUN / JOURNAL, folder / RUN / STATES
    if not journal.is_file() or not states.is_file():
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # shown during the session
        robot = load_robot(json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))["robot"])
        recording, calibration = load_recording(folder), read_calibration(folder / CALIBRATION)
    nodes = robot.body.mesh.nodes
    whole = journal.read_bytes().rpartition(b"\n")[0].splitlines()
    moved = np.fromfile(states, dtype="<f4")
    count = min(len(whole), len(moved) // nodes.size)
    if not count:
        return False
    moved = moved[: count * nodes.size].reshape(count, -1, 3)
    answers = [json.loads(line) for line in whole[:count]]
    reports = [FrameReport(**answer["report"]) for answer in answers]
    contacts = tuple(ContactForce(**_arrays(row)) for answer in answers for row in answer["contacts"])
    run = Run(
        contacts=contacts,
        frames=tuple(reports),
        states=States(freeze([r.time_s for r in reports]), freeze(moved, np.float32), robot.body.mesh.tets, nodes),
        robot=robot,
        recording_folder=folder.absolute(),
    )
    write_run(run, folder / RUN, inputs=run_inputs(robot, recording, calibration), calibration=calibration)
    for file in (journal, states):
        with suppress(OSError):
            file.unlink()
    return True


def _merge_events(file: Path) -> None:
    """Keep the last row of each event: it was written when it began, and again with duration and count when it was over."""
    if not file.is_file():
        return
    with file.open(newline="", encoding="utf-8") as stream:
        header, *rows = csv.reader(stream)
    last = {(row[0], row[1]): row for row in rows if len(row) == len(header)}
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *sorted(last.values(), key=lambda row: float(row[0]))])
    write_whole(file, text.getvalue().encode())


def session_run(folder: str | Path) -> Path:
    """Return the folder of a session's run, completing a killed session first; any other folder unchanged."""
    root = Path(folder).expanduser()
    if not (root / DESCRIPTION).is_file() or not (root / RUN).is_dir():
        return root
    if (root / RUN / JOURNAL).is_file():
        finish_session(root)
    return root / RUN


def _plain(table: dict[str, Any]) -> dict[str, Any]:
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in table.items()}


def _arrays(table: dict[str, Any]) -> dict[str, Any]:
    return {name: freeze(value) if isinstance(value, list) else value for name, value in table.items()}
