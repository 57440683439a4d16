"""The camera in its own process: drivers hang, crash and hold the interpreter lock, and only a process can be killed."""

from __future__ import annotations

import contextlib
import ctypes
import math
import signal
import time
from dataclasses import dataclass, replace
from enum import StrEnum
from multiprocessing.connection import Connection

from femsense.core.errors import FemsenseError
from femsense.live.frames import frame_bytes
from femsense.live.ring import Ring
from femsense.live.sources import make_source
from femsense.live.sources.source import FrameSource, Loss, Opening, SourceInfo, SourceLost

POLL_S = 0.2
"""Longest wait of a source for a frame [s], after which the process checks for a stop request."""
PR_SET_PDEATHSIG = 1


@dataclass(frozen=True, slots=True)
class RingPlace:
    """Reply to an opened source: the shared memory for its frames."""

    name: str
    slot_bytes: int


class Request(StrEnum):
    """Requests of the session to the process."""

    NEXT = "next"
    """One more frame, from a source that waits for requests."""
    STOP = "stop"


@dataclass(frozen=True, slots=True)
class Lost:
    """The source has no more frames."""

    loss: Loss
    text: str


@dataclass(frozen=True, slots=True)
class Failed:
    """The source is unusable: wrong input, or a missing package."""

    error: FemsenseError


Report = Opening | SourceInfo | int | Lost | Failed
"""Messages of the process: about to open, opened, the ticket of a frame, lost, failed."""


def run_camera(pipe: Connection, text: str, as_fast_as_possible: bool, opening: Opening) -> None:
    """Open a source and write its frames into a ring until the session requests a stop or ends; the target of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session handles Ctrl-C
    _end_with_parent()
    try:
        source = make_source(text, as_fast_as_possible=as_fast_as_possible)
    except FemsenseError as error:
        pipe.send(Failed(error))
        return
    try:
        if math.isnan(opening.begun_s):
            opening = replace(opening, begun_s=time.monotonic())
        pipe.send(opening)  # before it can fail: the next process goes on from the same beginning
        pipe.send(source.open(opening))
        answer = pipe.recv()
        if isinstance(answer, RingPlace):
            _stream(source, pipe, Ring(answer.slot_bytes, answer.name, is_new=False), asked=as_fast_as_possible)
    except SourceLost as lost:
        _tell(pipe, Lost(lost.loss, lost.text))
    except FemsenseError as error:
        _tell(pipe, Failed(error))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the session is gone
    finally:
        source.close()


def _stream(source: FrameSource, pipe: Connection, ring: Ring, *, asked: bool) -> None:
    """Write frames until a stop request; with `asked` one per request."""
    ready = 0.0
    try:
        while True:
            if pipe.poll(None if asked else 0) and pipe.recv() is Request.STOP:
                return
            ready = ready or time.monotonic()
            frame = source.newest(POLL_S)
            while frame is None and asked:
                frame = source.newest(POLL_S)
            if frame is not None:
                pipe.send(ring.write(frame_bytes(replace(frame, ready_s=ready))))
                ready = 0.0
    finally:
        ring.close()


def _end_with_parent() -> None:
    """Ask Linux to kill this process when its parent ends, even if a driver hangs."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))


def _tell(pipe: Connection, report: Report) -> None:
    with contextlib.suppress(OSError):  # the session is gone
        pipe.send(report)
