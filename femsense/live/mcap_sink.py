"""Messages of a session as an MCAP file, JSON with a schema each: readable by Foxglove; `mcap recover` repairs a truncated file."""

from __future__ import annotations

import json
import time
from pathlib import Path
from threading import Lock
from typing import Any

from femsense.core.errors import MissingDependency
from femsense.io.files import check_target
from femsense.xr.stream.hub import Message
from femsense.xr.stream.payloads import split_topic

WRITTEN = {"force", "wrench", "inputs", "live"}
"""Kinds of messages that are written: JSON, and not constant."""


class McapSink:
    """A hub sink that writes to a file."""

    def __init__(self, path: Path) -> None:
        """Open a file. Raises InputError if it exists, MissingDependency."""
        try:
            from mcap.writer import Writer
        except ImportError:
            raise MissingDependency("MCAP needs the package mcap\n  try:      pip install 'femsense[mcap]'") from None
        check_target(path, folder=False)
        self._stream = path.open("xb")
        self._writer: Any = Writer(self._stream)
        self._writer.start(profile="", library="femsense")
        self._channels: dict[str, int] = {}
        self._lock = Lock()

    def send(self, messages: tuple[Message, ...]) -> None:
        """Write the JSON messages."""
        now = time.time_ns()
        with self._lock:
            for message in messages:
                known = split_topic(message.topic)
                if known is not None and known[1] in WRITTEN and not self._stream.closed:
                    channel = self._channel(message.topic, known[1])
                    self._writer.add_message(channel, log_time=now, publish_time=now, data=message.payload)

    def close(self) -> None:
        """Finish the file."""
        with self._lock:
            self._writer.finish()
            self._stream.close()

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            schema = json.dumps({"type": "object"}).encode()
            name = "geometry_msgs/WrenchStamped" if kind == "wrench" else f"femsense/{kind}"
            number = self._writer.register_schema(name, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        return self._channels[topic]
