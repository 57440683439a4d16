"""A session: frames and inputs arrive, a calibration is made, and each newest frame is processed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from threading import Event, Lock

import numpy as np

from femsense.calib.calibrate import calibrate
from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration, write_calibration
from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.text import numbers_text
from femsense.io.clouds.frame_clouds import read_frame_cloud
from femsense.io.recording_tables import GRAVITY_COLUMNS
from femsense.live.actuation import Actuation, FixedActuation, FrameActuation, columns_of
from femsense.live.calibrating import Coverage, CoverageLimits, MovingInput, insufficiency
from femsense.live.drift import DriftLimits, DriftWatch
from femsense.live.events import EventLog, Milestone, Notice
from femsense.live.feed import CameraFeed
from femsense.live.figures import Snapshot, Stopwatch
from femsense.live.frames import StampedFrame
from femsense.live.growing import GrowingRecording, empty_recording
from femsense.live.link import LOST
from femsense.live.recorder import CALIBRATION, Lost, Recorder
from femsense.live.senser import Answer, Senser
from femsense.live.sources.source import SourceInfo
from femsense.model.recording import Recording
from femsense.model.robot import Robot

POLL_S = 0.1
MOST_CALIBRATIONS = 4
RECENT_S = 1.0
"""A state in which there was a contact this long ago is no contact-free reference [s]."""
PATIENCE = "seconds, or a minute for quadratic elements; movements and touches do not matter meanwhile"
"""Instruction during computations: frames that arrive are skipped."""
STROKE = 0.1
"""Assumed largest displacement of a cable, as a share of the body's diagonal."""
ACTUATION = (Notice.ACTUATION_LATE, Notice.ACTUATION_FROZEN, Notice.ACTUATION_AWAY)


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
        self.log: EventLog = feed.log
        self._stop, self._tare, self._tare_anyway, self._accept = Event(), Event(), Event(), Event()
        self._phase, self._todo = Phase.CONNECTING, ""
        self._columns: tuple[str, ...] = ()
        self._coverage: Coverage | None = None
        self._calibration: Calibration | None = None
        self._calibrations = self._tares = 0
        self._lacks = ""
        self._growing: GrowingRecording | None = None
        self._recorder: Recorder | None = None
        self._recorders: list[Recorder] = []
        self._senser: Senser | None = None
        self._drift = DriftWatch(robot.body.mesh, self.options.drift)
        self._ages = Stopwatch()
        self._answer: Answer | None = None
        self._taken_s = float("nan")
        self._touched_s = float("-inf")
        """Exposure time of the last frame that was not contact-free [s, monotonic clock]."""
        self._used = 0
        self._lost_logged = 0
        self._watching = Lock()

    # For other threads

    def stop(self) -> None:
        """End the session after the current frame."""
        self._stop.set()

    def tare(self, *, anyway: bool = False) -> None:
        """Use the state from the next frame on as contact-free reference; refused during a contact, unless `anyway`."""
        (self._tare_anyway if anyway else self._tare).set()

    def accept_fixed(self) -> None:
        """Calibrate although not all inputs have moved."""
        self._accept.set()

    def skipped(self, frame: StampedFrame) -> None:
        """Record a frame that was not used; called by the feed."""
        recorder = self._recorder
        if recorder is not None:
            recorder.skip(frame, None if not self._columns else self._values(frame))

    def watch(self) -> None:
        """Log problems of inputs and recording."""
        with self._watching:
            found = self._actuation.notices()
            for kind in ACTUATION:
                self.log.lasts(kind, found.get(kind, ""))
            lost, error = self.lost, "" if self._recorder is None else self._recorder.error
            text = f"{lost.count} frames so far: {error or 'the disk is too slow'}" + (
                f"; {lost.sensed} of them were processed: a replay differs from there on" if lost.sensed else ""
            )
            if error:
                self.log.lasts(Notice.RECORDING_LOST, text)
            elif lost.count > self._lost_logged:
                self.log.happened(Notice.RECORDING_LOST, text, lost.count - self._lost_logged)
            self._lost_logged = lost.count
            self.log.tick()

    @property
    def lost(self) -> Lost:
        """Number of frames that were not recorded, in all parts."""
        return Lost(sum(one.lost.sensed for one in self._recorders), sum(one.lost.skipped for one in self._recorders))

    def snapshot(self) -> Snapshot:
        """Return the displayed state of the session."""
        info, folder = self.feed.info, self.options.folder
        return Snapshot(
            phase=self._phase,
            todo=self._todo,
            link=self.feed.status,
            camera="" if info is None else info.name,
            link_speed="" if info is None else info.link,
            answer=self._answer,
            taken_s=self._taken_s,
            latency=self._ages.latency(),
            counts=self.feed.counts,
            used=self._used,
            lost=self.lost,
            notices=tuple(event for event in self.log.recent() if isinstance(event.kind, Notice)),
            begun_s=self.log.begun_s,
            recording="" if folder is None else str(folder),
            parts=tuple(str(one.folder) for one in self._recorders[1:]),
        )

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
        self.watch()
        is_asked = self._tare.is_set() or self._tare_anyway.is_set()
        if is_asked and (frame is not None or self.feed.status.state in LOST):
            self._asked_to_tare(frame)
        if frame is None or not (frame.raw.images or frame.raw.markers):
            return None
        if self._growing is None:
            self._begin_part(frame)
        values = self._values(frame)
        if values is None:
            self._todo = "waiting for the first inputs of the robot"
            self.skipped(frame)
            return None
        if self._phase is Phase.SENSING:
            return self._sense(frame, values)
        self._collect(frame, values)
        return None

    def close(self) -> None:
        """Stop camera and actuation, and finish what was recorded."""
        self.feed.close()
        self._actuation.close()
        self.watch()
        self.log.end()
        if self._recorder is not None:
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
        folder = options.folder if options.folder is None or not self._tares else options.folder / f"tare-{self._tares}"
        empty = empty_recording(
            self.robot, info, actuation=kind, actuation_zero=zero, folder=folder or Path(self._scratch.name), gravity=gravity
        )
        self._growing = GrowingRecording(empty, self._scratch)
        if folder is None:
            self.log.write_to(lambda _: None)
        else:
            about = {"robot": str(self.robot.folder), "camera": self.feed.text, "device": info.name, "link": info.link}
            self._recorder = Recorder(folder, empty, self._columns, about, most_waiting=options.most_waiting)
            self._recorders.append(self._recorder)
            begun_s, recorder = self.log.begun_s, self._recorder
            self.log.write_to(lambda event: recorder.event(event, begun_s))
        if self._calibration is None and options.calibration is not None:
            self._calibration = read_calibration(options.calibration)
        limits, moving = options.coverage, self._moving_inputs(kind)
        if self._calibration is not None:  # the inputs need not move
            limits, moving = replace(limits, frames=max(1, options.contact_free_frames), wait_s=0.0), []
        self._coverage = Coverage(moving, limits)
        self._phase = Phase.COLLECTING
        self.log.lasts(Notice.CONTACT_FREE, info.contact_free)

    def _moving_inputs(self, kind: str) -> list[MovingInput]:
        """Return the inputs that have to move before a calibration; constants cannot."""
        body = self.robot.body
        if isinstance(self._actuation, FixedActuation):
            return []
        stroke_m = STROKE * float(np.linalg.norm(np.ptp(body.mesh.nodes, axis=0)))
        cables = [c.max_tension for c in body.cables] if kind == "tension" else [stroke_m] * len(body.cables)
        unit = "N" if kind == "tension" else "m"
        found = [MovingInput(f"cable_{name}", largest, unit) for name, largest in zip(body.cable_names, cables)]
        return found + [MovingInput(f"chamber_{c.name}", c.max_pressure, "Pa") for c in body.chambers]

    def _collect(self, frame: StampedFrame, values: FloatArray) -> None:
        """Keep a frame that adds coverage, and continue when the coverage suffices."""
        coverage, growing = self._coverage, self._growing
        assert coverage is not None and growing is not None
        known = self._calibration is not None
        if self._accept.is_set():
            coverage.accept_fixed()
        is_kept = frame.raw.contact_free is not False and coverage.offer(frame.time_s, values[: len(coverage.inputs)])
        if is_kept:
            self._keep(frame, values, contact_free=True)
        else:
            self.skipped(frame)
        if coverage.suffices:
            if known or self._calibrate(growing.recording, coverage):
                self._learn(growing)
            return
        doing = "touch nothing" if known else "move the cables, touch nothing"
        after = f" (the last calibration did not suffice: {self._lacks})" if self._lacks else ""
        self._todo = f"{doing}: {coverage.missing}{after}"

    def _calibrate(self, recording: Recording, coverage: Coverage) -> bool:
        """Calibrate with the frames so far; return whether the result is accurate enough, and require more frames if not.

        Raises DataError after MOST_CALIBRATIONS attempts.
        """
        self._phase, self._todo = Phase.CALIBRATING, f"from {recording.frame_count} frames; {PATIENCE}"
        self._calibrations += 1
        try:
            found = calibrate(self.robot, recording)
            lacks = insufficiency(found, self.options.coverage)
        except DataError as error:
            found, lacks = None, " ".join(str(error).split())
        if found is not None and not lacks:
            file = write_calibration(found, self._scratch / CALIBRATION)
            self._calibration = read_calibration(file)  # with the digits that a replay reads
            frames = numbers_text(recording.frame_numbers.tolist())
            self.log.happened(Milestone.CALIBRATION, f"from frames {frames}: {found!r}")
            return True
        if self._calibrations >= MOST_CALIBRATIONS:
            raise DataError(
                f"no sufficient calibration after {coverage.count} contact-free frames: {lacks}\n"
                "  try:      larger movements of all inputs, a camera closer to the robot, or -c with a calibration"
            )
        self._lacks = lacks
        self.log.happened(Milestone.CALIBRATION, f"not sufficient: {lacks}")
        coverage.want_more()
        self._phase = Phase.COLLECTING
        return False

    def _learn(self, growing: GrowingRecording) -> None:
        """Estimate noise and model error from the contact-free frames, and process these frames, as a replay does."""
        self._phase, self._todo = Phase.LEARNING, PATIENCE
        self.log.lasts(Notice.CONTACT_FREE, "")
        assert self._calibration is not None
        if self._recorder is not None:
            self._recorder.copy(write_calibration(self._calibration, self._scratch / CALIBRATION), CALIBRATION)
        self._senser = Senser(self.robot, growing.recording, self._calibration)
        for k in range(growing.recording.frame_count):
            self._record(self._senser.sense(growing.recording, k))
        self._phase, self._todo = Phase.SENSING, ""

    def _asked_to_tare(self, frame: StampedFrame | None) -> None:
        """Begin a new part with the present state as reference, unless there is a contact: the reference would hide its force."""
        anyway, hidden = self._tare_anyway.is_set(), ""
        self._tare.clear()
        self._tare_anyway.clear()
        if frame is None:
            refusal = "the camera is lost: press t again when its frames arrive"
        elif self._phase is not Phase.SENSING or self._answer is None:
            refusal = "nothing is sensed yet: press t again once forces are shown"
        else:
            hidden = self._recent_contact(self._answer, frame)
            advice = "the reference would hide it. Let go of the robot and press t again; T zeroes all the same"
            refusal = f"{hidden}: {advice}" if hidden and not anyway else ""
        if frame is None or refusal:
            self.log.happened(Notice.NOT_ZEROED, refusal)
            return
        self._tares += 1
        self.log.lasts(Notice.DRIFT, "")
        self.log.happened(Milestone.ZERO, f"reference {self._tares}" + (f", which hides {hidden}" if hidden else ""))
        self.log.leave()
        if self._recorder is not None:
            self._recorder.close()
        self._drift = DriftWatch(self.robot.body.mesh, self.options.drift)
        self._begin_part(frame)

    def _recent_contact(self, last: Answer, frame: StampedFrame) -> str:
        """Return why the last results are not contact-free, in words; empty if they are."""
        if last.contacts:
            return f"a contact of {sum(contact.force_n for contact in last.contacts):.2f} N in frame {last.report.frame}"
        if not last.is_ok:
            return f"frame {last.report.frame} is not ok ({last.report.status})"
        return f"a contact less than {RECENT_S:g} s ago" if frame.taken_s - self._touched_s < RECENT_S else ""

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
        if not answer.is_contact_free:
            self._touched_s = frame.taken_s
        self._ages.add(now, now - frame.taken_s)
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
            self.log.lasts(Notice.DRIFT, drift.text)


def _actuation_of(info: SourceInfo, options: SessionOptions, *, own: bool) -> tuple[str, str]:
    """Return kind and zero of the inputs: of the recording that contains them, else of the options."""
    if own and info.actuation is not None:
        return info.actuation, info.actuation_zero
    return options.actuation, options.actuation_zero
