"""Who may use the embedded broker, and what it hears from them: a plugin of amqtt, which loads this module by its name."""

from __future__ import annotations

import hmac
from dataclasses import dataclass, field
from typing import Any

from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import ApplicationMessage, Session

from femsense.xr.stream.hub import Message


class Guests(BaseAuthPlugin):  # type: ignore[misc]
    """Lets in who knows the password, any user name; hands on what guests publish."""

    async def authenticate(self, *, session: Session) -> bool:
        """Return whether a client may connect."""
        wanted = self.config.password
        given = str(session.password or "")
        return not wanted or hmac.compare_digest(given.encode(), wanted.encode())

    async def on_broker_message_received(self, *, client_id: str, message: ApplicationMessage) -> None:
        """Hand on a message of a client."""
        self.config.receive(Message(message.topic, bytes(message.data or b"")), client_id)

    @dataclass
    class Config:
        """What the broker knows of its guests."""

        receive: Any
        """Called with a message and the client's name."""
        password: str = field(default="", repr=False)
