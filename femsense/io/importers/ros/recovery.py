"""Bags that were not closed: read from their beginning to the break, without an index.

ROS 1: the records of the bag format 2.0 (http://wiki.ros.org/Bags/Format/2.0). MCAP: the records as `mcap` streams them.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

from femsense.core.errors import InputError
from femsense.io.importers.frames import need

MESSAGE, CHUNK, CONNECTION = 2, 5, 7
"""Kinds of records of ROS 1."""
MCAP_MAGIC, MCAP_CHUNK = b"\x89MCAP0\r\n", 6
PIECE = 1024
"""So many bytes at a time are decompressed of what was cut off."""
LARGEST = 1 << 31
"""A record longer than this [bytes] is noise."""


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic with its type; the fields that `rosbags` has, as far as they are used."""

    id: int
    topic: str
    msgtype: str
    definition: str
    msgcount: int = 0
    encoding: str = "ros1"
    """How its messages are packed: "ros1", "cdr", or what is not read."""


class NotRos(InputError):
    """An MCAP file without messages of ROS."""


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(len(MCAP_MAGIC)) == MCAP_MAGIC


class RecoveredReader:
    """Stands for a reader of `rosbags`: the same messages as far as the file goes."""

    def __init__(self, path: Path) -> None:
        """path: a .bag or an .mcap file. Raises InputError where not one message is whole."""
        self.path, self.bare = path, not _is_mcap(path)
        found: dict[int, Connection] = {}
        counts: dict[int, int] = {}
        for item in self._records():
            if isinstance(item, Connection):
                found.setdefault(item.id, item)
            else:
                counts[item[0]] = counts.get(item[0], 0) + 1
        packed = {c.encoding for c in found.values()}
        found = {i: c for i, c in found.items() if c.encoding in ("ros1", "cdr")}
        if packed and not found:
            raise NotRos(
                "messages that are not of ROS", where=path, found=", ".join(sorted(packed)), expected="cdr (ROS 2) or ros1"
            )
        self.is2 = "cdr" in packed
        self.count = sum(counts.get(i, 0) for i in found)
        self.connections = [replace(c, msgcount=counts.get(i, 0)) for i, c in found.items()]
        if not self.count:
            raise InputError(
                "a bag without a whole message", where=path, found=f"{path.stat().st_size} bytes", expected="messages"
            )
        self.typestore = self._types()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, time of recording [ns] and raw message in the order of the file."""
        wanted = {c.id: c for c in connections}
        for item in self._records():
            if not isinstance(item, Connection) and item[0] in wanted:
                yield wanted[item[0]], item[1], item[2]

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """Return a message as an object."""
        unpack = self.typestore.deserialize_cdr if self.is2 else self.typestore.deserialize_ros1
        return unpack(raw, kind)

    def close(self) -> None:
        """Nothing is held open."""

    def _records(self) -> Iterator[Connection | tuple[int, int, bytes]]:
        with self.path.open("rb") as stream:
            yield from _bag_records(stream) if self.bare else _mcap_records(stream)

    def _types(self) -> Any:
        typesys = need("rosbags.typesys", "ros", "reading ROS bags")
        types: dict[str, Any] = {}
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        try:
            for connection in self.connections:
                types.update(typesys.get_types_from_msg(connection.definition, connection.msgtype))
            store.register(types)
        except Exception as error:  # the parser raises what its grammar raises
            raise InputError("broken definitions of messages", where=self.path, found=type(error).__name__) from None
        return store


def _bag_records(stream: BinaryIO) -> Iterator[Connection | tuple[int, int, bytes]]:
    """Yield the connections and messages of a ROS 1 bag up to where it breaks off."""
    stream.readline()
    while (record := _bag_record(stream)) is not None:
        header, data = record
        if header.get("op") == bytes([CHUNK]):
            yield from _chunk_records(_unpacked(header.get("compression", b""), data))
        elif (item := _bag_item(header, data)) is not None:
            yield item


def _chunk_records(data: bytes) -> Iterator[Connection | tuple[int, int, bytes]]:
    stream = io.BytesIO(data)
    while (record := _bag_record(stream)) is not None:
        if (item := _bag_item(*record)) is not None:
            yield item


def _bag_record(stream: BinaryIO) -> tuple[dict[str, bytes], bytes] | None:
    """Return header and data of the next record; None at the end or where it is cut off.

    Of a chunk that is not compressed what is there.
    """
    parts = list[bytes]()
    for _ in range(2):
        size = stream.read(4)
        length = struct.unpack("<I", size)[0] if len(size) == 4 else LARGEST
        data = stream.read(length) if length < LARGEST else b""
        cut = len(size) < 4 or len(data) < length
        if cut and not (parts and data and _is_plain_chunk(_fields(parts[0]))):
            return None
        parts.append(data)
    return _fields(parts[0]), parts[1]


def _is_plain_chunk(header: dict[str, bytes]) -> bool:
    return header.get("op") == bytes([CHUNK]) and header.get("compression", b"none") == b"none"


def _fields(data: bytes) -> dict[str, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + size].partition(b"=")
        fields[name.decode("latin-1")] = value
        at += 4 + size
    return fields


def _bag_item(header: dict[str, bytes], data: bytes) -> Connection | tuple[int, int, bytes] | None:
    kind = (header.get("op") or b"\0")[0]
    if "conn" not in header:
        return None
    if kind == MESSAGE and len(header.get("time", b"")) == 8:
        seconds, nanoseconds = struct.unpack("<II", header["time"])
        return int.from_bytes(header["conn"], "little"), seconds * 10**9 + nanoseconds, data
    if kind != CONNECTION:
        return None
    about = _fields(data)
    package, _, name = about.get("type", b"").decode().partition("/")
    topic = header.get("topic", b"").decode()
    text = about.get("message_definition", b"").decode("utf-8", "replace")
    return Connection(int.from_bytes(header["conn"], "little"), topic, f"{package}/msg/{name}", text)


def _unpacked(compression: bytes, data: bytes) -> bytes:
    """Return the records of a chunk; nothing where it is damaged."""
    import bz2

    try:
        if compression == b"bz2":
            return bz2.decompress(data)
        if compression == b"lz4":
            return bytes(need("lz4.frame", "ros", "reading compressed bags").decompress(data))
    except (OSError, ValueError, RuntimeError, EOFError):
        return b""
    return data


def _mcap_records(stream: BinaryIO) -> Iterator[Connection | tuple[int, int, bytes]]:
    """Yield the channels and messages of an MCAP file up to where it breaks off."""
    reader = need("mcap.stream_reader", "ros", "recovering MCAP files")
    exceptions = need("mcap.exceptions", "ros", "recovering MCAP files")
    schemas: dict[int, Any] = {}
    try:
        yield from _mcap_items(reader.StreamReader(stream).records, schemas)
    except (exceptions.McapError, struct.error, ValueError, EOFError, OSError, OverflowError, MemoryError):
        pass
    except Exception as error:  # what the decompressors raise at a break has no common base
        if type(error).__module__.split(".")[0] not in ("zstandard", "lz4", "_lz4"):
            raise
    with contextlib.suppress(exceptions.McapError, struct.error, ValueError, EOFError):
        rest = io.BytesIO(_last_chunk(stream))
        yield from _mcap_items(reader.StreamReader(rest, skip_magic=True).records, schemas)


def _mcap_items(records: Any, schemas: dict[int, Any]) -> Iterator[Connection | tuple[int, int, bytes]]:
    for record in records:
        kind = type(record).__name__
        if kind == "Schema":
            schemas[record.id] = record
        elif kind == "Channel" and record.schema_id in schemas:
            schema = schemas[record.schema_id]
            name = schema.name if schema.name.count("/") != 1 else schema.name.replace("/", "/msg/")
            text = schema.data.decode("utf-8", "replace")
            yield Connection(record.id, record.topic, name, text, encoding=record.message_encoding)
        elif kind == "Message":
            yield record.channel_id, record.log_time, record.data


def _last_chunk(stream: BinaryIO) -> bytes:
    """Return the records in the chunk at which an MCAP file breaks off, as far as they are there; nothing where it ends otherwise.

    mcap.dev/spec: a record is an opcode, a length of 8 bytes and its content; a chunk begins with two times, a size, a checksum,
    the name of its compression and the length of its records.
    """
    at, end = len(MCAP_MAGIC), stream.seek(0, 2)
    while at + 9 <= end:
        stream.seek(at)
        kind, length = struct.unpack("<BQ", stream.read(9))
        if at + 9 + length > end:
            data = stream.read() if kind == MCAP_CHUNK else b""
            break
        at += 9 + length
    else:
        return b""
    if len(data) < 32:
        return b""
    (named,) = struct.unpack_from("<I", data, 28)
    return _inflated(data[32 : 32 + named].decode("latin-1"), data[40 + named :])


def _inflated(compression: str, data: bytes) -> bytes:
    """Return what a part of compressed data holds, as far as it goes."""
    out = bytearray()
    if compression == "zstd":
        unpack = need("zstandard", "ros", "reading compressed bags").ZstdDecompressor().decompressobj().decompress
    elif compression == "lz4":
        unpack = need("lz4.frame", "ros", "reading compressed bags").LZ4FrameDecompressor().decompress
    else:
        return data
    with contextlib.suppress(Exception):  # at the break decompressors raise what has no common base
        for k in range(0, len(data), PIECE):
            out += unpack(data[k : k + PIECE])
    return bytes(out)
