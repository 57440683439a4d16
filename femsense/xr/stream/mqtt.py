"""MQTT: a client for any broker, and an embedded broker for this machine."""

from __future__ import annotations

import contextlib
import logging
import socket
import ssl
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, RLock
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from femsense.core.errors import InputError
from femsense.core.packages import needed
from femsense.xr.stream.access import Access
from femsense.xr.stream.connecting import NO_ANSWER, NO_BROKER, not_let_in, why_not
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.packet_limit import PacketLimit
from femsense.xr.stream.payloads import PREFIX, RECEIVED, Kind, status_bytes, topic
from femsense.xr.stream.server_thread import ServerThread

if TYPE_CHECKING:
    from paho.mqtt.client import Client

PLAIN_PORT, TLS_PORT = 1883, 8883
WANTED = tuple(f"{PREFIX}/+/{kind}" for kind in RECEIVED)
"""Topics that clients of a broker may send to us."""


@dataclass(frozen=True, slots=True)
class BrokerAddress:
    """Address and credentials of a broker."""

    host: str
    port: int = PLAIN_PORT
    user: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: bool = False
    authority: Path | None = None
    """Certificate that the broker's own is checked against, PEM; None: those that the machine trusts."""


def broker_address(text: str, *, password: str | None = None, authority: Path | None = None) -> BrokerAddress:
    """Return the parts of `HOST`, `HOST:PORT` or `mqtt[s]://[USER[:PASSWORD]@]HOST[:PORT]`. Raises InputError."""
    parts = urlsplit(text if "://" in text else f"mqtt://{text}")
    try:
        port = parts.port
    except ValueError:
        port = 0
    tls = parts.scheme == "mqtts"
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or port == 0:
        raise InputError("not a broker", where="--mqtt", found=text, expected="HOST:PORT, mqtt://… or mqtts://…")
    user = unquote(parts.username) if parts.username else ("femsense" if password else None)
    known = unquote(parts.password) if parts.password else password
    return BrokerAddress(parts.hostname, port or (TLS_PORT if tls else PLAIN_PORT), user, known, tls, authority)


class MqttLink(ABC):
    """A client of a broker that reconnects by itself."""

    def __init__(self, address: BrokerAddress, topics: Sequence[str]) -> None:
        """Prepare a client that listens to the topics that filters name. Raises MissingDependency."""
        self._address, self._topics = address, topics
        self._client = make_client(address)
        self.connected, self.was_connected = Event(), False
        self.answered = Event()
        """Set when the broker has accepted or refused the client."""
        self._why = NO_ANSWER
        self._is_refused = False
        self._client.on_connect, self._client.on_connect_fail = self._greet, self._fail
        self._client.on_disconnect = self._leave
        self._client.on_message = lambda _c, _d, got: self._hear(Message(got.topic, bytes(got.payload)), kept=bool(got.retain))

    def _begin(self) -> None:
        """Connect in the background."""
        self._client.connect_async(self._address.host, self._address.port, keepalive=5)
        self._client.loop_start()

    @property
    def trouble(self) -> str:
        """Why there is no connection; empty with one."""
        return "" if self.connected.is_set() else self._why

    def close(self) -> None:
        """Disconnect cleanly, so that the last will is not sent."""
        self._client.disconnect()
        self._client.loop_stop()

    @abstractmethod
    def _hear(self, message: Message, *, kept: bool) -> None:
        """Take a message; `kept`: the broker had it from earlier."""

    def _greet(self, client: Client, _data: Any, _flags: Any, reason: Any, _more: Any) -> None:
        self._is_refused = bool(reason.is_failure)
        if self._is_refused:
            is_password = any(word in str(reason).lower() for word in ("password", "not authorized"))
            self._why = not_let_in(password=self._address.password is not None) if is_password else str(reason)
        else:
            client.subscribe([(one, 0) for one in self._topics])
            self.connected.set()
            self.was_connected = True
        self.answered.set()

    def _fail(self, _client: Any, _data: Any) -> None:
        error = sys.exc_info()[1]  # paho calls this while it handles the system's exception
        self._why = NO_ANSWER if error is None else why_not(error, tls=self._address.tls, password=False)

    def _leave(self, *_: object) -> None:
        if not self._is_refused:
            self._why = NO_ANSWER if self.connected.is_set() or self._address.tls else NO_BROKER
        self._is_refused = False
        self.connected.clear()


class MqttSink(MqttLink):
    """Sends a hub's messages to a broker.

    Without a connection no messages are queued: retained ones are sent again after reconnection, others are outdated by then. If the
    program ends unexpectedly, the broker reports the first robot as lost (last will).
    """

    def __init__(self, hub: Hub, address: BrokerAddress, robot: str) -> None:
        """Connect in the background, for the robot whose loss the broker is to announce. Raises MissingDependency."""
        super().__init__(address, WANTED)
        self.hub = hub
        self._client.will_set(topic(robot, Kind.STATUS), status_bytes("lost"), qos=0, retain=True)
        self._waiting: dict[str, Message] = {}
        self._sending: int | None = None
        """paho's number of the last message that it has and has not written yet."""
        self._lock = RLock()
        self._client.on_publish = self._written
        self._packets = PacketLimit(f"{address.host}:{address.port}")
        self._begin()
        hub.attach(self)

    def send(self, messages: tuple[Message, ...]) -> None:
        """Pass messages to the broker if it is connected; does not block.

        While earlier messages are pending, the newest of each topic waits; retained messages are never dropped.
        """
        if not self.connected.is_set():
            return
        with self._lock:
            self._waiting.update((message.topic, message) for message in messages)
            if self._sending is None or any(message.retained for message in messages):
                self._send_waiting()

    def _send_waiting(self) -> None:
        """Hand what waits to paho, with the lock held."""
        for message in self._waiting.values():
            self._sending = self._client.publish(message.topic, message.payload, qos=0, retain=message.retained).mid
        self._waiting = {}

    def _written(self, _client: Any, _data: Any, number: int, *_more: Any) -> None:
        with self._lock:
            if number == self._sending:
                self._sending = None
                self._send_waiting()

    def _hear(self, message: Message, *, kept: bool) -> None:
        """Pass on messages of others. Retained ones are no current requests and are ignored, except a stop."""
        if not kept or message.kind == Kind.STOP:
            self.hub.received(message, "MQTT")

    def _greet(self, *told: Any) -> None:
        with self._lock:  # what others send meanwhile comes after the model
            self._waiting, self._sending = {}, None
            super()._greet(*told)
            if self.connected.is_set():
                self.send(self._packets.fitting(tuple(message for message in self.hub.newest().values() if message.retained)))

    def _leave(self, *told: object) -> None:
        self._packets.ended()
        super()._leave(*told)


class MqttSource(MqttLink):
    """Receives a stream from a broker."""

    def __init__(
        self,
        address: BrokerAddress,
        receive: Callable[[Message], None],
        *,
        topics: Sequence[str] = (f"{PREFIX}/#",),
        lost: Callable[[], None] = lambda: None,
        kept: bool = True,
    ) -> None:
        """Call receive(message) in a separate thread for topics that match the filters, and lost() when the broker disconnects.

        `kept`: include retained messages. Raises MissingDependency.
        """
        super().__init__(address, topics)
        self._receive, self._lost, self._kept = receive, lost, kept
        self._begin()

    def send(self, message: Message) -> None:
        """Publish a message."""
        self._client.publish(message.topic, message.payload, qos=0)

    def _hear(self, message: Message, *, kept: bool) -> None:
        if self._kept or not kept:
            self._receive(message)

    def _leave(self, *_: object) -> None:
        super()._leave()
        self._lost()


def lets_anybody_in(address: BrokerAddress, timeout_s: float = 3.0) -> bool | None:
    """Return whether a broker accepts a client without a name and password; None if it does not answer in time [s]."""
    if address.user is None:
        return True
    stranger = MqttSource(replace(address, user=None, password=None), lambda _: None)
    answered = stranger.answered.wait(timeout_s)
    accepted = stranger.was_connected
    stranger.close()
    return accepted if answered else None


def make_client(address: BrokerAddress) -> Client:
    """Return a client that is not connected yet. Raises MissingDependency, InputError."""
    needed("paho.mqtt.client", "xr", "MQTT")
    from paho.mqtt.client import Client
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2)
    client.reconnect_delay_set(0.2, 5.0)  # type: ignore[arg-type]
    client.on_socket_open = _without_delay
    if address.user is not None:
        client.username_pw_set(address.user, address.password)
    if address.tls:
        try:
            client.tls_set_context(ssl.create_default_context(cafile=address.authority))
        except (OSError, ssl.SSLError) as error:
            raise InputError("not a certificate", where=address.authority, found=error, expected="a PEM file") from None
    return client


def _without_delay(_client: Any, _data: Any, endpoint: Any) -> None:
    """Send small messages at once (Nagle's rule would hold them up to 40 ms)."""
    with contextlib.suppress(OSError, AttributeError):
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


class EmbeddedBroker(ServerThread):
    """A broker in this program, for clients on this machine unless a password is set; a sink of a hub:
    messages reach clients in one step."""

    def __init__(self, hub: Hub, *, port: int = PLAIN_PORT, access: Access | None = None) -> None:
        """Start to serve. Raises MissingDependency, InputError if the port is taken.

        Arguments:
            hub: its messages are sent to clients; requests and measurements of clients go to it.
            port: 0 selects a free one.
            access: address, password and TLS certificate; by default 127.0.0.1 without a password.
        """
        needed("amqtt.broker", "xr", "a broker")
        super().__init__("femsense-broker")
        self.port = port or _free_port()
        self._access, self._hub = access or Access(), hub
        self._access.tls()  # raises early if the certificate is invalid
        self._broker: Any = None
        self._arrived: set[str] = set()
        hint = "--mqtt HOST, if one runs there"
        self._start("the broker cannot be served", where=f"port {port}", hint=hint)
        hub.attach(self)

    def send(self, messages: tuple[Message, ...]) -> None:
        """Hand messages to clients; returns at once."""
        self._call(self._broker.hand_out, messages)

    @property
    def clients(self) -> int:
        """Number of different clients that were accepted."""
        return len(self._arrived)

    # ---- in the thread of the broker

    async def _open(self) -> None:
        from femsense.xr.stream.broker_guests import NewestToEach

        for name in ("amqtt", "transitions"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        guests = {"receive": self._hear, "arrived": self._arrived.add, "password": self._access.password or ""}
        listener: dict[str, Any] = {"type": "tcp", "bind": f"{self._access.host}:{self.port}", "max_connections": 64}
        if self._access.certificate is not None:
            key = self._access.key or self._access.certificate
            listener |= {"ssl": True, "certfile": str(self._access.certificate), "keyfile": str(key)}
        settings = {"listeners": {"default": listener}, "plugins": {"femsense.xr.stream.broker_guests.Guests": guests}}
        self._broker = NewestToEach(settings)
        await self._broker.start()

    async def _shut(self) -> None:
        await self._broker.shutdown()

    def _hear(self, message: Message, who: str) -> None:
        if message.kind in RECEIVED:
            self._hub.received(message, who)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
