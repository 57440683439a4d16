"""What happened in a session and when: problems, states of the link, calibrations. For the display, the record and the summary."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from threading import Lock

MERGE_S = 2.0
"""An event that recurs within this time continues, with a higher count [s]. It bounds the number of events in a long session."""
SAVED_S = 10.0
"""Events that go on are written again at this interval, for a session that is killed [s]."""
SHOWN_S = 10.0
"""Events are displayed for this long after their end [s]."""


class Notice(StrEnum):
    """Problems during a session, of frames, inputs, broker or recording."""

    DROPPED = "frames dropped"
    """Not delivered by the device or its link."""
    MISSED = "frames missed"
    """Delivered while this machine was too busy to take them."""
    STAMPS_BACK = "stamps run back"
    STAMPS_JUMP = "stamps jump"
    OUT_OF_STEP = "cameras out of step"
    FLICKER = "exposure flickers"
    SLOW_LINK = "slow link"
    ACTUATION_LATE = "actuation late"
    ACTUATION_FROZEN = "actuation frozen"
    ACTUATION_AWAY = "actuation away"
    BROKER_AWAY = "broker away"
    RECORDING_LOST = "recording lost frames"
    CONTACT_FREE = "contact-free frames"
    """The frames of a recording that may calibrate."""
    NOT_ZEROED = "not zeroed"
    DRIFT = "drift"


class Milestone(StrEnum):
    """Steps of a session."""

    CALIBRATION = "calibration"
    ZERO = "zero"


@dataclass(frozen=True, slots=True)
class SessionEvent:
    """One event, or several of a kind at most MERGE_S apart."""

    kind: StrEnum
    """A `Notice`, a `Milestone` or a `LinkState`."""
    text: str
    """Of the last occurrence."""
    begun_s: float
    """[s, monotonic clock]."""
    ended_s: float
    """End of the last occurrence [s, monotonic clock]; inf while it lasts."""
    count: int = 1

    def duration_s(self, now_s: float) -> float:
        """Return the time from its beginning to its end, or to now while it lasts [s]."""
        return min(self.ended_s, now_s) - self.begun_s


class EventLog:
    """Collects events of all threads of a session.

    An occurrence of a kind is written when it begins. When its kind has not recurred for MERGE_S, it is written again with duration and count.
    """

    def __init__(self, begun_s: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Arguments: start of the session, and the clock [s, monotonic clock]."""
        self.begun_s, self._clock = begun_s, clock
        self._lock = Lock()
        self._saved_s = begun_s
        self._open: dict[StrEnum, SessionEvent] = {}
        self._newest: dict[StrEnum, SessionEvent] = {}
        self._counts: dict[StrEnum, int] = {}
        self._written: dict[StrEnum, SessionEvent] = {}
        self._unwritten: list[SessionEvent] = []
        self._write: Callable[[SessionEvent], None] | None = None

    def happened(self, kind: StrEnum, text: str, count: int = 1) -> None:
        """Add one or more events without duration."""
        with self._lock:
            now = self._clock()
            self._occurred(kind, text, now, now, count)

    def lasts(self, kind: StrEnum, text: str) -> None:
        """Set a condition that lasts until it is set to an empty text."""
        with self._lock:
            now, old = self._clock(), self._open.get(kind)
            is_on = old is not None and old.ended_s == float("inf")
            if is_on and old is not None:
                if text != old.text:
                    self._put(replace(old, text=text) if text else replace(old, ended_s=now))
            elif text:
                self._occurred(kind, text, now, float("inf"), 1)

    def tick(self) -> None:
        """Write the events that can no longer recur, and from time to time those that have changed."""
        with self._lock:
            now = self._clock()
            for event in [one for one in self._open.values() if one.ended_s < now - MERGE_S]:
                self._close(event)
            if now - self._saved_s >= SAVED_S:
                self._saved_s = now
                for event in [one for kind, one in self._open.items() if one != self._written[kind]]:
                    self._emit(event)

    def write_to(self, write: Callable[[SessionEvent], None]) -> None:
        """Begin to write, first the events that nothing has received yet.

        `write` receives an event when it begins, and again when it is over if it had a duration or recurred.
        """
        with self._lock:
            for event in self._unwritten:
                write(event)
            self._unwritten, self._write = [], write

    def leave(self) -> None:
        """Stop writing: lasting events end here, and begin again where `write_to` continues."""
        with self._lock:
            now = self._clock()
            lasting = [replace(event, begun_s=now, count=1) for event in self._open.values() if event.ended_s > now]
            self._end_all()
            self._write, self._unwritten = None, lasting
            for event in lasting:
                self._put(event)
                self._written[event.kind] = event

    def end(self) -> None:
        """End all lasting events."""
        with self._lock:
            self._end_all()

    def recent(self) -> tuple[SessionEvent, ...]:
        """Return the last event of each kind that lasts or ended at most SHOWN_S ago, the newest last."""
        with self._lock:
            now = self._clock()
            found = [event for event in self._newest.values() if event.ended_s > now - SHOWN_S]
        return tuple(sorted(found, key=lambda event: event.begun_s))

    def totals(self) -> tuple[SessionEvent, ...]:
        """Return the last event of each kind with the count of the session, in the order of their first occurrence."""
        with self._lock:
            return tuple(replace(event, count=self._counts[kind]) for kind, event in self._newest.items())

    def _occurred(self, kind: StrEnum, text: str, begun_s: float, ended_s: float, count: int) -> None:
        self._counts[kind] = self._counts.get(kind, 0) + count
        old = self._open.get(kind)
        if old is not None and old.ended_s < begun_s - MERGE_S:
            self._close(old)
            old = None
        if old is None:
            new = SessionEvent(kind, text, begun_s, ended_s, count)
            self._put(new)
            self._emit(new)
        else:
            self._put(replace(old, text=text, ended_s=ended_s, count=old.count + count))

    def _put(self, event: SessionEvent) -> None:
        self._open[event.kind] = self._newest[event.kind] = event

    def _close(self, event: SessionEvent) -> None:
        del self._open[event.kind]
        self._newest[event.kind] = event
        if event != self._written.get(event.kind):
            self._emit(event)

    def _end_all(self) -> None:
        now = self._clock()
        for event in tuple(self._open.values()):
            self._close(replace(event, ended_s=min(event.ended_s, now)))

    def _emit(self, event: SessionEvent) -> None:
        self._written[event.kind] = event
        if self._write is None:
            self._unwritten.append(event)
        else:
            self._write(event)
