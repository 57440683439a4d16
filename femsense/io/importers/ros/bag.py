"""ROS 1 and ROS 2 bags: opening them, their topics and raw messages; whatever is broken becomes one clear error."""

from __future__ import annotations

import contextlib
import struct
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from femsense.core.errors import FemsenseError, InputError
from femsense.core.packages import needed
from femsense.core.text import with_type
from femsense.io.importers.ros.streamed_mcap import NotRos, StreamedMcap

ENDINGS = (".bag", ".db3", ".mcap")
BEGINNINGS = ((b"#ROSBAG V2.0", ".bag"), (b"\x89MCAP0", ".mcap"), (b"SQLite format 3\0", ".db3"))
MENDED = {
    ".bag": "if it was cut off or not closed, `rosbag reindex FILE` (ROS 1) mends it",
    ".mcap": "`mcap recover FILE` mends it",
    "folder": "if it was not closed, `ros2 bag reindex FOLDER` mends it",
}
"""Kind of bag → the program that repairs it."""
IMAGE = "sensor_msgs/msg/Image"
SDK_PADDING = 4
"""Bytes that the RealSense SDK writes behind an image of ROS 1, and that its type does not have."""


@dataclass(frozen=True, eq=False, slots=True)
class Topic:
    """A topic of a bag."""

    name: str
    type: str
    """As ROS 2 writes it: sensor_msgs/msg/Image."""
    count: int


@dataclass(frozen=True, eq=False, slots=True)
class Message:
    """A message that is not decoded yet."""

    topic: str
    type: str
    record: float
    """When it was written [s]."""
    raw: bytes


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self.reader = reader
        self.topics = _topics(reader)

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """Yield messages of these topics in the order in which they were written, up to the end or, with a warning, to the break."""
        wanted = [c for c in self.reader.connections if c.topic in topics]
        if not wanted:
            return
        count = 0
        broken: tuple[type[Exception], ...] = (OSError, ValueError, EOFError, AssertionError, struct.error, *_library_errors())
        try:
            for connection, nanoseconds, raw in self.reader.messages(connections=wanted):
                count += 1
                yield Message(connection.topic, connection.msgtype, 1e-9 * nanoseconds, bytes(raw))
        except broken as error:
            warnings.warn(
                f"{self.path}: the file is broken after {count} messages ({with_type(error, 200)}); those before are read",
                stacklevel=2,
            )

    def first(self, topics: Collection[str]) -> Any:
        """Return the first message of these topics, decoded; None where they have none. Raises InputError where it is broken."""
        message = next(self.messages(topics), None)
        return None if message is None else self.decode(message)

    def decode(self, message: Message) -> Any:
        """Return a message as an object with the fields of its type. Raises InputError where it is broken."""
        padded = message.type == IMAGE and not self.reader.is2
        try:
            try:
                return self.reader.deserialize(message.raw, message.type)
            except Exception:
                if not padded:
                    raise
            return self.reader.deserialize(message.raw[:-SDK_PADDING], message.type)
        except Exception as error:  # the decoder raises the errors of its fields: any of them means a broken message
            raise InputError(
                "a message that its type does not describe",
                where=f"{self.path}, topic {message.topic}",
                found=f"{len(message.raw)} bytes of {message.type}: {with_type(error, 200)}",
                expected="the type store that the bag was written with",
            ) from None


def content_ending(path: Path) -> str | None:
    """Return the suffix that fits the content of a bag, whatever its name; None for other files."""
    with path.open("rb") as stream:
        head = stream.read(16)
    return next((ending for begin, ending in BEGINNINGS if head.startswith(begin)), None)


@contextmanager
def _named_by_content(path: Path) -> Iterator[Path]:
    """Yield a file under a name with the ending of its content: rosbags goes by the ending.

    Raises:
        InputError: no link can be made, so that the file must be renamed.
    """
    ending = content_ending(path) if path.is_file() else None
    if ending in (None, path.suffix):
        yield path
        return
    with TemporaryDirectory(prefix="femsense-") as folder:
        link = Path(folder) / f"{path.stem}{ending}"
        try:
            link.symlink_to(path.resolve())
        except OSError:
            raise InputError(
                "a bag with another ending", where=path, found=path.suffix, expected=f"rename it to {ending}"
            ) from None
        yield link


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a .bag, a .db3, a .mcap or a folder of ROS 2; of a file the content counts, not the ending.

    Raises:
        InputError: the file is none of these, is empty, cut off or not indexed. MissingDependency: without rosbags.
    """
    if path.is_file() and not path.stat().st_size:
        raise InputError("an empty file", where=path, found="0 bytes", expected="a ROS bag")
    with _named_by_content(path) as named:
        reader = _reader(path, named)
        try:
            yield Bag(path, reader)
        finally:
            reader.close()


def _reader(path: Path, named: Path) -> Any:
    """Return a reader of a bag; `named` is the same under the ending of its content. Raises InputError."""
    try:
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            return _reader_of_files(path, "is missing")
        return _opened([named])
    except FemsenseError:
        raise
    except Exception as error:  # rosbags raises the errors of zlib, sqlite, YAML and struct in addition to its own
        with contextlib.suppress(Exception):
            if path.is_dir():
                return _reader_of_files(path, f"is broken ({with_type(error, 200)})")
        if path.is_dir() or content_ending(path) != ".mcap":
            raise _unreadable(path, error) from None
        return _streamed(path, error)


def _opened(files: Sequence[Path]) -> Any:
    """Return a reader of rosbags. Raises any exception of it, and MissingDependency without the package."""
    highlevel = needed("rosbags.highlevel", "ros", "reading ROS bags")
    typesys = needed("rosbags.typesys", "ros", "reading ROS bags")
    reader = highlevel.AnyReader(files, default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE))
    reader.open()
    return reader


def _reader_of_files(folder: Path, problem: str) -> Any:
    """Return a reader of the files of a folder without a readable metadata.yaml, with a warning."""
    files = sorted(item for item in folder.iterdir() if item.suffix in ENDINGS)
    if not files:
        raise InputError("no bag in this folder", where=folder, expected="metadata.yaml, .db3, .mcap or .bag files")
    reader = _opened(files)
    warnings.warn(f"{folder}: metadata.yaml {problem}; {len(files)} files are read by themselves", stacklevel=5)
    return reader


def _streamed(path: Path, error: Exception) -> StreamedMcap:
    """Return a reader of an MCAP file from its beginning, with a warning where the file breaks off. Raises InputError."""
    try:
        reader = StreamedMcap(path)
    except NotRos:
        raise
    except InputError:
        raise _unreadable(path, error) from None
    if "Profile is not" not in str(error):  # a complete file that is of ROS 1, or not declared as ROS 2
        warnings.warn(
            f"{path}: the file is broken or was not closed ({with_type(error, 200)}); {reader.count} messages of whole chunks before the "
            f"break are read; {MENDED['.mcap']}",
            stacklevel=4,
        )
    return reader


def _topics(reader: Any) -> list[Topic]:
    counts: dict[tuple[str, str], int] = {}
    for connection in reader.connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + (connection.msgcount or 0)
    return [Topic(name, kind, count) for (name, kind), count in sorted(counts.items())]


def _unreadable(path: Path, error: Exception) -> InputError:
    kind = content_ending(path) if path.is_file() else None
    none = path.is_file() and kind is None
    return InputError(
        "not readable as a ROS bag" + (": it is none" if none else ""),
        where=path,
        found=_head(path) if none else with_type(error, 200),
        expected="a whole .bag, .db3, .mcap or ROS 2 folder",
        hint=None if none else MENDED.get(kind or "folder"),
    )


def _library_errors() -> tuple[type[Exception], ...]:
    rosbags1 = needed("rosbags.rosbag1", "ros", "reading ROS bags")
    rosbags2 = needed("rosbags.rosbag2", "ros", "reading ROS bags")
    apsw = needed("apsw", "ros", "reading ROS bags")
    return rosbags1.ReaderError, rosbags2.ReaderError, apsw.Error


def _head(path: Path) -> str:
    with path.open("rb") as stream:
        return f"a file that begins {stream.read(12)!r}"
