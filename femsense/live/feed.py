"""Frames of a camera in the process of the session: the newest frame, a count of skipped ones, and reconnection."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from threading import Condition, Event, Thread

from femsense.core.errors import FemsenseError
from femsense.live.camera_process import Failed, Lost, Report, Request, RingPlace, run_camera
from femsense.live.events import EventLog, Notice
from femsense.live.frames import StampedFrame, read_frame
from femsense.live.growing import PREFIX
from femsense.live.link import ADVICE, FINAL, Link, LinkEvent, LinkLimits, LinkState, LinkStatus
from femsense.live.ring import Ring
from femsense.live.sources.source import Loss, Opening, SourceInfo
from femsense.live.watch import FrameWatch, WatchLimits

TICK_S = 0.05
EVENT_OF = {Loss.UNPLUGGED: LinkEvent.UNPLUGGED, Loss.REFUSED: LinkEvent.REFUSED, Loss.ENDED: LinkEvent.ENDED}


@dataclass(frozen=True, slots=True)
class FeedOptions:
    """Options of reading a camera."""

    as_fast_as_possible: bool = False
    ring: str = ""
    """Prefix of the names of its shared memory; empty: derived from the process."""
    link: LinkLimits = field(default_factory=LinkLimits)
    watch: WatchLimits = field(default_factory=WatchLimits)


@dataclass(frozen=True, slots=True)
class FeedCounts:
    """Number of frames so far."""

    received: int = 0
    skipped: int = 0
    """Received and replaced by a newer one before they were used."""
    missed: int = 0
    """Delivered by the device while this machine was too busy to receive them."""
    dropped: int = 0
    """Counted by the device, and not delivered by it or its link."""


class CameraFeed:
    """A camera that is read in its own process; a context manager."""

    def __init__(
        self, text: str, options: FeedOptions | None = None, *, on_skipped: Callable[[StampedFrame], None] = lambda _: None
    ) -> None:
        """Start the camera.

        Arguments:
            text: as `make_source` takes it.
            options: limits.
            on_skipped: called in the feed's thread with every frame that was not used.
        """
        self.text, self.options = text, options or FeedOptions()
        self.log = EventLog(time.monotonic())
        """Events since the start: states of the link and problems of the frames."""
        self.info: SourceInfo | None = None
        self.error: FemsenseError | None = None
        """Why the source is unusable."""
        self._on_skipped = on_skipped
        self._counts = FeedCounts()
        self._watch = FrameWatch(self.log, self.options.watch, by_stamps=self.options.as_fast_as_possible)
        self._link = Link(self.log.begun_s, self.options.link)
        self._logged = LinkState.STREAMING
        self._opened_s = float("nan")
        """When the source was first opened [s]."""
        self._newest: StampedFrame | None = None
        self._changed = Condition()
        self._stop = Event()
        self._last_number = -1
        self._asked = False
        """Whether a requested frame has not arrived yet."""
        self._rings = 0
        self._ring: Ring | None = None
        self._process: BaseProcess | None = None
        self._pipe: Connection | None = None
        self._start(0)
        self._thread = Thread(target=self._run, daemon=True, name="femsense-camera")
        self._thread.start()

    @property
    def status(self) -> LinkStatus:
        """State of the link."""
        return self._link.status

    @property
    def losses(self) -> int:
        """Number of times that the stream was lost."""
        return self._link.losses

    @property
    def counts(self) -> FeedCounts:
        """Number of frames so far."""
        return replace(self._counts, missed=self._watch.missed, dropped=self._watch.dropped)

    @property
    def is_over(self) -> bool:
        """Whether no more frames will arrive."""
        return self.error is not None or (self.status.state in FINAL and self._newest is None)

    def take(self, timeout_s: float) -> StampedFrame | None:
        """Return the newest frame that was not returned yet; None if none arrives in time or none will arrive.

        Raises FemsenseError if the source is unusable.
        """
        if self.options.as_fast_as_possible and self._newest is None and not self._asked and self._ring is not None:
            self._asked = True
            self._send(Request.NEXT)
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self.is_over or self._stop.is_set(), timeout_s)
            frame, self._newest = self._newest, None
        if self.error is not None:
            raise self.error
        return frame

    def close(self) -> None:
        """Stop the camera and end its process, even if it hangs."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        self._thread.join(2.0)
        self._end_process(patience_s=1.0)

    def __enter__(self) -> CameraFeed:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # In the thread of the feed

    def _run(self) -> None:
        while not self._stop.is_set():
            self._read()
            if self.options.as_fast_as_possible and self._ring is not None and not self._asked:
                self._link.rest(time.monotonic())
            is_due = self._link.tick(time.monotonic())
            self._log_link()
            if is_due:
                self._end_process(patience_s=0.0)
                self._start(self._link.status.attempts)
            if self.is_over:
                with self._changed:
                    self._changed.notify_all()

    def _read(self) -> None:
        pipe = self._pipe
        if pipe is None:
            self._stop.wait(TICK_S)
            return
        try:
            while pipe.poll(TICK_S) and not self._stop.is_set():
                self._take_in(pipe.recv())
                self._log_link()
                if self._pipe is not pipe:
                    return
        except (EOFError, OSError):
            self._pipe = None
            if self.status.state not in FINAL and self.error is None:
                self._link.feed(LinkEvent.DIED, time.monotonic(), "the camera driver crashed")

    def _take_in(self, report: Report) -> None:
        now = time.monotonic()
        if isinstance(report, Opening):
            self._opened_s = report.begun_s
        elif isinstance(report, SourceInfo):
            self._opened(report)
            self._link.feed(LinkEvent.OPENED, now)
        elif isinstance(report, int):
            self._receive(report)
        elif isinstance(report, Lost):
            self._pipe = None
            self._link.feed(EVENT_OF[report.loss], now, report.text)
        elif isinstance(report, Failed):
            self._pipe, self.error = None, report.error

    def _opened(self, info: SourceInfo) -> None:
        self.info = info
        self._link.longest_wait_s = info.longest_wait_s
        slow = f"{info.link}: use a USB 3 port and the cable that came with the camera"
        self.log.lasts(Notice.SLOW_LINK, slow if info.is_slow_link else "")
        if self._ring is None or self._ring.slot_bytes < info.largest_frame:
            if self._ring is not None:
                self._ring.close()
            self._rings += 1
            self._ring = Ring(
                info.largest_frame, f"{self.options.ring or f'{PREFIX}{os.getpid()}-{id(self):x}'}-{self._rings}", is_new=True
            )
        self._send(RingPlace(self._ring.name, self._ring.slot_bytes))

    def _receive(self, ticket: int) -> None:
        data = None if self._ring is None else self._ring.read(ticket)
        self._link.feed(LinkEvent.FRAME, time.monotonic())
        self._asked = False
        if data is None:
            self._watch.unread()
            self._counts = replace(self._counts, received=self._counts.received + 1, skipped=self._counts.skipped + 1)
            return
        raw = read_frame(data)
        self._last_number = raw.number
        frame = self._watch.stamp(raw)
        with self._changed:
            skipped, self._newest = self._newest, frame
            self._changed.notify_all()
        more = skipped is not None
        self._counts = replace(self._counts, received=self._counts.received + 1, skipped=self._counts.skipped + more)
        if skipped is not None:
            self._on_skipped(skipped)

    def _start(self, attempt: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        opening = Opening(self._opened_s, attempt, self._last_number)
        arguments = (other, self.text, self.options.as_fast_as_possible, opening)
        self._process = context.Process(target=run_camera, args=arguments, daemon=True, name="femsense-camera")
        self._process.start()
        other.close()
        self._watch.reconnected()
        self._asked = False

    def _log_link(self) -> None:
        """Log the state of the link, except that frames arrive."""
        status = self._link.status
        text, is_new = status.reason or ADVICE[status.state] or str(status.state), status.state is not self._logged
        if is_new:
            self.log.lasts(self._logged, "")
            self._logged = status.state
        if status.state in FINAL and is_new:
            self.log.happened(status.state, text)
        elif status.state not in (LinkState.STREAMING, *FINAL):
            self.log.lasts(status.state, text)

    def _send(self, message: object) -> None:
        pipe = self._pipe
        if pipe is not None:
            with suppress(OSError):  # a closed pipe is noticed when it is read
                pipe.send(message)

    def _end_process(self, *, patience_s: float) -> None:
        self._send(Request.STOP)
        process, pipe = self._process, self._pipe
        self._process = self._pipe = None
        if process is not None:
            process.join(patience_s)
            if process.is_alive():
                process.kill()
                process.join(5.0)
        if pipe is not None:
            pipe.close()
        if self._stop.is_set() and self._ring is not None:
            self._ring.close()
            self._ring = None
