"""The embedded broker, who may use it, and what it hears from them: a plugin of amqtt, which loads this module by its name."""

from __future__ import annotations

import hmac
from dataclasses import dataclass, field
from typing import Any

from amqtt.broker import Broker
from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import ApplicationMessage, Session

from femsense.xr.stream.hub import Message


class EachOnce(Broker):  # type: ignore[misc]
    """amqtt's broker, which gives a client what is kept for its own subscriptions only.

    amqtt 0.12 gives a client at its connection what is kept for the filters of all others too: it comes again once the client
    has subscribed, and even what it never asked for.
    """

    async def _publish_retained_messages_for_subscription(self, subscription: tuple[str, int], session: Session) -> None:
        if any(owner is session for owner, _ in self._subscriptions.get(subscription[0], ())):
            await super()._publish_retained_messages_for_subscription(subscription, session)


class Guests(BaseAuthPlugin):  # type: ignore[misc]
    """Lets in who knows the password, any user name; hands on what guests publish."""

    async def authenticate(self, *, session: Session) -> bool:
        """Return whether a client may connect."""
        wanted = self.config.password
        given = str(session.password or "")
        return not wanted or hmac.compare_digest(given.encode(), wanted.encode())

    async def on_broker_client_connected(self, *, client_id: str, client_session: Session) -> None:
        """Tell that a client is there."""
        self.config.arrived(client_id)

    async def on_broker_message_received(self, *, client_id: str, message: ApplicationMessage) -> None:
        """Hand on a message of a client."""
        self.config.receive(Message(message.topic, bytes(message.data or b"")), client_id)

    @dataclass
    class Config:
        """What the broker knows of its guests."""

        receive: Any
        """Called with a message and the client's name."""
        arrived: Any
        """Called with the name of a client that was let in."""
        password: str = field(default="", repr=False)
