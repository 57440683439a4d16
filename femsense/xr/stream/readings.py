"""The newest readings of sensors: from a CSV file that grows, UDP, MQTT, a WebSocket, or a serial line."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.latest import Latest
from femsense.io.text_numbers import Notation
from femsense.xr.stream.growing_file import GrowingFile
from femsense.xr.stream.mqtt import MqttSource, broker_address
from femsense.xr.stream.sender_clock import SenderClock
from femsense.xr.stream.serial_line import LONGEST_LINE, WAIT_S, SerialLine
from femsense.xr.stream.web_source import WebSource

SHOWN = 60
"""Characters of a line that is no reading."""
WHOLE_PAIR = re.compile(r"[-+]?\d+,\d+")
"""Two whole numbers with a comma between."""
NOTATION = Notation(",")
"""Between semicolons or tabs numbers may have decimal commas."""
QUIET_S = 3.0
"""Time after which readings are reported as stopped [s]."""

Reading = tuple[float, FloatArray]
"""Time [s], and one value per channel; nan if missing."""


class Readings(Iterator[Reading]):
    """Yields the newest reading of a source; replaced ones are only counted."""

    def __init__(
        self,
        read: Callable[[Any], Reading | None],
        stop: Event,
        *,
        away: Callable[[], str] = lambda: "",
        age_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Wait for items until `stop` is set.

        Arguments:
            read: returns the reading in an item, or None.
            stop: ends the iteration.
            away: returns why the source is unavailable, or an empty text.
            age_s: returns the minimum age of the current item, by the source [s].
        """
        self._read, self._stop, self._away, self._age_s = read, stop, away, age_s
        self._begun = time.monotonic()
        self._clock, self._slot = SenderClock(), Latest[tuple[Reading, float]]()  # a reading, and when it was made
        self._first: Any = None
        self._pair: tuple[bytes, FloatArray] | None = None
        self._newest_at = self._late_s = float("nan")
        self.came = float("nan")
        """When the reading that was returned last was made, by its sender's time, else when it arrived [s, monotonic clock]."""
        self.passed = 0
        """How many items were no readings."""
        self.overtaken = 0
        """How many readings arrived after one that their sender had made later."""

    def hear(self, item: Any) -> None:
        """Receive an item; must be called in the order of arrival."""
        found = self._read(item)
        if found is None:
            self._pass_over(item)
            return
        if self._pair is None and isinstance(item, bytes) and WHOLE_PAIR.fullmatch(item.decode("utf-8", "replace").strip()):
            self._pair = item, found[1]
        arrived = time.monotonic()
        late = self._clock.age_s(found[0], arrived)
        if late is None:
            self.overtaken += 1
            return
        self._newest_at, self._late_s = arrived - max(late, self._age_s()), late
        when = found[0] if np.isfinite(found[0]) else arrived - self._begun
        self._slot.put(((when, found[1]), self._newest_at))

    def __next__(self) -> Reading:
        while not self._stop.is_set():
            if (made := self._slot.take(WAIT_S)) is not None:
                reading, self.came = made
                return reading
        raise StopIteration

    def _pass_over(self, item: Any) -> None:
        if not _is_blank(item):
            self.passed += 1
            self._first = item if self._first is None else self._first

    @property
    def dropped(self) -> int:
        """Number of readings that were replaced by newer ones before they were used, or were overtaken in transit."""
        return self._slot.dropped + self.overtaken

    @property
    def away(self) -> str:
        """Why the source is unavailable; empty if it is available."""
        return self._away()

    @property
    def trouble(self) -> str:
        """Reason why no readings arrive; empty while they do."""
        if why := self.away:
            return why
        if not np.isfinite(self._newest_at):
            return self.refused or "nothing has come yet"
        if time.monotonic() - self._newest_at <= QUIET_S:
            return ""
        late = self._late_s
        return f"they come {late:.1f} s late by the time that their sender gives them" if late > QUIET_S else "they stopped"

    @property
    def refused(self) -> str:
        """Number of lines that were ignored, with the first of them; empty if all were readings."""
        text = self._first.decode("utf-8", "replace").strip() if isinstance(self._first, bytes) else ""
        comma = ": a decimal comma? Write a point, or semicolons between numbers" if WHOLE_PAIR.fullmatch(text) else ""
        return f"what comes is no reading of its channels, first {_shown(self._first)}{comma}" if self.passed else ""

    @property
    def assumed(self) -> str:
        """How a line is read that could be one number with a decimal comma; empty if there was none."""
        if self._pair is None:
            return ""
        line, values = self._pair
        said = " and ".join(f"{value:g}" for value in values)
        return f"{_shown(line.strip())} is read as two values, {said}; with a decimal comma, write semicolons between numbers"


def readings_of(source: str, channels: Sequence[str], stop: Event) -> Readings:
    """Open a source and return an iterator over its newest reading until `stop` is set; lines that are not readings are ignored.

    Arguments:
        source: a CSV file, `udp://HOST:PORT`, `mqtt://HOST/TOPIC`, `ws://HOST:PORT/PATH`, or `serial:PORT?baud=115200`. Messages
            by UDP, MQTT, WebSocket or a serial line are JSON objects channel → number,
            or numbers separated by commas in the order of the channels; `time_s` is optional.
        channels: names, in the order of the values that are yielded.
        stop: ends the iteration.

    Returns:
        the readings. Without a time in the source, times count from its opening.

    Raises:
        InputError: an unknown source, an address that is taken, a CSV file without a channel. A file or a port that does not exist
            yet is waited for.
        MissingDependency: the package for it is not installed.
    """
    parts = urlsplit(source)
    read = partial(read_line, channels=channels)
    if parts.scheme == "udp":
        endpoint = _bound(source)
        readings = Readings(read, stop)
        return _listening(readings, lambda: _receive(endpoint, readings.hear, stop))
    if parts.scheme in ("mqtt", "mqtts"):
        return _subscribed(source, read, stop)
    if parts.scheme in ("ws", "wss"):
        web = WebSource(source)
        readings = Readings(read, stop, away=lambda: web.away and f"no connection, {web.away}")
        return _listening(readings, lambda: web.run(readings.hear, stop))
    if parts.scheme == "serial":
        line = SerialLine(source)
        readings = Readings(read, stop, away=lambda: line.away)
        return _listening(readings, lambda: line.run(readings.hear, stop))
    file = GrowingFile(Path(source), channels)
    readings = Readings(lambda row: _of_object(row, channels), stop, away=lambda: file.away, age_s=lambda: file.age_s)
    return _listening(readings, lambda: file.run(readings.hear, stop))


def read_line(line: bytes, channels: Sequence[str]) -> Reading | None:
    """Return the reading in a line or message, or None if there is none."""
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
    """Return the beginning of a message for display."""
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
    """Return a comma-separated field as a number: nan if it is empty or not finite, None if it is something else."""
    try:
        value = float(text) if text.strip() else float("nan")
    except ValueError:
        return None
    return value if np.isfinite(value) else float("nan")


def _is_blank(item: Any) -> bool:
    """Return whether a line, or a row of a file, is empty."""
    return not (item.strip() if isinstance(item, bytes) else any(cell.strip() for cell in item.values()))


# Sources: each delivers items in its own thread


def _listening(readings: Readings, run: Callable[[], None]) -> Readings:
    Thread(target=run, daemon=True, name="femsense-readings").start()
    return readings


def _bound(source: str) -> socket.socket:
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
    return endpoint


def _receive(endpoint: socket.socket, hear: Callable[[bytes], None], stop: Event) -> None:
    with closing(endpoint):
        endpoint.settimeout(WAIT_S)
        while not stop.is_set():
            with suppress(TimeoutError):
                hear(endpoint.recv(LONGEST_LINE))


def _subscribed(source: str, read: Callable[[Any], Reading | None], stop: Event) -> Readings:
    """Subscribe to a topic of a broker; retained messages are not current readings and are ignored."""
    parts = urlsplit(source)
    name = parts.path.lstrip("/")
    if not name:
        raise InputError("a topic is missing", where=source, expected="mqtt://HOST/TOPIC")
    connection: list[MqttSource] = []
    readings = Readings(read, stop, away=lambda: connection[0].trouble and f"no connection, {connection[0].trouble}")
    address = broker_address(f"{parts.scheme}://{parts.netloc}")
    connection.append(MqttSource(address, lambda message: readings.hear(message.payload), topics=(name,), kept=False))

    def leave() -> None:
        stop.wait()
        connection[0].close()

    return _listening(readings, leave)
