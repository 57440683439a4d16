"""Rates and latencies of a session, over the last seconds."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from femsense.live.events import SessionEvent
from femsense.live.feed import FeedCounts
from femsense.live.link import LinkStatus
from femsense.live.recorder import Lost
from femsense.live.senser import Answer

NAN = float("nan")
WINDOW_S = 10.0


@dataclass(frozen=True, slots=True)
class Latency:
    """Time from the exposure of a frame to its forces."""

    p50_s: float = NAN
    p95_s: float = NAN
    p99_s: float = NAN
    rate_hz: float = NAN
    """Processed frames per second."""


class Stopwatch:
    """Ages of results at the time they are available."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_s = window_s
        self._kept: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, age_s: float) -> None:
        """Add a result of this age [s] at a time [s]."""
        self._kept.append((now_s, age_s))
        while self._kept[0][0] < now_s - self._window_s:
            self._kept.popleft()

    def latency(self) -> Latency:
        """Return the percentiles and the rate over the window; nan before the first results."""
        if not self._kept:
            return Latency()
        ages = np.array([age for _, age in self._kept])
        p50, p95, p99 = (float(value) for value in np.percentile(ages, (50, 95, 99)))
        span = self._kept[-1][0] - self._kept[0][0]
        return Latency(p50, p95, p99, (len(self._kept) - 1) / span if span > 0 else NAN)


@dataclass(frozen=True, eq=False, slots=True)
class Snapshot:
    """The displayed state of a session at one moment."""

    phase: str
    """One of `Phase`."""
    todo: str
    """The current instruction to the user; empty if there is none."""
    link: LinkStatus
    camera: str = ""
    link_speed: str = ""
    answer: Answer | None = None
    """The last result; it remains while the camera is lost."""
    taken_s: float = NAN
    """Exposure time of its frame [s, monotonic clock]."""
    latency: Latency = field(default_factory=Latency)
    counts: FeedCounts = field(default_factory=FeedCounts)
    used: int = 0
    lost: Lost = field(default_factory=Lost)
    notices: tuple[SessionEvent, ...] = ()
    """Problems that last or have just ended."""
    begun_s: float = 0.0
    """Start of the session [s, monotonic clock]."""
    recording: str = ""
    """Folder of the recording; empty: not recorded."""
    parts: tuple[str, ...] = ()
    """Folders of the parts after each zero."""
