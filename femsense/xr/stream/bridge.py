"""Forwards a remote stream, from a WebSocket of femsense or from a broker, into a hub of this machine."""

from __future__ import annotations

import base64
import ssl
import urllib.request
from collections.abc import Callable, Collection
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

from femsense.core.errors import InputError
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import MqttSource, broker_address
from femsense.xr.stream.payloads import RECEIVED, Kind, read_document, status_bytes, topic
from femsense.xr.stream.web_source import WebSource
from femsense.xr.stream.websocket import pack, unpack

LARGEST_MESH = 64 << 20
"""Largest mesh that is accepted [bytes]."""


class Bridge:
    """Forwards messages from a URL to a hub until closed; messages of viewers go in the opposite direction."""

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
            web = WebSource(viewer.socket, headers=viewer.headers, lost=viewer.lost, **viewer.options)

            def take(frame: bytes) -> None:
                viewer.take(frame)
                web.send(b"")  # confirmed: the next may come

            Thread(target=web.run, args=(take, self._stop), daemon=True, name="femsense-bridge").start()
            self._send, self._close = lambda message: web.send(pack([message])), lambda: None
            self._trouble = lambda: web.away
        else:
            raise InputError("not a stream", where="--stream", found=url, expected="http://…, ws://…, mqtt://…, or with s")
        hub.listen(self._back)

    @property
    def trouble(self) -> str:
        """Why there is no connection; empty with one."""
        return self._trouble()

    def close(self) -> None:
        """Disconnect."""
        self._stop.set()
        self._close()

    def _back(self, message: Message, _who: str) -> None:
        if message.kind in RECEIVED:
            self._send(message)

    def _from_broker(self, message: Message) -> None:
        if message.robot and message.kind not in RECEIVED:
            self._robots.add(message.robot)
            self.hub.publish([message])

    def lost(self, robots: Collection[str], where: str) -> None:
        """Report the lost connection for all robots except those that have ended."""
        newest = {robot: self.hub.newest().get(topic(robot, Kind.STATUS)) for robot in robots}
        states = {robot: read_document(told.payload) or {} for robot, told in newest.items() if told is not None}
        gone = [robot for robot in robots if states.get(robot, {}).get("state") != "ended"]
        self.hub.publish([Message(topic(robot, Kind.STATUS), status_bytes("lost", where)) for robot in gone])


class _Viewer:
    """A viewer of another femsense: takes its messages and fetches its meshes."""

    def __init__(self, bridge: Bridge, url: str, password: str | None, authority: Path | None) -> None:
        parts = urlsplit(url)
        secure = parts.scheme in ("https", "wss")
        self._bridge, self._at = bridge, parts.netloc
        self.socket = f"{'wss' if secure else 'ws'}://{self._at}/ws"
        self._pages = f"{'https' if secure else 'http'}://{self._at}"
        self._tls = ssl.create_default_context(cafile=authority) if secure else None
        self.options: dict[str, Any] = {"max_size": LARGEST_MESH, **({"ssl": self._tls} if secure else {})}
        word = base64.b64encode(f"femsense:{password}".encode()).decode()
        self.headers = {"Authorization": f"Basic {word}"} if password else {}
        self._known: dict[str, str] = {}

    def lost(self) -> None:
        self._bridge.lost(list(self._known), self._at)

    def take(self, frame: bytes) -> None:
        messages, meshes = list(unpack(frame)), []
        for message in messages:
            if message.kind == Kind.MODEL:
                meshes += self._mesh(message.robot, message)
        self._bridge.hub.publish([*meshes, *messages])

    def _mesh(self, robot: str, model: Message) -> list[Message]:
        """Return the mesh of a model unless it is there already."""
        digest = str((read_document(model.payload) or {}).get("glb_sha256", ""))
        if self._known.get(robot) == digest and digest:
            return []
        request = urllib.request.Request(f"{self._pages}/robots/{robot}.glb", headers=self.headers)
        with urllib.request.urlopen(request, timeout=10, context=self._tls) as answer:
            glb = answer.read(LARGEST_MESH)
        self._known[robot] = digest
        return [Message(topic(robot, Kind.GLB), glb)]
