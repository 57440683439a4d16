"""ROS 1 and ROS 2 bags: opening them, their topics and raw messages; whatever is broken becomes one clear error."""

from __future__ import annotations

import contextlib
import struct
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

from femsense.core.errors import InputError
from femsense.io.importers.frames import need
from femsense.io.importers.ros.recovery import NotRos, RecoveredReader

ENDINGS = (".bag", ".db3", ".mcap")
BEGINNINGS = ((b"#ROSBAG V2.0", ".bag"), (b"\x89MCAP0", ".mcap"), (b"SQLite format 3\0", ".db3"))
IMAGE = "sensor_msgs/msg/Image"


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
        """Yield messages of these topics in the order in which they were written;
        stops with a warning where the bag breaks off."""
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
                f"{self.path}: the file is broken after {count} messages ({_line(error)}); what comes before is read",
                stacklevel=2,
            )

    def decode(self, message: Message) -> Any:
        """Return a message as an object with the fields of its type. Raises InputError where it is broken."""
        if message.type == IMAGE and not self.reader.is2:
            return _ros1_image(message, self.path)
        try:
            return self.reader.deserialize(message.raw, message.type)
        except Exception as error:  # the decoder raises what its fields raise: any of it means a broken message
            raise InputError(
                "a message that its type does not describe",
                where=f"{self.path}, topic {message.topic}",
                found=f"{len(message.raw)} bytes of {message.type}: {_line(error)}",
                expected="the type store that the bag was written with",
            ) from None


def content_ending(path: Path) -> str | None:
    """Return the ending of a bag's content, whatever the file is called; None for what is no bag."""
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
        InputError: the package rosbags is missing, or the file is none of these, is empty, cut off or not indexed.
    """
    highlevel = need("rosbags.highlevel", "ros", "reading ROS bags")
    typesys = need("rosbags.typesys", "ros", "reading ROS bags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with _named_by_content(path) as named:
        files = _files(named)
        try:
            reader = highlevel.AnyReader(files, default_typestore=store)
            reader.open()
        except InputError:
            raise
        except Exception as error:  # rosbags raises what zlib, sqlite, YAML and struct raise, beside its own
            reader = _without_metadata(path, highlevel, store, error) if path.is_dir() else _recovered(path, error)
        try:
            yield Bag(path, reader)
        finally:
            reader.close()


def _without_metadata(path: Path, highlevel: Any, store: Any, error: Exception) -> Any:
    """Return a reader of the files of a folder whose metadata.yaml is broken, with a warning. Raises InputError."""
    files = sorted(item for item in path.iterdir() if item.suffix in ENDINGS)
    try:
        reader = highlevel.AnyReader(files, default_typestore=store)
        reader.open()
    except Exception:
        raise _unreadable(path, error) from None
    warnings.warn(f"{path}: metadata.yaml is broken ({_line(error)}); {len(files)} files are read by themselves", stacklevel=4)
    return reader


def _recovered(path: Path, error: Exception) -> RecoveredReader:
    """Return a reader of what comes before the break, with a warning; InputError where there is nothing."""
    single = path if path.is_file() else None
    with path.open("rb") if single else contextlib.nullcontext() as stream:
        head = stream.read(12) if stream is not None else b""
    if not head.startswith((b"#ROSBAG V2.0", b"\x89MCAP0")):
        raise _unreadable(path, error) from None
    try:
        reader = RecoveredReader(path)
    except NotRos:
        raise
    except InputError:
        raise _unreadable(path, error) from None
    if "Profile is not" not in str(error):  # a whole file that does not say that it is of ROS 2, or is of ROS 1
        warnings.warn(
            f"{path}: the file is broken or was not closed ({_line(error)}); {reader.count} messages before the break are read",
            stacklevel=3,
        )
    return reader


def _files(path: Path) -> list[Path]:
    """Return what the reader takes: a file, a folder with its metadata, or the files of a folder that lost them."""
    if path.is_file():
        if not path.stat().st_size:
            raise InputError("an empty file", where=path, found="0 bytes", expected="a ROS bag")
        return [path]
    if (path / "metadata.yaml").is_file():
        return [path]
    files = sorted(item for item in path.iterdir() if item.suffix in ENDINGS)
    if not files:
        raise InputError("no bag in this folder", where=path, expected="metadata.yaml, .db3, .mcap or .bag files")
    warnings.warn(f"{path}: metadata.yaml is missing; {len(files)} files are read by themselves", stacklevel=3)
    return files


def _topics(reader: Any) -> list[Topic]:
    counts: dict[tuple[str, str], int] = {}
    for connection in reader.connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + (connection.msgcount or 0)
    return [Topic(name, kind, count) for (name, kind), count in sorted(counts.items())]


def _unreadable(path: Path, error: Exception) -> InputError:
    text = _line(error)
    hint = None
    if "index" in text.lower():
        hint = "it was not closed properly: `rosbag reindex FILE` (ROS 1) or `ros2 bag reindex FOLDER` (ROS 2) mends it"
    elif path.is_file() and content_ending(path) is None:
        return InputError(
            "not readable as a ROS bag: it is none",
            where=path,
            found=_head(path),
            expected="a whole .bag, .db3, .mcap or ROS 2 folder",
        )
    elif path.is_file() and content_ending(path) == ".mcap":
        hint = "it was not closed properly: `mcap recover FILE` mends it"
    return InputError(
        "not readable as a ROS bag", where=path, found=text, expected="a whole .bag, .db3, .mcap or ROS 2 folder", hint=hint
    )


def _library_errors() -> tuple[type[Exception], ...]:
    rosbags1 = need("rosbags.rosbag1", "ros", "reading ROS bags")
    rosbags2 = need("rosbags.rosbag2", "ros", "reading ROS bags")
    apsw = need("apsw", "ros", "reading ROS bags")
    return rosbags1.ReaderError, rosbags2.ReaderError, apsw.Error


def _head(path: Path) -> str:
    with path.open("rb") as stream:
        return f"a file that begins {stream.read(12)!r}"


def _line(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _ros1_image(message: Message, path: Path) -> Any:
    """Decode a sensor_msgs/Image of ROS 1; bytes after its body are left out (the RealSense SDK writes four of them)."""
    raw, at = message.raw, 0
    try:
        _, seconds, nanoseconds, length = struct.unpack_from("<IIII", raw, at)
        frame_id = raw[16 : 16 + length].decode()
        at = 16 + length
        height, width, length = struct.unpack_from("<III", raw, at)
        encoding = raw[at + 12 : at + 12 + length].decode()
        at += 12 + length
        big, step, length = struct.unpack_from("<BII", raw, at)
        data = raw[at + 9 : at + 9 + length]
    except (struct.error, UnicodeDecodeError) as error:
        raise InputError("a broken image message", where=f"{path}, topic {message.topic}", found=_line(error)) from None
    if len(data) < length:
        raise InputError(
            "a broken image message", where=f"{path}, topic {message.topic}", found=f"{len(data)} bytes", expected=f"{length}"
        )
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)
    return SimpleNamespace(header=header, height=height, width=width, encoding=encoding, is_bigendian=big, step=step, data=data)
