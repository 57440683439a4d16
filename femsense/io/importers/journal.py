"""The frames that were written so far, one line of JSON each: an import that is killed goes on after the last whole line."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.io.files import plain

JOURNAL = ".import-journal"
"""Name of the file in the unfinished folder; its first line identifies the source and the options."""


class Picture(StrEnum):
    """Kind of picture of a camera in a frame, as it was written."""

    NONE = ""
    DEPTH = "depth"
    CLOUD = "cloud"
    BROKEN = "broken"


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """Data of one camera in a frame."""

    markers: Mapping[str, list[float]]
    unlabelled: list[list[float]]
    picture: Picture
    center: list[float] | None
    """Mean of the points that were seen [m]; None where none were."""


@dataclass(frozen=True, eq=False, slots=True)
class Entry:
    """One written frame."""

    time: float
    """[s] on the source's clock."""
    inputs: Mapping[str, float]
    loads: list[list[float]]
    """Six numbers each: place [m], force [N]."""
    seen: Mapping[str, Seen]
    """Camera → its data; the name is empty for a single camera."""
    number: int = 0
    """Its pictures carry it as their name."""

    @property
    def center(self) -> list[float] | None:
        """Mean position of the first camera's points [m], as a measure of motion."""
        return next((seen.center for seen in self.seen.values()), None)


class Journal:
    """Appends entries, and reads them one after the other."""

    def __init__(self, folder: Path, identity: Mapping[str, Any]) -> None:
        """folder: the unfinished recording. identity: the sources and options of the import; another identity starts from the first frame."""
        self.file = folder / JOURNAL
        self.head = json.dumps(plain(identity), sort_keys=True)
        self.done = self._whole_entries()
        self.stream: TextIO | None = None
        self.left_out: frozenset[int] = frozenset()
        """Numbers of frames that `entries` passes over."""

    def __enter__(self) -> Journal:
        if self.done is None:
            self.file.write_text(self.head + "\n", encoding="utf-8")
            self.done = 0
        self.stream = self.file.open("a", encoding="utf-8")
        return self

    def __exit__(self, *_: object) -> None:
        if self.stream is not None:
            self.stream.close()

    @property
    def belongs(self) -> bool:
        """Whether the folder holds an import made from the same."""
        return self.done is not None

    def add(self, entry: Entry) -> None:
        """Append a frame whose files are written."""
        if self.stream is None:
            raise RuntimeError("the journal is not open")
        seen = {name: [s.markers, s.unlabelled, s.picture, s.center] for name, s in entry.seen.items()}
        line = [entry.time, entry.inputs, entry.loads, seen]
        self.stream.write(json.dumps(line) + "\n")
        self.stream.flush()

    def entries(self) -> Iterator[Entry]:
        """Yield the frames in the order in which they were written."""
        with self.file.open(encoding="utf-8") as stream:
            next(stream)
            for number, line in enumerate(stream):
                if number in self.left_out:
                    continue
                time, inputs, loads, seen = json.loads(line)
                yield Entry(time, inputs, loads, {name: _seen(*one) for name, one in seen.items()}, number)

    def times(self) -> FloatArray:
        """Return the times of all frames [s], shape (F,)."""
        return np.fromiter((entry.time for entry in self.entries()), dtype=np.float64)

    def _whole_entries(self) -> int | None:
        """Return how many whole lines there are after cutting off a half one; None where the file is another's or none."""
        if not self.file.is_file():
            return None
        with self.file.open("r+b") as stream:
            if stream.readline().decode("utf-8", "replace").rstrip("\n") != self.head:
                return None
            count, end = 0, stream.tell()
            for line in stream:
                if not line.endswith(b"\n"):
                    break
                count, end = count + 1, end + len(line)
            stream.truncate(end)
        return count


def _seen(markers: dict[str, list[float]], unlabelled: list[list[float]], picture: str, center: list[float] | None) -> Seen:
    return Seen(markers, unlabelled, Picture(picture), center)
