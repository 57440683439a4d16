"""A session: frames and inputs arrive, a calibration is made, and each newest frame is processed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from threading import Event

import numpy as np

from femsense.calib.calibrate import calibrate
from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration, write_calibration
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.recording_tables import GRAVITY_COLUMNS
from femsense.live.actuation import Actuation, FrameActuation, columns_of
from femsense.live.calibrating import Coverage, CoverageLimits, insufficiency
from femsense.live.drift import DriftLimits, DriftWatch
from femsense.live.feed import CameraFeed
from femsense.live.figures import Snapshot, Stopwatch
from femsense.live.frames import StampedFrame
from femsense.live.growing import GrowingRecording, empty_recording
from femsense.live.link import LinkState
from femsense.live.recorder import CALIBRATION, Recorder
from femsense.live.senser import Answer, Senser
from femsense.live.sources.source import SourceInfo
from femsense.live.watch import Notice
from femsense.model.recording import Recording
from femsense.model.robot import Robot

POLL_S = 0.1
MORE_FRAMES, MOST_CALIBRATIONS = 6, 4
"""Number of further frames after a calibration that was not accurate enough, and maximum number of calibrations."""


class Phase(StrEnum):
    """Activity of a session."""

    CONNECTING = "connecting"
    COLLECTING = "collecting contact-free frames"
    CALIBRATING = "calibrating"
    LEARNING = "learning from the contact-free frames"
    SENSING = "sensing"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Options of a session."""

    calibration: Path | None = None
    """Calibration file; None: calibrate during the session."""
    folder: Path | None = None
    """Folder of the recording; None: not recorded."""
    actuation: str = "tension"
    """Kind of the inputs; ignored if the inputs come from a recording."""
    actuation_zero: str = "absolute"
    contact_free_frames: int = 8
    """Number of contact-free frames with a given calibration, and after a tare: they determine noise and model error before sensing."""
    most_waiting: int = 256
    """Maximum number of frames that wait for the disk."""
    coverage: CoverageLimits = field(default_factory=CoverageLimits)
    drift: DriftLimits = field(default_factory=DriftLimits)


class Session:
    """One camera and one robot, from frames to forces."""

    def __init__(
        self,
        robot: Robot,
        feed: CameraFeed,
        scratch: Path,
        *,
        actuation: Actuation | None = None,
        options: SessionOptions | None = None,
        on_answer: Callable[[Answer, float], None] = lambda _answer, _taken: None,
    ) -> None:
        """Prepare; `run` starts the work.

        Arguments:
            robot: loaded from a folder.
            feed: of the camera; connect its skipped frames to `skipped`.
            scratch: folder for images that wait for processing.
            actuation: source of the inputs; None: inputs that are part of the frames, as in a recording.
            options: calibration, recording, limits.
            on_answer: called with each result and the exposure time of its frame [s, monotonic clock].
        """
        self.robot, self.feed, self.options = robot, feed, options or SessionOptions()
        self._scratch, self._on_answer = scratch, on_answer
        self._actuation: Actuation | FrameActuation = actuation or FrameActuation(columns_of(robot))
        self._stop, self._tare = Event(), Event()
        self._phase, self._todo, self._notices = Phase.CONNECTING, "", dict[Notice, str]()
        self._columns: tuple[str, ...] = ()
        self._coverage: Coverage | None = None
        self._calibration: Calibration | None = None
        self._calibrations = self._tares = 0
        self._lacks = ""
        self._growing: GrowingRecording | None = None
        self._recorder: Recorder | None = None
        self._senser: Senser | None = None
        self._drift = DriftWatch(robot.body.mesh, self.options.drift)
        self._watch = Stopwatch()
        self._answer: Answer | None = None
        self._taken_s = float("nan")
        self._used = 0
        self._folder = self.options.folder
        self._said: dict[str, str] = {}

    # For other threads

    def stop(self) -> None:
        """End the session after the current frame."""
        self._stop.set()

    def tare(self) -> None:
        """Use the state from the next frame on as contact-free reference."""
        self._tare.set()

    def note(self, notice: Notice, text: str) -> None:
        """Show a problem outside of the session; an empty text removes it."""
        if text:
            self._notices[notice] = text
        else:
            self._notices.pop(notice, None)

    def skipped(self, frame: StampedFrame) -> None:
        """Record a frame that was not used; called by the feed."""
        recorder = self._recorder
        if recorder is not None:
            recorder.skip(frame, None if not self._columns else self._values(frame))

    def snapshot(self) -> Snapshot:
        """Return the displayed state of the session."""
        feed, recorder = self.feed, self._recorder
        notices = {**feed.notices, **self._actuation.notices(), **self._notices}
        lost = None if recorder is None else recorder.lost
        if recorder is not None and (recorder.lost.count or recorder.error):
            text = recorder.error or f"{recorder.lost.count} frames: the disk is too slow"
            sensed = (
                f"; {recorder.lost.sensed} of them were processed: a replay differs from there on" if recorder.lost.sensed else ""
            )
            notices[Notice.RECORDING_LOST] = text + sensed
        shown = Snapshot(
            phase=self._phase,
            todo=self._todo,
            link=feed.status,
            camera="" if feed.info is None else feed.info.name,
            link_speed="" if feed.info is None else feed.info.link,
            answer=self._answer,
            taken_s=self._taken_s,
            latency=self._watch.latency(),
            counts=feed.counts,
            used=self._used,
            notices=notices,
            recording="" if self._folder is None else str(self._folder),
        )
        return shown if lost is None else replace(shown, lost=lost)

    # In the thread of the session

    def run(self) -> None:
        """Process frames until the camera ends or `stop` is called. The folder is then a recording and a run.

        Raises:
            FemsenseError: an unusable source, or no calibration that is accurate enough.
        """
        try:
            while not self._stop.is_set() and not self.feed.is_over:
                self.step(POLL_S)
        finally:
            self.close()

    def step(self, timeout_s: float) -> Answer | None:
        """Process the newest frame according to the phase; return the result if it was sensed."""
        frame = self.feed.take(timeout_s)
        self._log()
        if frame is None or not (frame.raw.images or frame.raw.markers):
            return None
        if self._growing is None:
            self._begin_part(frame)
        values = self._values(frame)
        if values is None:
            self._todo = "waiting for the first inputs of the robot"
            self.skipped(frame)
            return None
        if self._tare.is_set() and self._phase is Phase.SENSING:
            self._begin_tare(frame)
        if self._phase is Phase.SENSING:
            return self._sense(frame, values)
        self._collect(frame, values)
        return None

    def close(self) -> None:
        """Stop camera and actuation, and finish what was recorded."""
        self.feed.close()
        self._actuation.close()
        if self._recorder is not None:
            self._log()
            self._recorder.close()
            self._recorder = None
        self._phase, self._todo = Phase.ENDED, "" if self._used else self._todo

    def _values(self, frame: StampedFrame) -> FloatArray | None:
        """Return inputs, and gravity if frames contain it, at the time of a frame, shape (columns,); None while unknown."""
        told, source = dict(frame.raw.inputs), self._actuation
        if isinstance(source, FrameActuation):
            values: FloatArray | None = source.of(told, self.feed.text)
        else:
            values = source.at(frame.taken_s)
        gravity = [told[name] for name in self._columns if name in GRAVITY_COLUMNS]
        return None if values is None else np.append(values, gravity)

    # Calibration

    def _begin_part(self, frame: StampedFrame) -> None:
        """Start a recording, at the beginning and after a tare."""
        info, options = self.feed.info, self.options
        assert info is not None
        gravity = GRAVITY_COLUMNS[0] in dict(frame.raw.inputs)
        self._columns = (*self._actuation.columns, *(GRAVITY_COLUMNS if gravity else ()))
        kind, zero = _actuation_of(info, options, own=isinstance(self._actuation, FrameActuation))
        place = self._folder or Path(self._scratch.name)
        empty = empty_recording(self.robot, info, actuation=kind, actuation_zero=zero, folder=place, gravity=gravity)
        self._growing = GrowingRecording(empty, self._scratch)
        if self._folder is not None:
            about = {"robot": str(self.robot.folder), "camera": self.feed.text, "device": info.name, "link": info.link}
            self._recorder = Recorder(self._folder, empty, self._columns, about, most_waiting=options.most_waiting)
        if self._calibration is None and options.calibration is not None:
            self._calibration = read_calibration(options.calibration)
        limits = options.coverage
        if self._calibration is not None:
            limits = replace(limits, frames=max(1, options.contact_free_frames), wait_s=0.0)
        moving = () if self._calibration is not None else self._actuation.columns  # with a calibration the inputs need not move
        self._coverage = Coverage(moving, _largest(self.robot)[: len(moving)], limits)
        self._phase = Phase.COLLECTING

    def _collect(self, frame: StampedFrame, values: FloatArray) -> None:
        """Keep a frame that adds coverage, and continue when the coverage suffices."""
        coverage, growing = self._coverage, self._growing
        assert coverage is not None and growing is not None
        known = self._calibration is not None
        told = frame.raw.contact_free is not False and coverage.offer(frame.time_s, values[: len(coverage.columns)])
        if told:
            self._keep(frame, values, contact_free=True)
        else:
            self.skipped(frame)
        doing = "touch nothing" if known else "move the cables, touch nothing"
        after = f" (the last calibration did not suffice: {self._lacks})" if self._lacks else ""
        self._todo = f"{doing}: {coverage.missing}{after}" if coverage.missing else ""
        if told and coverage.suffices and (known or self._calibrate(growing.recording, coverage)):
            self._learn(growing)

    def _calibrate(self, recording: Recording, coverage: Coverage) -> bool:
        """Calibrate with the frames so far; return whether the result is accurate enough, and require more frames if not.

        Raises DataError after MOST_CALIBRATIONS attempts.
        """
        self._phase, self._todo = Phase.CALIBRATING, ""
        self._calibrations += 1
        try:
            found = calibrate(self.robot, recording)
            lacks = insufficiency(found, self.options.coverage)
        except DataError as error:
            found, lacks = None, " ".join(str(error).split())
        if found is not None and not lacks:
            file = write_calibration(found, self._scratch / CALIBRATION)
            self._calibration = read_calibration(file)  # with the digits that a replay reads
            self._note("calibration", repr(found))
            return True
        if self._calibrations >= MOST_CALIBRATIONS:
            raise DataError(f"no sufficient calibration after {coverage.count} contact-free frames: {lacks}")
        self._lacks = lacks
        self._note("calibration", f"not sufficient: {lacks}")
        coverage.want_more(MORE_FRAMES)
        self._phase = Phase.COLLECTING
        return False

    def _learn(self, growing: GrowingRecording) -> None:
        """Estimate noise and model error from the contact-free frames, and process these frames, as a replay does."""
        self._phase, self._todo = Phase.LEARNING, ""
        assert self._calibration is not None
        if self._recorder is not None:
            self._recorder.copy(write_calibration(self._calibration, self._scratch / CALIBRATION), CALIBRATION)
        self._senser = Senser(self.robot, growing.recording, self._calibration)
        for k in range(growing.recording.frame_count):
            self._record(self._senser.sense(growing.recording, k))
        self._phase = Phase.SENSING

    def _begin_tare(self, frame: StampedFrame) -> None:
        """Begin a new part of the session, with the present state as reference."""
        self._tare.clear()
        self._tares += 1
        self._note("tare", f"reference {self._tares}")
        if self._recorder is not None and self.options.folder is not None:
            self._recorder.close()
            self._folder = self.options.folder / f"tare-{self._tares}"
        self._drift = DriftWatch(self.robot.body.mesh, self.options.drift)
        self._notices.pop(Notice.DRIFT, None)
        self._begin_part(frame)

    # Sensing

    def _keep(self, frame: StampedFrame, values: FloatArray, *, contact_free: bool) -> int:
        assert self._growing is not None
        if self._recorder is not None:
            self._recorder.keep(frame, values, contact_free=contact_free)
        return self._growing.add(frame, self._columns, values, contact_free=contact_free)

    def _sense(self, frame: StampedFrame, values: FloatArray) -> Answer:
        assert self._growing is not None and self._senser is not None
        k = self._keep(frame, values, contact_free=False)
        recording = self._growing.recording
        answer = self._senser.sense(recording, k)
        now = time.monotonic()
        self._answer, self._taken_s = answer, frame.taken_s
        self._watch.add(now, now - frame.taken_s)
        self._on_answer(answer, frame.taken_s)
        self._record(answer)
        if answer.is_contact_free and self._drift.is_due(frame.time_s):
            self._measure_drift(recording, k, frame.time_s, answer)
        self._growing.forget(k)
        return answer

    def _record(self, answer: Answer) -> None:
        self._used += 1
        if self._recorder is not None:
            self._recorder.answer(answer)

    def _measure_drift(self, recording: Recording, k: int, time_s: float, answer: Answer) -> None:
        assert self._calibration is not None
        points = []
        for view, T in enumerate(self._calibration.poses):
            cloud = read_frame_cloud(recording, k, view=view)
            points += [] if cloud is None else [cloud.points @ T[:3, :3].T + T[:3, 3]]
        drift = self._drift.measure(time_s, np.vstack(points), answer.positions) if points else None
        if drift is not None:
            self.note(Notice.DRIFT, drift.text)

    # Events

    def _note(self, kind: str, text: str) -> None:
        if self._recorder is not None:
            self._recorder.event(time.monotonic() - self.feed.begun_s, kind, text)

    def _log(self) -> None:
        """Record changes of the link and of the problems."""
        status = self.feed.status
        reason = f": {status.reason}" if status.reason and status.state is not LinkState.STREAMING else ""
        now = {"link": f"{status.state.value}{reason}", **{kind.value: text for kind, text in self.snapshot().notices.items()}}
        for kind, text in now.items():
            if self._said.get(kind) is None or (kind == "link" and self._said[kind] != text):
                self._note(kind, text)
        for kind in self._said.keys() - now.keys():
            self._note(kind, "over")
        self._said = now


def _actuation_of(info: SourceInfo, options: SessionOptions, *, own: bool) -> tuple[str, str]:
    """Return kind and zero of the inputs: of the recording that contains them, else of the options."""
    if own and info.actuation is not None:
        return info.actuation, info.actuation_zero
    return options.actuation, options.actuation_zero


def _largest(robot: Robot) -> Sequence[float]:
    """Return the largest value of each input [N] or [Pa]; inf if none is declared."""
    cables = [cable.max_tension for cable in robot.body.cables]
    return [*cables, *(getattr(chamber, "max_pressure", np.inf) for chamber in robot.body.chambers)]
