"""A recording as a simulated device with faults, for tests of a session with a failing camera."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, replace
from enum import StrEnum
from urllib.parse import parse_qsl

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.live.frames import RawFrame
from femsense.live.sources.recorded import Recorded
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost

BACK_S, JUMP_S, APART_S = 5.0, 100.0, 0.08
EXPOSURES_S = (4e-3, 12e-3)
ONCE = "once"


class Fault(StrEnum):
    """Faults of a device, each with a first frame and a duration."""

    SILENT = "silent"
    """No frames."""
    HANG = "hang"
    """Calls do not return."""
    CRASH = "crash"
    """Its process exits."""
    UNPLUG = "unplug"
    REFUSE = "refuse"
    """In use by another program."""
    DROP = "drop"
    """Frames are counted and not delivered."""
    BACK = "back"
    """Its clock is set back by BACK_S."""
    JUMP = "jump"
    """Its clock is set forward by JUMP_S."""
    APART = "apart"
    """A second camera is exposed APART_S later."""
    USB2 = "usb2"
    FLICKER = "flicker"
    """The exposure time alternates."""


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """One fault."""

    fault: Fault
    frame: int
    """First frame of the recording with the fault."""
    seconds: float


class SoftwareCamera:
    """`RECORDING?unplug=20+2&silent=40+3`: the device is unplugged at frame 20 for 2 s, and silent from frame 40 for 3 s.

    The recording repeats without end, unless `once` is among the faults.
    """

    def __init__(self, text: str) -> None:
        folder, _, faults = text.partition("?")
        words = parse_qsl(faults, keep_blank_values=True)
        self.faults = tuple(_planned(word, value, text) for word, value in words if word != ONCE)
        self._camera = Recorded(folder, is_endless=(ONCE, "") not in words)

    def open(self, opening: Opening) -> SourceInfo:
        """Start. Raises SourceLost while it is unplugged or refused."""
        info = self._camera.open(opening)
        self._raise_lost()
        slow = self._active(Fault.USB2)
        return replace(
            info,
            name=f"software camera of {self._camera.folder.name}",
            link="USB 2.1" if slow else "USB 3.2",
            is_slow_link=slow,
        )

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the next frame with the active faults; None without one."""
        self._raise_lost()
        if self._active(Fault.CRASH):
            os._exit(1)
        while self._active(Fault.HANG):
            time.sleep(0.1)
        frame = self._camera.newest(timeout_s)
        if frame is None or self._active(Fault.SILENT) or self._active(Fault.DROP):
            return None
        return self._spoiled(frame)

    def close(self) -> None:
        """Release the recording."""
        self._camera.close()

    def list_devices(self) -> list[FoundCamera]:
        """Return none: it is not a device."""
        return []

    def _raise_lost(self) -> None:
        if self._active(Fault.UNPLUG):
            raise SourceLost(Loss.UNPLUGGED, "the device is no longer on the bus")
        if self._active(Fault.REFUSE):
            raise SourceLost(Loss.REFUSED, "the device is in use by another program")

    def _spoiled(self, frame: RawFrame) -> RawFrame:
        stamp, stamps, exposure = frame.stamp_s, frame.view_stamps_s, frame.exposure_s
        if self._active(Fault.BACK):
            stamp -= BACK_S
        if self._active(Fault.JUMP):
            stamp += JUMP_S
        if self._active(Fault.APART):
            stamps = (stamp, stamp + APART_S)
        if self._active(Fault.FLICKER):
            exposure = EXPOSURES_S[frame.number % 2]
        return replace(frame, stamp_s=stamp, view_stamps_s=stamps, exposure_s=exposure)

    def _active(self, fault: Fault) -> bool:
        """Return whether a fault of this kind is active."""
        elapsed = [(one.seconds, time.monotonic() - self._camera.due_s(one.frame)) for one in self.faults if one.fault is fault]
        return any(0.0 <= since < seconds for seconds, since in elapsed)


def _planned(word: str, value: str, text: str) -> PlannedFault:
    frame, _, seconds = value.partition(" " if " " in value else "+")
    try:
        return PlannedFault(Fault(word), int(frame), float(seconds or "inf"))
    except ValueError:
        names = [fault.value for fault in Fault]
        raise InputError(
            "no such fault",
            where=f"software:{text}",
            found=f"{word}={value}",
            expected=f"FAULT=FRAME+SECONDS with {', '.join(names)}",
            hint=did_you_mean(word, names),
        ) from None
