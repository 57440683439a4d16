"""Brings a stream from elsewhere into a hub of this machine: from a WebSocket of femsense, or from a broker."""

from __future__ import annotations

import base64
import contextlib
import ssl
import urllib.request
from collections.abc import Callable, Collection
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from femsense.core.errors import InputError
from femsense.xr.stream.connecting import NO_ANSWER, why_not
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import MqttSource, broker_address
from femsense.xr.stream.payloads import GLB, MODEL, RECEIVED, STATUS, read_document, split_topic, status_bytes, topic
from femsense.xr.stream.quiet import stream_log
from femsense.xr.stream.websocket import pack, require_websockets, unpack

if TYPE_CHECKING:
    from websockets.sync.connection import Connection

LARGEST_MESH = 64 << 20
"""Bytes of a mesh that is taken from elsewhere."""
AGAIN_S = (0.2, 0.5, 1.0, 2.0)
"""How long to wait before the next attempt to connect [s]; the last for all further ones."""


class Bridge:
    """Keeps a hub supplied from a URL, for as long as it takes; what viewers send goes the other way."""

    def __init__(self, hub: Hub, url: str, *, password: str | None = None, authority: Path | None = None) -> None:
        """Connect in the background.

        Arguments:
            hub: that is supplied.
            url: http(s):// or ws(s):// of `femsense stream`, or mqtt(s)://HOST[:PORT] of a broker.
            password: of the server or the broker.
            authority: certificate that theirs is checked against, PEM; None: those that the machine trusts.

        Raises:
            InputError: not such a URL.
            MissingDependency: the package for it is not installed.
        """
        self.hub = hub
        self._stop = Event()
        self._robots: set[str] = set()
        scheme = urlsplit(url).scheme
        if scheme in ("mqtt", "mqtts"):
            address = broker_address(url, password=password, authority=authority)
            at = f"{address.host}:{address.port}"
            source = MqttSource(address, self._from_broker, lost=lambda: self.lost(self._robots, at))
            self._send: Callable[[Message], None] = source.send
            self._close: Callable[[], None] = source.close
            self._trouble: Callable[[], str] = lambda: source.trouble
        elif scheme in ("http", "https", "ws", "wss"):
            viewer = _Viewer(self, url, password, authority)
            self._send, self._close = viewer.send, viewer.close
            self._trouble = lambda: viewer.trouble
        else:
            raise InputError("not a stream", where="--stream", found=url, expected="http://…, ws://…, mqtt://…, or with s")
        hub.listen(self._back)

    @property
    def trouble(self) -> str:
        """Why there is no connection; empty where there is one."""
        return self._trouble()

    def close(self) -> None:
        """Leave."""
        self._stop.set()
        self._close()

    def _back(self, message: Message, _who: str) -> None:
        known = split_topic(message.topic)
        if known is not None and known[1] in RECEIVED:
            self._send(message)

    def _from_broker(self, message: Message) -> None:
        known = split_topic(message.topic)
        if known is not None and known[1] not in RECEIVED:
            self._robots.add(known[0])
            self.hub.publish([message])

    def lost(self, robots: Collection[str], where: str) -> None:
        """Say of robots that there is no connection any more; those that have ended said so before."""
        newest = {robot: self.hub.newest().get(topic(robot, STATUS)) for robot in robots}
        states = {robot: read_document(told.payload) or {} for robot, told in newest.items() if told is not None}
        gone = [robot for robot in robots if states.get(robot, {}).get("state") != "ended"]
        self.hub.publish([Message(topic(robot, STATUS), status_bytes("lost", where)) for robot in gone])


class _Viewer:
    """A viewer of another femsense: reads its WebSocket, fetches its meshes, comes back when it was gone."""

    def __init__(self, bridge: Bridge, url: str, password: str | None, authority: Path | None) -> None:
        require_websockets()
        parts = urlsplit(url)
        secure = parts.scheme in ("https", "wss")
        self._bridge, self._at = bridge, parts.netloc
        self._secure = secure
        self._tls = ssl.create_default_context(cafile=authority) if secure else None
        self._headers = {}
        if password:
            word = base64.b64encode(f"femsense:{password}".encode()).decode()
            self._headers["Authorization"] = f"Basic {word}"
        self._connection: Connection | None = None
        self.trouble = NO_ANSWER
        self._stop = Event()
        self._known: dict[str, str] = {}
        Thread(target=self._run, daemon=True, name="femsense-bridge").start()

    def send(self, message: Message) -> None:
        connection = self._connection
        if connection is not None:
            with contextlib.suppress(Exception):  # gone meanwhile: what is old is not sent again
                connection.send(pack([message]))

    def close(self) -> None:
        self._stop.set()
        connection = self._connection
        if connection is not None:
            Thread(target=connection.close, daemon=True).start()

    def _run(self) -> None:
        from websockets.exceptions import WebSocketException

        attempt = 0
        while not self._stop.is_set():
            try:
                self._read()
                attempt, self.trouble = 0, NO_ANSWER
            except (OSError, WebSocketException, EOFError, InputError) as error:
                self.trouble = why_not(error, tls=self._secure, password="Authorization" in self._headers)
            self._connection = None
            self._bridge.lost(list(self._known), self._at)
            self._stop.wait(AGAIN_S[min(attempt, len(AGAIN_S) - 1)])
            attempt += 1

    def _read(self) -> None:
        from websockets.sync.client import connect

        address = f"{'wss' if self._secure else 'ws'}://{self._at}/ws"
        more: dict[str, Any] = {"ssl": self._tls} if self._secure else {}
        more |= {"compression": None, "max_size": LARGEST_MESH, "open_timeout": 5, "proxy": None, "logger": stream_log()}
        with connect(address, additional_headers=self._headers, **more) as connection:
            self._connection, self.trouble = connection, ""
            for frame in connection:
                if isinstance(frame, bytes):
                    self._take(list(unpack(frame)))

    def _take(self, messages: list[Message]) -> None:
        meshes = []
        for message in messages:
            known = split_topic(message.topic)
            if known is not None and known[1] == MODEL:
                meshes += self._mesh(known[0], message)
        self._bridge.hub.publish([*meshes, *messages])

    def _mesh(self, robot: str, model: Message) -> list[Message]:
        """Return the mesh of a model unless it is there already."""
        digest = str((read_document(model.payload) or {}).get("glb_sha256", ""))
        if self._known.get(robot) == digest and digest:
            return []
        address = f"{'https' if self._secure else 'http'}://{self._at}/robots/{robot}.glb"
        request = urllib.request.Request(address, headers=self._headers)
        with urllib.request.urlopen(request, timeout=10, context=self._tls) as answer:
            glb = answer.read(LARGEST_MESH)
        self._known[robot] = digest
        return [Message(topic(robot, GLB), glb)]
