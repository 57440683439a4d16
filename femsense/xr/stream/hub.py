"""The message hub: the newest message of each topic is kept, and passed to sinks on arrival."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from threading import Lock
from typing import Protocol

from femsense.xr.stream.payloads import RETAINED, split_topic


@dataclass(frozen=True, eq=False, slots=True)
class Message:
    """A payload for a topic."""

    topic: str
    payload: bytes

    @property
    def robot(self) -> str:
        """The robot of the topic; empty for a topic of others."""
        return (split_topic(self.topic) or ("", ""))[0]

    @property
    def kind(self) -> str:
        """Its kind, one of `Kind` or another program's; empty for a topic of others."""
        return (split_topic(self.topic) or ("", ""))[1]

    @property
    def retained(self) -> bool:
        """Whether a client that connects later receives the message immediately."""
        return self.kind in RETAINED


class Sink(Protocol):
    """Takes messages to somewhere else. `send` is called from any thread and never waits."""

    def send(self, messages: tuple[Message, ...]) -> None: ...
    def close(self) -> None: ...


class Hub:
    """The newest message of each topic, and the sinks of each; thread-safe."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._newest: dict[str, Message] = {}
        self._sinks: list[Sink] = []
        self._listeners: list[Callable[[Message, str], None]] = []

    def attach(self, sink: Sink) -> None:
        """Add a sink; it receives the kept messages immediately."""
        with self._lock:
            self._sinks.append(sink)
            known = tuple(self._newest.values())
        if known:
            sink.send(known)

    def publish(self, messages: Iterable[Message]) -> None:
        """Hand messages on; those of one moment go together."""
        batch = tuple(messages)
        with self._lock:
            self._newest.update((message.topic, message) for message in batch)
            sinks = tuple(self._sinks)
        for sink in sinks:
            sink.send(batch)

    def newest(self) -> dict[str, Message]:
        """Return the newest message of each topic."""
        with self._lock:
            return dict(self._newest)

    def listen(self, listener: Callable[[Message, str], None]) -> None:
        """Call listener(message, who) for messages of viewers, in their thread, so it must not block."""
        with self._lock:
            self._listeners.append(listener)

    def received(self, message: Message, who: str) -> None:
        """Pass on a message of a viewer."""
        with self._lock:
            listeners = tuple(self._listeners)
        for listener in listeners:
            listener(message, who)

    def close(self) -> None:
        """Close all sinks."""
        with self._lock:
            sinks, self._sinks = tuple(self._sinks), []
        for sink in sinks:
            sink.close()
