"""A CSV file that another program writes: its last row, then those that are added; it may come later, or be replaced."""

from __future__ import annotations

import csv
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import TextIO

from femsense.core.errors import InputError

POLL_S = 0.002
"""Interval at which a file is checked for new rows [s]."""
CHUNK = 1 << 20


class GrowingFile:
    """Rows of a CSV file as they are written."""

    def __init__(self, file: Path, channels: Sequence[str]) -> None:
        """Look into the file if it exists. Raises InputError if it lacks a channel, or if it cannot appear later."""
        self._file, self._channels = file, channels
        self._columns: list[str] = []
        self.away = ""
        """Why there are no rows, as far as the file itself is the reason."""
        self.age_s = 0.0
        """Minimum age of the current row [s]; for rows that existed before, from the modification time of the file."""
        if file.is_dir() or not file.absolute().parent.is_dir():
            raise InputError(
                "no such source",
                where="--sensors",
                found=file,
                expected="a CSV file, udp://HOST:PORT, mqtt://HOST/TOPIC, ws://HOST:PORT/PATH or serial:PORT?baud=115200",
            )
        if (stream := self._open()) is not None:
            stream.close()
        elif self._missing:
            raise InputError(
                "channels are missing", where=file, found=", ".join(self._columns), expected=", ".join(self._missing)
            )

    def run(self, hear: Callable[[dict[str, str]], None], stop: Event) -> None:
        """Call hear(row) with the last row, then those that are written, column → text, until `stop` is set."""
        is_old = True
        while not stop.is_set():
            if (stream := self._open()) is None:
                stop.wait(10 * POLL_S)
                continue
            with stream:
                self._follow(stream, _last_line(stream) if is_old else "", hear, stop)
            is_old = False

    def _follow(self, stream: TextIO, rest: str, hear: Callable[[dict[str, str]], None], stop: Event) -> None:
        """Read rows, after the text `rest`, until the file is replaced."""
        while not stop.is_set():
            *lines, rest = (rest + stream.read(CHUNK)).split("\n")
            for line in lines:
                hear(dict(zip(self._columns, next(csv.reader([line]), []))))
            if not lines:
                self.age_s = 0.0  # later rows are written while the file is watched
                stop.wait(POLL_S)
                if self._was_replaced(stream):
                    return

    def _open(self) -> TextIO | None:
        """Return the file after its header, or None with the reason in `away`."""
        try:
            stream = self._file.open(newline="", encoding="utf-8", errors="replace")
        except OSError as error:
            self.away = "there is no such file yet" if isinstance(error, FileNotFoundError) else str(error)
            return None
        head = stream.readline()
        self._columns = next(csv.reader([head]), []) if head.endswith("\n") else []
        if not self._columns or self._missing:
            stream.close()
            self.away = f"channels are missing: {', '.join(self._missing)}" if self._columns else "it is empty yet"
            return None
        self.away, self.age_s = "", max(0.0, time.time() - os.fstat(stream.fileno()).st_mtime)
        return stream

    @property
    def _missing(self) -> list[str]:
        return [name for name in self._channels if self._columns and name not in self._columns]

    def _was_replaced(self, stream: TextIO) -> bool:
        """Whether the file was cut off or replaced; False while it is away."""
        with suppress(FileNotFoundError):
            now = self._file.stat()
            return now.st_size < stream.tell() or now.st_ino != os.fstat(stream.fileno()).st_ino
        return False


def _last_line(stream: TextIO) -> str:
    """Return the last complete line and the rest: older lines are skipped."""
    text = ""
    while chunk := stream.read(CHUNK):
        text = "\n".join((text + chunk).split("\n")[-2:])
    return text
