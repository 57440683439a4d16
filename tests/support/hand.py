"""A client that drags: it asks for the lease and quotes it, as the page does, and shares nothing with it."""

from __future__ import annotations

import json
from typing import Any

from femsense.xr.stream.hub import Hub, Message


class Hand:
    """Someone who drags a point of a robot, through a hub."""

    def __init__(self, hub: Hub, client: str = "me", *, robot: str = "bar", way: str = "") -> None:
        """way: how its messages come; by default of its own."""
        self.hub, self.client, self.robot, self.way = hub, client, robot, way or client
        self.seq, self.lease = 0, 0
        self.told: dict[str, Any] = {}
        self.wishes: list[Message] = []
        hub.attach(self)

    def send(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            if message.topic == f"femsense/{self.robot}/lease":
                self.told = json.loads(message.payload)
                self.lease = self.told["number"] if self.told["client"] == self.client else 0

    def close(self) -> None:
        pass

    def drag(self, target: Any, *, armed: bool = True, held: bool = True, handle: str = "tip") -> None:
        """Say once where the point is wanted."""
        self.seq += 1
        wish = {"client": self.client, "seq": self.seq, "lease": self.lease, "handle": handle, "held": held, "armed": armed}
        self.say("drag", {**wish, "target_m": dict(zip("xyz", map(float, target)))})

    def say(self, kind: str, document: dict[str, Any]) -> None:
        message = Message(f"femsense/{self.robot}/{kind}", json.dumps(document).encode())
        self.wishes.append(message)
        self.hub.received(message, self.way)
