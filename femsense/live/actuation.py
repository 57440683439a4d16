"""Inputs of the robot as they are received, with time stamps, interpolated to the times of frames."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import Protocol

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.live.clock import ClockMap
from femsense.live.events import Notice
from femsense.model.robot import Robot
from femsense.xr.stream.readings import Readings, readings_of

KEPT = 4096
"""Number of values that are kept for later frames."""


@dataclass(frozen=True, slots=True)
class ActuationLimits:
    """Timing of the inputs."""

    delay_s: float = 0.0
    """Delay from a command to its effect: a frame at time t has the inputs of t − delay."""
    late_s: float = 0.5
    """Inputs older than this at the time of a frame are reported as late."""


class Actuation(Protocol):
    """A source of inputs."""

    columns: tuple[str, ...]
    """Columns of frames.csv that it fills: `cable_<name>` and `chamber_<name>`."""

    def at(self, taken_s: float) -> FloatArray | None:
        """Return the inputs at a time [s, monotonic clock], shape (columns,); None before the first ones arrive."""
        ...

    def notices(self) -> dict[Notice, str]:
        """Return the current problems of the source."""
        ...

    def close(self) -> None: ...


def columns_of(robot: Robot) -> tuple[str, ...]:
    """Return the columns of frames.csv that hold the inputs of a robot."""
    return tuple([f"cable_{name}" for name in robot.body.cable_names] + [f"chamber_{name}" for name in robot.body.chamber_names])


def make_actuation(text: str, robot: Robot, limits: ActuationLimits | None = None) -> Actuation:
    """Return the source of inputs that a text specifies.

    Arguments:
        text: `mqtt://HOST/TOPIC`, `udp://HOST:PORT`, `ws://HOST:PORT/…`, `serial:PORT?baud=…`, a CSV file that grows, or
            `fixed:NAME=VALUE,…`. Messages are JSON objects, column → number, with `time_s` if the sender has a clock, or
            numbers separated by commas.
        robot: whose inputs they are.
        limits: delay, and the age at which inputs are late.

    Raises:
        InputError: an unknown source, or an input that the robot does not have. MissingDependency.
    """
    columns = columns_of(robot)
    if text.startswith("fixed"):
        return FixedActuation(columns, _fixed(text.partition(":")[2], columns))
    stop = Event()
    return ReadActuation(columns, readings_of(text, columns, stop), stop, text, limits)


class FixedActuation:
    """Constant inputs."""

    def __init__(self, columns: tuple[str, ...], values: FloatArray) -> None:
        self.columns, self._values = columns, values

    def at(self, taken_s: float) -> FloatArray:
        """Return the values."""
        return self._values

    def notices(self) -> dict[Notice, str]:
        """Return no problems."""
        return {}

    def close(self) -> None:
        """Do nothing: no resources are held."""


@dataclass(frozen=True, eq=False, slots=True)
class _Timed:
    """Values at a time [s, monotonic clock of this machine]."""

    time_s: float
    values: FloatArray


class ReadActuation:
    """Inputs that another program sends: read in a thread, interpolated at the time of a frame."""

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
        """Start reading.

        Arguments:
            columns: in the order of the values of `readings`.
            readings: times [s] on any clock, and values.
            stop: ends the readings.
            source: its name in messages.
            limits: delay, and the age at which inputs are late.
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
        self._heard = np.full(len(columns), -np.inf)
        """When each column last came [s, monotonic clock]."""
        self._thread = Thread(target=self._read, daemon=True, name="femsense-actuation")
        self._thread.start()

    def at(self, taken_s: float) -> FloatArray | None:
        """Return the inputs at a time, linear between two values; after the last one its value, None before the first arrives."""
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
        """Return the problems: the source is unreachable, its values or those of one input are late, or its clock does not advance."""
        found: dict[Notice, str] = {}
        with self._lock:
            newest = self._kept[-1].time_s if self._kept else None
            asked, stands, heard = self._asked_s, self._stands_since, self._heard
        if trouble := self._readings.away or (newest is None and self._readings.trouble) or "":
            found[Notice.ACTUATION_AWAY] = f"{self._source}: {trouble}; the last values hold"
        elif newest is not None and asked - newest > self._limits.late_s:
            found[Notice.ACTUATION_LATE] = (
                f"{self._source}: the newest values are {asked - newest:.1f} s older than the frame; they are used until others arrive"
            )
        elif silent := [name for name, at in zip(self.columns, heard) if heard.max() - at > self._limits.late_s]:
            found[Notice.ACTUATION_LATE] = (
                f"{self._source}: messages arrive without {', '.join(silent)}; "
                + ("no frame has all inputs yet" if newest is None else "the last value is used until another arrives")
                + f": they need {', '.join(self.columns)}"
            )
        if stands is not None and self._clock() - stands > self._limits.late_s:
            found[Notice.ACTUATION_FROZEN] = (
                f"{self._source}: messages arrive, but their time_s does not advance: check the sender"
            )
        return found

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        self._thread.join(2.0)

    def _read(self) -> None:
        held = np.full(len(self.columns), np.nan)
        for stamp, values in self._readings:
            held = np.where(np.isfinite(values), values, held)
            with self._lock:
                self._heard = np.where(np.isfinite(values), self._clock(), self._heard)
            if stamp <= self._last_stamp:
                if self._last_stamp - stamp > 1.0:  # the sender restarted
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
    """Inputs that are part of the frames, as in a recording. Stateless, because two threads ask for frames."""

    def __init__(self, columns: Sequence[str]) -> None:
        self.columns = tuple(columns)

    def of(self, inputs: Mapping[str, float], where: str) -> FloatArray:
        """Return the inputs of a frame, shape (columns,). Raises InputError if one is missing."""
        missing = [name for name in self.columns if name not in inputs]
        if missing:
            raise InputError(
                "the frames do not contain all inputs of the robot",
                where=where,
                found=", ".join(inputs) or "none",
                expected=", ".join(missing),
                hint="--actuation SOURCE, or a recording of this robot",
            )
        return np.array([inputs[name] for name in self.columns])

    def notices(self) -> dict[Notice, str]:
        """Return no problems: the inputs are part of the frames."""
        return {}

    def close(self) -> None:
        """Do nothing: no resources are held."""


def _fixed(text: str, columns: tuple[str, ...]) -> FloatArray:
    """Return the values of `NAME=VALUE,…`; other inputs are 0. The prefixes `cable_` and `chamber_` are optional."""
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
