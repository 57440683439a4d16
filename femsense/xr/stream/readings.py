"""Readings of sensors as they come: from a CSV file that grows, UDP, MQTT, or a serial line."""

from __future__ import annotations

import json
import queue
import re
import socket
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.text_numbers import Notation
from femsense.xr.stream.growing_file import GrowingFile
from femsense.xr.stream.mqtt import MqttSource, broker_address
from femsense.xr.stream.serial_line import LONGEST_LINE, WAIT_S, SerialLine

SHOWN = 60
"""Characters of a line that is no reading."""
WHOLE_PAIR = re.compile(r"[-+]?\d+,\d+")
"""Two whole numbers with a comma between."""
NOTATION = Notation(",")
"""Between semicolons or tabs numbers may have decimal commas."""
QUIET_S = 3.0
"""After which readings have stopped, as it is said to people."""

Reading = tuple[float, FloatArray]
"""Time [s], and one value for each channel; nan where there is none."""


class Readings(Iterator[Reading]):
    """Readings as they come, and what is the matter where none do."""

    def __init__(
        self,
        items: Iterator[Any],
        read: Callable[[Any], Reading | None],
        *,
        away: Callable[[], str] = lambda: "",
        age_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Read items; `away` says why the source is not there, or nothing, and `age_s` how old the item before was when it came [s]."""
        self._items, self._read, self._away, self._age_s = items, read, away, age_s
        self._begun = time.monotonic()
        self._first: Any = None
        self.came = float("nan")
        """When the newest reading was made, as far as its source says, else when it came [s, monotonic clock]; nan: none came."""
        self.passed = 0
        """How many items were no readings."""

    def __next__(self) -> Reading:
        for item in self._items:
            found = self._read(item)
            if found is not None:
                now = time.monotonic()
                self.came = now - self._age_s()
                when, values = found
                return (when if np.isfinite(when) else now - self._begun), values
            self._pass_over(item)
        raise StopIteration

    def _pass_over(self, item: Any) -> None:
        if not _is_blank(item):
            self.passed += 1
            self._first = item if self._first is None else self._first

    @property
    def away(self) -> str:
        """Why the source is not there; empty where it is."""
        return self._away()

    @property
    def trouble(self) -> str:
        """Why no readings come; empty while they do and the source is there."""
        if why := self.away:
            return why
        if np.isfinite(self.came):
            return "they stopped" if time.monotonic() - self.came > QUIET_S else ""
        return self.refused or "nothing has come yet"

    @property
    def refused(self) -> str:
        """What was passed over, with the first of it; empty where all were readings."""
        text = self._first.decode("utf-8", "replace").strip() if isinstance(self._first, bytes) else ""
        comma = ": a decimal comma? Write a point, or semicolons between numbers" if WHOLE_PAIR.fullmatch(text) else ""
        return f"what comes is no reading of its channels, first {_shown(self._first)}{comma}" if self.passed else ""

    def close(self) -> None:
        """Let go of the source."""
        if isinstance(self._items, Generator):
            self._items.close()


def readings_of(source: str, channels: Sequence[str], stop: Event) -> Readings:
    """Open a source and return what yields its readings until `stop` is set; lines that are none are passed over.

    Arguments:
        source: a CSV file, `udp://HOST:PORT`, `mqtt://HOST/TOPIC`, or `serial:PORT?baud=115200`. What comes by UDP,
            MQTT or a serial line is a JSON object channel → number,
            or numbers with commas between in the order of the channels; `time_s` is optional.
        channels: names, in the order of the values that are yielded.
        stop: ends it.

    Returns:
        the readings. A time that a source does not say counts from when the source was opened.

    Raises:
        InputError: no such source, an address that is taken, a CSV file without a channel. A file or a port that is not there
            yet is waited for.
        MissingDependency: the package for it is not installed.
    """
    parts = urlsplit(source)
    read = partial(read_line, channels=channels)
    if parts.scheme == "udp":
        return Readings(_datagrams(source, stop), read)
    if parts.scheme in ("mqtt", "mqtts"):
        waiting: queue.Queue[bytes] = queue.Queue(1)
        broker = _topic(source, waiting)
        return Readings(_newest(broker, waiting, stop), read, away=lambda: broker.trouble and f"no connection, {broker.trouble}")
    if parts.scheme == "serial":
        line = SerialLine(source)
        return Readings(line.lines(stop), read, away=lambda: line.away)
    file = GrowingFile(Path(source), channels)
    return Readings(file.rows(stop), lambda row: _of_object(row, channels), away=lambda: file.away, age_s=lambda: file.age_s)


def read_line(line: bytes, channels: Sequence[str]) -> Reading | None:
    """Return the reading in a line or message, or None where there is none."""
    text = line[:LONGEST_LINE].decode("utf-8", "replace").strip()
    if not text:
        return None
    if text.startswith("{"):
        with suppress(ValueError, RecursionError):
            return _of_object(json.loads(text), channels)
        return None
    if len(channels) == 1 and WHOLE_PAIR.fullmatch(text):
        return None  # 0,512: a time and a value, or one value with a decimal comma
    parts = re.split("[;\t]", text)
    cells = [_cell(NOTATION.plain(part)) for part in parts] if len(parts) > 1 else [_cell(part) for part in text.split(",")]
    values = [value for value in cells if value is not None]
    if len(values) < len(cells) or not np.isfinite(values).any():
        return None
    if len(values) == len(channels) + 1:
        return (values[0], np.array(values[1:])) if np.isfinite(values[0]) else None
    return (float("nan"), np.array(values)) if len(values) == len(channels) else None


def _of_object(told: Any, channels: Sequence[str]) -> Reading | None:
    if not isinstance(told, dict) or not any(name in told for name in channels):
        return None
    if any(isinstance(told.get(name), list | dict | bool) for name in channels):
        return None
    when, values = _number(told.get("time_s")), np.array([_number(told.get(name)) for name in channels])
    if not np.isfinite(values).any():
        return None
    return when, values


def _shown(item: Any) -> str:
    """Return the beginning of what came, for people."""
    text = item.decode("utf-8", "replace") if isinstance(item, bytes) else str(item)
    return repr(text if len(text) <= SHOWN else text[:SHOWN] + "…")


def _number(value: Any) -> float:
    """Return a finite number, or nan."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        return float("nan")
    return number if np.isfinite(number) else float("nan")


def _cell(text: str) -> float | None:
    """Return what stands between commas: a number, nan where nothing does or none that is finite, None where it is something else."""
    try:
        value = float(text) if text.strip() else float("nan")
    except ValueError:
        return None
    return value if np.isfinite(value) else float("nan")


def _is_blank(item: Any) -> bool:
    """Return whether nothing stands in a line, or in a row of a file."""
    return not (item.strip() if isinstance(item, bytes) else any(cell.strip() for cell in item.values()))


# Sources


def _datagrams(source: str, stop: Event) -> Iterator[bytes]:
    parts = urlsplit(source)
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if parts.port is None:
            raise ValueError("no port: whoever sends has to know it")
        endpoint.bind((parts.hostname or "127.0.0.1", parts.port))
    except (OSError, ValueError) as error:
        endpoint.close()
        raise InputError(
            "the address cannot be used", where=source, found=error, expected="udp://HOST:PORT of this machine"
        ) from None
    return _received(endpoint, stop)


def _received(endpoint: socket.socket, stop: Event) -> Iterator[bytes]:
    with closing(endpoint):
        endpoint.settimeout(WAIT_S)
        while not stop.is_set():
            with suppress(TimeoutError):
                yield endpoint.recv(LONGEST_LINE)


def _topic(source: str, waiting: queue.Queue[bytes]) -> MqttSource:
    """Put messages of a topic into a queue of one place: only the newest waits."""
    parts = urlsplit(source)
    name = parts.path.lstrip("/")
    if not name:
        raise InputError("a topic is missing", where=source, expected="mqtt://HOST/TOPIC")

    def take(payload: bytes) -> None:
        with suppress(queue.Empty):
            waiting.get_nowait()
        with suppress(queue.Full):
            waiting.put_nowait(payload)

    address = broker_address(f"{parts.scheme}://{parts.netloc}")
    return MqttSource(address, lambda message: take(message.payload), topics=(name,))


def _newest(source: MqttSource, waiting: queue.Queue[bytes], stop: Event) -> Iterator[bytes]:
    with closing(source):
        while not stop.is_set():
            with suppress(queue.Empty):
                yield waiting.get(timeout=WAIT_S)
