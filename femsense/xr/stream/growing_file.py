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
        """Open the file if it exists. Raises InputError if it lacks a channel, or if it cannot appear later."""
        self._file, self._channels = file, channels
        self._stream: TextIO | None = None
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
        self._open()
        if self._missing:
            raise InputError(
                "channels are missing", where=file, found=", ".join(self._columns), expected=", ".join(self._missing)
            )

    def run(self, hear: Callable[[dict[str, str]], None], stop: Event) -> None:
        """Call hear(row) with the last row, then those that are written, column → text, until `stop` is set."""
        rest, is_old = "", True
        while not stop.is_set():
            if self._stream is None and not self._open():
                stop.wait(10 * POLL_S)
                continue
            assert self._stream is not None
            if is_old:
                rest, is_old = self._end(), False
            *lines, rest = (rest + self._stream.read(CHUNK)).split("\n")
            for line in lines:
                hear(dict(zip(self._columns, next(csv.reader([line]), []))))
            if not lines:
                self.age_s = 0.0  # later rows are written while the file is watched
                stop.wait(POLL_S)
                if self._was_replaced():
                    self._close()
                    rest = ""
        self._close()

    def _open(self) -> bool:
        """Open the file, and return whether it exists with all channels; `away` contains the reason if not."""
        try:
            stream = self._file.open(newline="", encoding="utf-8", errors="replace")
        except OSError as error:
            self.away = "there is no such file yet" if isinstance(error, FileNotFoundError) else str(error)
            return False
        head = stream.readline()
        self._columns = next(csv.reader([head]), []) if head.endswith("\n") else []
        if not self._columns or self._missing:
            stream.close()
            self.away = f"channels are missing: {', '.join(self._missing)}" if self._columns else "it is empty yet"
            return False
        self._stream, self.away = stream, ""
        self.age_s = max(0.0, time.time() - os.fstat(stream.fileno()).st_mtime)
        return True

    @property
    def _missing(self) -> list[str]:
        return [name for name in self._channels if self._columns and name not in self._columns]

    def _end(self) -> str:
        """Return the last complete line and the rest: older lines are skipped."""
        text = ""
        while self._stream is not None and (chunk := self._stream.read(CHUNK)):
            text = "\n".join((text + chunk).split("\n")[-2:])
        return text

    def _was_replaced(self) -> bool:
        """Whether the file was cut off or replaced; False while it is away."""
        with suppress(FileNotFoundError):
            now = self._file.stat()
            stream = self._stream
            return stream is not None and (now.st_size < stream.tell() or now.st_ino != os.fstat(stream.fileno()).st_ino)
        return False

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        self._stream = None
