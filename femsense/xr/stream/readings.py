"""Readings of sensors as they come: from a CSV file that grows, UDP, MQTT, or a serial line."""

from __future__ import annotations

import json
import queue
import socket
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError, MissingDependency
from femsense.xr.stream.growing_file import GrowingFile
from femsense.xr.stream.mqtt import MqttSource, broker_address

if TYPE_CHECKING:
    from serial import Serial

LONGEST_LINE = 65_536
SHOWN = 60
"""Characters of a line that is no reading."""
WAIT_S = 0.1
QUIET_S = 3.0
"""After which readings have stopped, as it is said to people."""

Reading = tuple[float, FloatArray]
"""Time [s], and one value for each channel; nan where there is none."""


class Readings(Iterator[Reading]):
    """Readings as they come, and what is the matter where none do."""

    def __init__(self, items: Iterator[Any], read: Callable[[Any], Reading | None], away: Callable[[], str] = lambda: "") -> None:
        """Read items; `away` says why the source is not there, or nothing."""
        self._items, self._read, self._away = items, read, away
        self._begun, self._came = time.monotonic(), float("nan")
        self._passed: Any = None

    def __next__(self) -> Reading:
        for item in self._items:
            found = self._read(item)
            if found is not None:
                self._came = time.monotonic()
                when, values = found
                return (when if np.isfinite(when) else self._came - self._begun), values
            self._passed = item if self._passed is None else self._passed
        raise StopIteration

    @property
    def away(self) -> str:
        """Why the source is not there; empty where it is."""
        return self._away()

    @property
    def trouble(self) -> str:
        """Why no readings come; empty while they do and the source is there."""
        if why := self.away:
            return why
        if np.isfinite(self._came):
            return "they stopped" if time.monotonic() - self._came > QUIET_S else ""
        if self._passed is None:
            return "nothing has come yet"
        return f"what comes is no reading of its channels, first {_shown(self._passed)}"

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
        InputError: no such source, one that cannot be opened, a CSV file without a channel.
        MissingDependency: the package for it is not installed.
    """
    parts = urlsplit(source)
    read = partial(read_line, channels=channels)
    if parts.scheme == "udp":
        return Readings(_datagrams(source, stop), read)
    if parts.scheme in ("mqtt", "mqtts"):
        waiting: queue.Queue[bytes] = queue.Queue(1)
        broker = _topic(source, waiting)
        return Readings(_newest(broker, waiting, stop), read, lambda: broker.trouble and f"no connection, {broker.trouble}")
    if parts.scheme == "serial":
        line = _serial(source)
        return Readings(_lines(line, stop), read, lambda: "" if line.is_open else "unplugged")
    file = GrowingFile(Path(source), channels)
    return Readings(file.rows(stop), lambda row: _of_object(row, channels), lambda: file.away)


def read_line(line: bytes, channels: Sequence[str]) -> Reading | None:
    """Return the reading in a line or message, or None where there is none."""
    text = line[:LONGEST_LINE].decode("utf-8", "replace").strip()
    if not text:
        return None
    if text.startswith("{"):
        with suppress(ValueError, RecursionError):
            return _of_object(json.loads(text), channels)
        return None
    values = [_number(part) for part in text.replace(";", ",").split(",")]
    if not np.isfinite(values).any():
        return None
    if len(values) == len(channels) + 1:
        return (values[0], np.array(values[1:])) if np.isfinite(values[0]) else None
    return (float("nan"), np.array(values)) if len(values) == len(channels) else None


def _of_object(told: Any, channels: Sequence[str]) -> Reading | None:
    if not isinstance(told, dict) or not any(name in told for name in channels):
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


def _serial(source: str) -> Serial:
    try:
        import serial
    except ImportError:
        raise MissingDependency("a serial line needs the package pyserial\n  try:      pip install 'femsense[xr]'") from None
    port, _, more = source.removeprefix("serial:").partition("?")
    baud = parse_qs(more).get("baud", ["115200"])[0]
    try:
        line: Serial = serial.serial_for_url(port, baudrate=int(baud), timeout=WAIT_S)
    except (OSError, ValueError) as error:
        raise InputError(
            "the serial line cannot be opened", where=source, found=error, expected="serial:PORT?baud=115200"
        ) from None
    return line


def _lines(line: Serial, stop: Event) -> Iterator[bytes]:
    """Yield the lines of a serial port; one that was unplugged is opened again."""
    held = b""
    with closing(line):
        while not stop.is_set():
            try:
                if not line.is_open:
                    line.open()
                held += line.read(max(1, min(line.in_waiting, LONGEST_LINE)))
            except OSError:  # of the system, and of pyserial
                held = b""
                line.close()
                stop.wait(WAIT_S)
            *whole, held = held[-LONGEST_LINE:].split(b"\n")
            yield from whole
