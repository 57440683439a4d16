"""A serial line: its text line by line; the port may come later, and be unplugged and plugged in again."""

from __future__ import annotations

import errno
from collections.abc import Callable
from contextlib import closing
from threading import Event
from urllib.parse import parse_qs

from femsense.core.errors import InputError
from femsense.core.packages import needed

LONGEST_LINE = 65_536
WAIT_S = 0.1


class SerialLine:
    """Lines of a serial port as they come."""

    def __init__(self, source: str) -> None:
        """Open `serial:PORT?baud=115200` if the port is there.

        Raises:
            InputError: no such kind of port, or no such speed.
            MissingDependency: pyserial is not installed.
        """
        serial = needed("serial", "xr", "reading a serial line")
        port, _, more = source.removeprefix("serial:").partition("?")
        baud = parse_qs(more).get("baud", ["115200"])[0]
        try:
            self._line = serial.serial_for_url(port, do_not_open=True, baudrate=int(baud), timeout=WAIT_S)
        except (OSError, ValueError) as error:
            raise InputError(
                "the serial line cannot be opened", where=source, found=error, expected="serial:PORT?baud=115200"
            ) from None
        self._was_open = False
        self.away = ""
        """Why the port is unavailable; empty if it is available."""
        self._open()

    def run(self, hear: Callable[[bytes], None], stop: Event) -> None:
        """Call hear(line) until `stop` is set; a port that is away is opened again and again."""
        held = b""
        with closing(self._line):
            while not stop.is_set():
                if not self._line.is_open and not self._open():
                    stop.wait(WAIT_S)
                    continue
                try:
                    held += self._line.read(max(1, min(self._line.in_waiting, LONGEST_LINE)))
                except OSError:  # of the system, and of pyserial
                    held, self.away = b"", "unplugged"
                    self._line.close()
                *whole, held = held[-LONGEST_LINE:].split(b"\n")
                for line in whole:
                    hear(line)

    def _open(self) -> bool:
        """Open the port, and return whether it is there."""
        try:
            self._line.open()
        except OSError as error:
            missing = "there is no such port yet" if error.errno == errno.ENOENT else str(error)
            self.away = "unplugged" if self._was_open else missing
            return False
        self._was_open, self.away = True, ""
        return True
