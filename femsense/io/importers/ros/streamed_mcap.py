"""MCAP files that `rosbags` does not open: not closed, cut off, or without the profile of ROS 2; read from their beginning."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from femsense.core.errors import InputError
from femsense.core.packages import needed

PACKINGS = ("cdr", "ros1")
"""Encodings of messages that are read: those of ROS 2 and of ROS 1."""


@dataclass(frozen=True, slots=True)
class Connection:
    """A topic with its type: the fields of a `rosbags` connection that are used here."""

    topic: str
    msgtype: str
    definition: str
    encoding: str
    msgcount: int = 0


class NotRos(InputError):
    """An MCAP file without messages of ROS."""


class StreamedMcap:
    """A replacement for the reader of `rosbags`: the messages of a file up to its end or its truncation."""

    def __init__(self, path: Path) -> None:
        """Count the messages of a file.

        Raises:
            InputError: the file has no whole message. NotRos: its messages are in another encoding.
        """
        self.path = path
        counts = Counter[Connection](found for found, _, _ in self._records())
        if not counts:
            raise InputError(
                "an MCAP file without a whole message", where=path, found=f"{path.stat().st_size} bytes", expected="messages"
            )
        packings = {found.encoding for found in counts}
        if packings.isdisjoint(PACKINGS):
            raise NotRos(
                "messages that are not of ROS", where=path, found=", ".join(sorted(packings)), expected="cdr (ROS 2) or ros1"
            )
        self.is2 = "cdr" in packings
        self.connections = [
            Connection(c.topic, c.msgtype, c.definition, c.encoding, n) for c, n in counts.items() if c.encoding in PACKINGS
        ]
        self.count = sum(connection.msgcount for connection in self.connections)
        self._typestore = self._types()

    def messages(self, connections: Collection[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield connection, time of recording [ns] and raw message in the order of the file."""
        topics = {connection.topic for connection in connections}
        yield from (record for record in self._records() if record[0].topic in topics)

    def deserialize(self, raw: bytes, kind: str) -> Any:
        """Return a message as an object."""
        unpack = self._typestore.deserialize_cdr if self.is2 else self._typestore.deserialize_ros1
        return unpack(raw, kind)

    def close(self) -> None:
        """Do nothing: the file is open only while its records are read."""

    def _records(self) -> Iterator[tuple[Connection, int, bytes]]:
        reader = needed("mcap.reader", "ros", "reading MCAP files without an index")
        exceptions = needed("mcap.exceptions", "ros", "reading MCAP files without an index")
        channels: dict[int, Connection] = {}
        broken = (exceptions.McapError, struct.error, ValueError, EOFError, OSError, OverflowError, MemoryError)
        with self.path.open("rb") as stream:
            try:
                for schema, channel, message in reader.NonSeekingReader(stream).iter_messages(log_time_order=False):
                    if schema is not None:
                        if channel.id not in channels:
                            channels[channel.id] = _connection(channel, schema)
                        yield channels[channel.id], message.log_time, message.data
            except broken:
                return
            except Exception as error:  # the decompressors' own errors have no common base
                if type(error).__module__.split(".")[0] not in ("zstandard", "lz4", "_lz4"):
                    raise

    def _types(self) -> Any:
        typesys = needed("rosbags.typesys", "ros", "reading ROS bags")
        store = typesys.get_typestore(typesys.Stores.EMPTY)
        types: dict[str, Any] = {}
        try:
            for connection in self.connections:
                types.update(typesys.get_types_from_msg(connection.definition, connection.msgtype))
            store.register(types)
        except Exception as error:  # the parser raises the errors of its grammar
            raise InputError("broken definitions of messages", where=self.path, found=type(error).__name__) from None
        return store


def _connection(channel: Any, schema: Any) -> Connection:
    name = schema.name if schema.name.count("/") != 1 else schema.name.replace("/", "/msg/")
    return Connection(channel.topic, name, schema.data.decode("utf-8", "replace"), channel.message_encoding)
