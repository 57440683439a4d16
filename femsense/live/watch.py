"""Checks of frame time stamps: lost frames, clocks that jump or run backwards, unsynchronised cameras, unstable exposure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from femsense.live.clock import ClockMap
from femsense.live.events import EventLog, Notice
from femsense.live.frames import RawFrame, StampedFrame

TICK_S = 1e-6
"""Smallest increase of time from frame to frame of a recording [s]."""


@dataclass(frozen=True, slots=True)
class WatchLimits:
    """Thresholds of the checks."""

    jump_s: float = 1.0
    """A device clock that advances by this much more than the clock of this machine was reset."""
    out_of_step_share: float = 0.5
    """Largest offset between the exposures of two cameras, as a share of the frame period."""
    flicker: float = 0.1
    """Largest relative standard deviation of the exposure time over `window` frames; beyond it auto-exposure interferes with lamps."""
    window: int = 30


class FrameWatch:
    """Assigns session numbers and times to frames, and reports problems."""

    def __init__(self, log: EventLog, limits: WatchLimits | None = None, *, by_stamps: bool = False) -> None:
        """Begin.

        Arguments:
            log: receives the problems; its beginning is time 0 of the session.
            limits: thresholds.
            by_stamps: use the stamps as times, independent of arrival: for a recording that is not replayed at its own speed.
        """
        self.limits, self.by_stamps = limits or WatchLimits(), by_stamps
        self.dropped = 0
        """Frames that the device counted and that neither it nor its link delivered."""
        self.missed = 0
        """Frames that were delivered while this machine was too busy to take them."""
        self._log = log
        self._clock = ClockMap()
        self._number = -1
        self._last: StampedFrame | None = None
        self._latest_s = float("-inf")
        self._unread = 0
        self._exposures: deque[float] = deque(maxlen=self.limits.window)
        self._periods: deque[float] = deque(maxlen=self.limits.window)

    def stamp(self, raw: RawFrame) -> StampedFrame:
        """Return a frame with its number and time in the session."""
        last = self._last
        if last is not None and not self.by_stamps:
            self._check_stamps(last.raw, raw)
        gap = 1 if last is None or raw.number <= last.raw.number else raw.number - last.raw.number
        if last is not None and gap > 1:
            self._check_gap(last, raw, gap)
        self._number += gap
        taken = raw.arrived_s if self.by_stamps else self._clock.host_time(raw.stamp_s, raw.arrived_s)
        time_s = raw.stamp_s if self.by_stamps else taken - self._log.begun_s
        self._latest_s = max(time_s, self._latest_s + TICK_S)
        self._check_step(raw)
        self._check_exposure(raw)
        self._unread = 0
        self._last = StampedFrame(self._number, self._latest_s, taken, raw)
        return self._last

    def unread(self) -> None:
        """Count a frame that was overwritten before it was read; its number is then no gap of the device."""
        self._unread += 1

    def reconnected(self) -> None:
        """Reset, because the device restarts its counter and its clock."""
        self._clock.restart()
        self._last = None

    def _check_gap(self, last: StampedFrame, raw: RawFrame, gap: int) -> None:
        """Attribute the frames between two others.

        Cameras keep the newest frame only. Of the frames exposed between the last one and the time at which its reader was ready for another,
        about (ready − taken) / period, all but the newest are therefore lost on this machine; the device or its link lost the others.
        """
        period = (raw.stamp_s - last.raw.stamp_s) / gap
        waited = raw.ready_s - last.taken_s
        late = int(waited / period) if period > 0.0 and np.isfinite(waited) else 0
        lost = max(0, gap - 1 - self._unread)
        missed = min(lost, max(0, late))
        dropped = lost - missed
        self.missed, self.dropped = self.missed + missed, self.dropped + dropped
        if missed:
            self._log.happened(Notice.MISSED, f"{self.missed} so far: this machine was too busy to take them", missed)
        if dropped:
            text = f"{self.dropped} so far, not delivered by the device or its link: check cable and hub"
            self._log.happened(Notice.DROPPED, text, dropped)

    def _check_stamps(self, last: RawFrame, raw: RawFrame) -> None:
        step, waited = raw.stamp_s - last.stamp_s, raw.arrived_s - last.arrived_s
        if step <= 0.0:
            text = (
                f"from {last.stamp_s:.3f} s to {raw.stamp_s:.3f} s: the device or its clock was reset; the time mapping restarts"
            )
            self._log.happened(Notice.STAMPS_BACK, text)
            self._clock.restart()
        elif step > waited + self.limits.jump_s:
            self._log.happened(Notice.STAMPS_JUMP, f"by {step:.1f} s within {waited:.2f} s: the time mapping restarts")
            self._clock.restart()
        else:
            self._periods.append(step / max(1, raw.number - last.number))

    def _check_step(self, raw: RawFrame) -> None:
        if len(raw.view_stamps_s) < 2 or not self._periods:
            return
        offset, period = float(np.ptp(raw.view_stamps_s)), float(np.median(self._periods))
        text = f"{1e3 * offset:.0f} ms of a period of {1e3 * period:.0f} ms: connect their sync cables"
        self._log.lasts(Notice.OUT_OF_STEP, text if offset > self.limits.out_of_step_share * period else "")

    def _check_exposure(self, raw: RawFrame) -> None:
        if not np.isfinite(raw.exposure_s):
            return
        self._exposures.append(raw.exposure_s)
        values = np.array(self._exposures)
        flickers = len(values) == self.limits.window and values.std() > self.limits.flicker * values.mean()
        text = f"exposure between {1e3 * values.min():.1f} and {1e3 * values.max():.1f} ms: fix it, or use light without flicker"
        self._log.lasts(Notice.FLICKER, text if flickers else "")
