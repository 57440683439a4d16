"""Access control and messages of the embedded broker: a plugin of amqtt, which loads this module by its name."""

from __future__ import annotations

import hmac
from dataclasses import dataclass, field
from typing import Any

from amqtt.broker import Broker
from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import ApplicationMessage, Session

from femsense.xr.stream.hub import Message


class EachOnce(Broker):  # type: ignore[misc]
    """amqtt's broker, with retained messages sent to a client for its own subscriptions only.

    On connection, amqtt 0.12 also sends a client the messages retained for the filters of all others: duplicates of what its own
    subscriptions bring, and topics without a subscription.
    """

    async def _publish_retained_messages_for_subscription(self, subscription: tuple[str, int], session: Session) -> None:
        if any(owner is session for owner, _ in self._subscriptions.get(subscription[0], ())):
            await super()._publish_retained_messages_for_subscription(subscription, session)


class Guests(BaseAuthPlugin):  # type: ignore[misc]
    """Accepts clients with the password, any user name; forwards messages that guests publish."""

    async def authenticate(self, *, session: Session) -> bool:
        """Return whether a client may connect."""
        wanted = self.config.password
        given = str(session.password or "")
        return not wanted or hmac.compare_digest(given.encode(), wanted.encode())

    async def on_broker_client_connected(self, *, client_id: str, client_session: Session) -> None:
        """Report a new client."""
        self.config.arrived(client_id)

    async def on_broker_message_received(self, *, client_id: str, message: ApplicationMessage) -> None:
        """Hand on a message of a client."""
        self.config.receive(Message(message.topic, bytes(message.data or b"")), client_id)

    @dataclass
    class Config:
        """Access settings and callbacks of the plugin."""

        receive: Any
        """Called with a message and the client's name."""
        arrived: Any
        """Called with the name of a client that was let in."""
        password: str = field(default="", repr=False)
