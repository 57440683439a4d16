"""Access control and messages of the embedded broker: a plugin of amqtt, which loads this module by its name."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any

from amqtt.broker import Broker
from amqtt.errors import AMQTTError, MQTTError
from amqtt.plugins.base import BaseAuthPlugin
from amqtt.session import ApplicationMessage, Session

from femsense.xr.stream.hub import Message


class NewestToEach(Broker):  # type: ignore[misc]
    """amqtt's broker, without queues to its clients: of each topic the newest message waits for a client.

    amqtt 0.12 queues all messages to all clients: under a flood from one of them, the others receive commands seconds late.

    Retained messages are sent to a client for its own subscriptions only. On connection, amqtt 0.12 also sends it those for the
    filters of all others: duplicates of what its own subscriptions bring, and topics without a subscription.
    """

    def __init__(self, settings: dict[str, Any]) -> None:
        super().__init__(settings)
        self._waiting: dict[str, dict[str, tuple[bytes, int]]] = {}  # client → topic → message and quality of service
        self._deliveries: set[asyncio.Task[None]] = set()

    def hand_out(self, messages: tuple[Message, ...]) -> None:
        """Start to deliver messages of this program."""
        self._begin(self._hand_out(messages))

    async def _hand_out(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            if message.retained:
                await self.retain_message(None, message.topic, message.payload, 0)
            await self.internal_message_broadcast(message.topic, message.payload, 0)

    def _begin(self, delivery: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(delivery)
        self._deliveries.add(task)
        task.add_done_callback(self._deliveries.discard)

    async def _broadcast_message(self, _from: Session | None, topic: str, data: bytes | None, qos: int | None = None) -> None:
        """Start to deliver a message to the clients that have subscribed to it; while one is busy, its message waits."""
        targets = [pair for wanted, pairs in self._subscriptions.items() if self._matches(topic, wanted) for pair in pairs]
        for target, asked in targets:
            if target.transitions.state != "connected":
                continue
            is_idle = target.client_id not in self._waiting
            self._waiting.setdefault(target.client_id, {})[topic] = (bytes(data or b""), asked if qos is None else qos)
            if is_idle:
                self._begin(self._deliver(target))

    async def _deliver(self, target: Session) -> None:
        waiting = self._waiting[target.client_id]
        try:
            while waiting and (handler := self._get_handler(target)) is not None:
                topic = next(iter(waiting))
                data, qos = waiting.pop(topic)
                with contextlib.suppress(AMQTTError, MQTTError, OSError):  # the client has left
                    await handler.mqtt_publish(topic, data, qos, retain=False)
        finally:
            del self._waiting[target.client_id]

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
