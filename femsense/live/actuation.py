"""Inputs of the robot as they are sent, each with its own time, and their values at the time of a frame."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from threading import Event, Lock, Thread
from typing import Protocol

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.live.clock import ClockMap
from femsense.live.watch import Notice
from femsense.model.robot import Robot
from femsense.xr.stream.readings import Readings, read_line, readings_of

KEPT = 4096
"""Values that are kept for frames that are still to come."""
RECONNECT_S = 0.5


@dataclass(frozen=True, slots=True)
class ActuationLimits:
    """How inputs are read."""

    delay_s: float = 0.0
    """From a command to its effect: the inputs of a frame at time t are those of t − delay."""
    late_s: float = 0.5
    """Values older than this at the time of a frame are late."""


class Actuation(Protocol):
    """Where inputs come from."""

    columns: tuple[str, ...]
    """Columns of frames.csv that it fills: `cable_<name>` and `chamber_<name>`."""

    def at(self, taken_s: float) -> FloatArray | None:
        """Return the inputs at a time [s, monotonic clock], shape (columns,); None while none are known."""
        ...

    def notices(self) -> dict[Notice, str]:
        """Return what is wrong with it."""
        ...

    def close(self) -> None: ...


def columns_of(robot: Robot) -> tuple[str, ...]:
    """Return the columns of frames.csv that hold the inputs of a robot."""
    return tuple([f"cable_{name}" for name in robot.body.cable_names] + [f"chamber_{name}" for name in robot.body.chamber_names])


def make_actuation(text: str, robot: Robot, limits: ActuationLimits | None = None) -> Actuation:
    """Return the inputs that a text names.

    Arguments:
        text: `mqtt://HOST/TOPIC`, `udp://HOST:PORT`, `ws://HOST:PORT/…`, `serial:PORT?baud=…`, a CSV file that grows, or
            `fixed:NAME=VALUE,…`. Messages are JSON objects, column → number, with `time_s` where the sender has a clock, or
            numbers with commas between.
        robot: whose inputs they are.
        limits: delay, and when values are late.

    Raises:
        InputError: no such source, or an input that the robot does not have. MissingDependency.
    """
    columns = columns_of(robot)
    if text.startswith("fixed"):
        return FixedActuation(columns, _fixed(text.partition(":")[2], columns))
    stop = Event()
    if text.startswith(("ws://", "wss://")):
        lines = _WebSocketLines(text)
        readings = Readings(lines.items(stop), partial(read_line, channels=columns), away=lambda: lines.away)
    else:
        readings = readings_of(text, columns, stop)
    return ReadActuation(columns, readings, stop, text, limits)


class FixedActuation:
    """Inputs that do not change."""

    def __init__(self, columns: tuple[str, ...], values: FloatArray) -> None:
        self.columns, self._values = columns, values

    def at(self, taken_s: float) -> FloatArray:
        """Return the values."""
        return self._values

    def notices(self) -> dict[Notice, str]:
        """Return none."""
        return {}

    def close(self) -> None:
        """Nothing is held."""


@dataclass(frozen=True, eq=False, slots=True)
class _Timed:
    """Values at a time [s, monotonic clock of this machine]."""

    time_s: float
    values: FloatArray


class ReadActuation:
    """Inputs that another program sends; read in a thread, interpolated at the time of a frame."""

    def __init__(
        self,
        columns: tuple[str, ...],
        readings: Readings,
        stop: Event,
        source: str,
        limits: ActuationLimits | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start to read.

        Arguments:
            columns: in the order of the values of `readings`.
            readings: times [s] on any clock, and values.
            stop: ends them.
            source: as people call it.
            limits: delay, and when values are late.
            clock: of this machine [s].
        """
        self.columns, self._readings, self._stop, self._source = columns, readings, stop, source
        self._limits, self._clock = limits or ActuationLimits(), clock
        self._times = ClockMap()
        self._kept: deque[_Timed] = deque(maxlen=KEPT)
        self._lock = Lock()
        self._asked_s = float("nan")
        self._last_stamp = float("-inf")
        self._stands_since: float | None = None
        self._thread = Thread(target=self._read, daemon=True, name="femsense-actuation")
        self._thread.start()

    def at(self, taken_s: float) -> FloatArray | None:
        """Return the inputs that act at a time, linear between two values; the newest where none is newer, None before the first."""
        wanted = taken_s - self._limits.delay_s
        with self._lock:
            kept, self._asked_s = list(self._kept), wanted
        if not kept:
            return None
        times = np.array([one.time_s for one in kept])
        k = int(np.searchsorted(times, wanted, side="right"))
        if k in (0, len(kept)):
            return kept[min(k, len(kept) - 1)].values
        before, after = kept[k - 1], kept[k]
        share = (wanted - before.time_s) / (after.time_s - before.time_s)
        return (1.0 - share) * before.values + share * after.values

    def notices(self) -> dict[Notice, str]:
        """Return what is wrong: the source is away, its values are late, or its own clock stands still."""
        found: dict[Notice, str] = {}
        with self._lock:
            newest = self._kept[-1].time_s if self._kept else None
            asked, stands = self._asked_s, self._stands_since
        if trouble := self._readings.away or (newest is None and self._readings.trouble) or "":
            found[Notice.ACTUATION_AWAY] = f"{self._source}: {trouble}; the last values hold"
        elif newest is not None and asked - newest > self._limits.late_s:
            found[Notice.ACTUATION_LATE] = (
                f"{self._source}: the newest values are {asked - newest:.1f} s older than the frame; they hold until others come"
            )
        if stands is not None and self._clock() - stands > self._limits.late_s:
            found[Notice.ACTUATION_FROZEN] = f"{self._source}: messages come, but their time_s stands still: is the sender stuck?"
        return found

    def close(self) -> None:
        """Stop to read."""
        self._stop.set()
        self._thread.join(2.0)

    def _read(self) -> None:
        held = np.full(len(self.columns), np.nan)
        for stamp, values in self._readings:
            held = np.where(np.isfinite(values), values, held)
            if stamp <= self._last_stamp:
                if self._last_stamp - stamp > 1.0:  # the sender began anew
                    self._times.restart()
                else:
                    self._stands_since = self._stands_since or self._clock()
                    continue
            self._last_stamp, self._stands_since = stamp, None
            at = self._times.host_time(stamp, self._readings.came)
            if np.isfinite(held).all():
                with self._lock:
                    if not self._kept or at > self._kept[-1].time_s:
                        self._kept.append(_Timed(at, held))


class FrameActuation:
    """Inputs that come with the frames, as those of a recording do. It keeps nothing: frames are asked for from two threads."""

    def __init__(self, columns: Sequence[str]) -> None:
        self.columns = tuple(columns)

    def of(self, inputs: Mapping[str, float], where: str) -> FloatArray:
        """Return the inputs that came with a frame, shape (columns,). Raises InputError where one is missing."""
        missing = [name for name in self.columns if name not in inputs]
        if missing:
            raise InputError(
                "the frames do not bring all inputs of the robot",
                where=where,
                found=", ".join(inputs) or "none",
                expected=", ".join(missing),
                hint="--actuation SOURCE, or the recording of this robot",
            )
        return np.array([inputs[name] for name in self.columns])

    def notices(self) -> dict[Notice, str]:
        """Return none: they come with the frames."""
        return {}

    def close(self) -> None:
        """Nothing is held."""


class _WebSocketLines:
    """Text messages of a WebSocket, which is connected again when it is lost."""

    def __init__(self, url: str) -> None:
        self._url = url
        self.away = "not connected yet"

    def items(self, stop: Event) -> Iterator[bytes]:
        """Yield messages until `stop` is set."""
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        while not stop.is_set():
            try:
                with connect(self._url, open_timeout=2.0) as socket:
                    self.away = ""
                    while not stop.is_set():
                        try:
                            message = socket.recv(timeout=0.2)
                        except TimeoutError:
                            continue
                        yield message.encode() if isinstance(message, str) else message
            except (OSError, WebSocketException) as error:
                self.away = f"no connection: {error}"
                stop.wait(RECONNECT_S)


def _fixed(text: str, columns: tuple[str, ...]) -> FloatArray:
    """Return the values of `NAME=VALUE,…`; inputs that are not named are 0. A name may leave `cable_` or `chamber_` out."""
    values = dict.fromkeys(columns, 0.0)
    short = {column.partition("_")[2]: column for column in columns}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        column = name if name in values else short.get(name, "")
        if not column:
            raise InputError(
                "the robot has no such input",
                where="--actuation",
                found=name,
                expected=", ".join(columns) or "fixed: alone, the robot has no inputs",
                hint=did_you_mean(name, columns),
            )
        try:
            values[column] = float(json.loads(value))
        except (ValueError, TypeError):
            raise InputError("not a number", where=f"--actuation {name}", found=value, expected="a number") from None
    return np.array([values[column] for column in columns])
