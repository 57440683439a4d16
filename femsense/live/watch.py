"""Checks of frame time stamps: lost frames, clocks that jump or run backwards, unsynchronised cameras, unstable exposure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from femsense.live.clock import ClockMap
from femsense.live.frames import RawFrame, StampedFrame

TICK_S = 1e-6
"""Smallest increase of time from frame to frame of a recording [s]."""


class Notice(StrEnum):
    """Problems during a session, of frames, inputs, broker or recording."""

    DROPPED = "frames dropped"
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
    DRIFT = "drift"


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

    def __init__(self, begun_s: float, limits: WatchLimits | None = None, *, by_stamps: bool = False) -> None:
        """Begin.

        Arguments:
            begun_s: start of the session [s, monotonic clock].
            limits: thresholds.
            by_stamps: use the stamps as times, independent of arrival: for a recording that is not replayed at its own speed.
        """
        self.limits, self.by_stamps = limits or WatchLimits(), by_stamps
        self.begun_s = begun_s
        self.dropped = 0
        """Frames that the device counted and did not deliver."""
        self.notices: dict[Notice, str] = {}
        self._clock = ClockMap()
        self._number = -1
        self._last: RawFrame | None = None
        self._last_time_s = float("-inf")
        self._exposures: deque[float] = deque(maxlen=self.limits.window)
        self._periods: deque[float] = deque(maxlen=self.limits.window)

    def stamp(self, raw: RawFrame) -> StampedFrame:
        """Return a frame with its number and time in the session."""
        last = self._last
        if last is not None and not self.by_stamps:
            self._check_stamps(last, raw)
        gap = 1 if last is None or raw.number <= last.number else raw.number - last.number
        if gap > 1:
            self.dropped += gap - 1
            self.notices[Notice.DROPPED] = f"the device lost {self.dropped} frames so far: check cable, hub and disk"
        self._number += gap
        taken = raw.arrived_s if self.by_stamps else self._clock.host_time(raw.stamp_s, raw.arrived_s)
        time_s = raw.stamp_s if self.by_stamps else taken - self.begun_s
        self._last_time_s = max(time_s, self._last_time_s + TICK_S)
        self._check_step(raw)
        self._check_exposure(raw)
        self._last = raw
        return StampedFrame(self._number, self._last_time_s, taken, raw)

    def reconnected(self) -> None:
        """Reset, because the device restarts its counter and its clock."""
        self._clock.restart()
        self._last = None

    def _check_stamps(self, last: RawFrame, raw: RawFrame) -> None:
        step, waited = raw.stamp_s - last.stamp_s, raw.arrived_s - last.arrived_s
        if step <= 0.0:
            self.notices[Notice.STAMPS_BACK] = (
                f"from {last.stamp_s:.3f} s to {raw.stamp_s:.3f} s: the device or its clock was reset; the time mapping restarts"
            )
            self._clock.restart()
        elif step > waited + self.limits.jump_s:
            self.notices[Notice.STAMPS_JUMP] = f"by {step:.1f} s within {waited:.2f} s: the time mapping restarts"
            self._clock.restart()
        else:
            self._periods.append(step / max(1, raw.number - last.number))

    def _check_step(self, raw: RawFrame) -> None:
        if len(raw.view_stamps_s) < 2 or not self._periods:
            return
        offset, period = float(np.ptp(raw.view_stamps_s)), float(np.median(self._periods))
        if offset > self.limits.out_of_step_share * period:
            self.notices[Notice.OUT_OF_STEP] = (
                f"{1e3 * offset:.0f} ms of a period of {1e3 * period:.0f} ms: connect their sync cables"
            )
        else:
            self.notices.pop(Notice.OUT_OF_STEP, None)

    def _check_exposure(self, raw: RawFrame) -> None:
        if not np.isfinite(raw.exposure_s):
            return
        self._exposures.append(raw.exposure_s)
        values = np.array(self._exposures)
        if len(values) == self.limits.window and values.std() > self.limits.flicker * values.mean():
            self.notices[Notice.FLICKER] = (
                f"exposure between {1e3 * values.min():.1f} and {1e3 * values.max():.1f} ms: fix it, or use light without flicker"
            )
        else:
            self.notices.pop(Notice.FLICKER, None)
