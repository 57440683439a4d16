"""The page and its WebSocket: one port, one thread, the newest message of each topic to every viewer.

A frame of the WebSocket contains one or more messages: topic length uint16, payload length uint32 (little-endian), topic, payload.
Each viewer has its own pending messages, one per topic: a slow viewer misses some and delays no other.

Sockets and libraries buffer seconds of poses. Therefore at most `IN_FLIGHT` frames are in transit to a viewer: further ones wait, newest only,
until one is confirmed. The page confirms a frame by an empty frame after processing it; for clients that do not, the reply to a ping after each
frame counts, which their library sends when it reads.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING

from femsense.core.errors import InputError
from femsense.core.packages import needed
from femsense.xr.stream.access import COOKIE, Access, same_origin
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import RECEIVED, Kind, topic
from femsense.xr.stream.server_thread import ServerThread, stream_log

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

ENTRY = struct.Struct("<HI")
SMALLEST_BUFFER = 1 << 16
"""Send buffer of a socket [bytes]: its content is outdated on arrival."""
IN_FLIGHT = 3
"""Number of frames that a viewer has not confirmed: 60 Hz need two with a round trip of 30 ms."""
LARGEST_FRAME, MOST_FRAMES = 4096, 240
"""Limits on messages of a viewer: bytes per frame, and frames per second."""
ASKED_BY_PAGE = ("/ws", "/stream.json")
"""Paths that a page requests repeatedly: it shows a refused password itself, without a dialog of the browser each time."""
PASSWORD_NEEDED = b"""<!doctype html><meta name="viewport" content="width=device-width"><title>femsense</title>
<p>A password is needed: load the page again and type that of the stream, with any user name.</p>
"""
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".glb": "model/gltf-binary",
    ".txt": "text/plain; charset=utf-8",
}


@dataclass(frozen=True, slots=True)
class ServerOptions:
    """Limits of the server."""

    port: int = 0
    """0 takes a free one."""
    most_viewers: int = 64
    ping_s: float = 10.0
    """A viewer that does not answer within this time twice is let go."""


def pack(messages: Iterable[Message]) -> bytes:
    """Return messages as one frame."""
    parts = []
    for message in messages:
        name = message.topic.encode()
        parts += [ENTRY.pack(len(name), len(message.payload)), name, message.payload]
    return b"".join(parts)


def unpack(frame: bytes) -> Iterator[Message]:
    """Yield the messages of a frame. Raises InputError if it is truncated."""
    at = 0
    while at < len(frame):
        try:
            name, size = ENTRY.unpack_from(frame, at)
            body = at + ENTRY.size + name
            if body + size > len(frame):
                raise ValueError
            yield Message(frame[at + ENTRY.size : body].decode(), frame[body : body + size])
        except (struct.error, ValueError):
            raise InputError("not a frame of messages", where=f"byte {at}", found=f"{len(frame)} bytes") from None
        at = body + size


class _Viewer:
    """Pending and unconfirmed messages of one viewer."""

    def __init__(self) -> None:
        self.waiting: dict[str, Message] = {}
        self.wake = asyncio.Event()
        self.sent = self.confirmed = self._answered = 0

    def offer(self, messages: Iterable[Message]) -> None:
        self.waiting.update((message.topic, message) for message in messages if message.kind != Kind.GLB)
        self.wake.set()

    def confirm(self) -> bool:
        """Take note that a frame was handled; return whether there was one to confirm."""
        if self.confirmed >= self.sent:
            return False
        self.confirmed += 1
        self.wake.set()
        return True

    def answer(self, pong: asyncio.Future[float]) -> None:
        """Take note of the answer to a ping; one that never came, since the viewer left, is no error."""
        self._answered += not pong.cancelled() and pong.exception() is None
        self.wake.set()

    def take(self) -> list[Message]:
        """Return the messages that may be sent now."""
        self.wake.clear()
        if self.sent - (self.confirmed or self._answered) >= IN_FLIGHT:
            return []
        taken, self.waiting = list(self.waiting.values()), {}
        return taken


class WebSocketServer(ServerThread):
    """Serves the page, the meshes and `/ws` from a thread of its own; a sink of a hub."""

    def __init__(
        self, hub: Hub, page: Mapping[str, bytes | Path], *, access: Access | None = None, options: ServerOptions | None = None
    ) -> None:
        """Start to serve.

        Arguments:
            hub: whose messages viewers get.
            page: name → content of the files of the page.
            access: who may watch.
            options: port and limits.

        Raises:
            InputError: the address cannot be used.
            MissingDependency: the package websockets is not installed.
        """
        require_websockets()
        super().__init__("femsense-websocket")
        self.hub, self.page = hub, page
        self.access, self.options = access or Access(), options or ServerOptions()
        self.port = 0
        self.trouble: Callable[[], str] = lambda: ""
        """Why the hub receives no data, for a page without a robot."""
        self.visits = 0
        """Number of viewers so far."""
        self._viewers: set[_Viewer] = set()
        self._tls = self.access.tls()
        where = f"{self.access.host}, port {self.options.port}"
        self._start("the stream cannot be served", where=where, hint="port 0 takes a free one")
        hub.attach(self)

    @property
    def url(self) -> str:
        """Address of the page."""
        host = "127.0.0.1" if self.access.host in ("0.0.0.0", "::", "localhost") else self.access.host
        return f"{self.access.scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"

    @property
    def viewers(self) -> int:
        """How many watch now."""
        return len(self._viewers)

    def send(self, messages: tuple[Message, ...]) -> None:
        """Hand messages to all viewers; returns at once."""
        self._call(self._hand_out, messages)

    # ---- in the thread of the server

    async def _open(self) -> None:
        from websockets.asyncio.server import serve

        self._server = await serve(
            self._attend,
            self.access.host,
            self.options.port,
            ssl=self._tls,
            process_request=self._answer,
            compression=None,
            max_size=LARGEST_FRAME,
            max_queue=8,
            write_limit=SMALLEST_BUFFER,
            ping_interval=self.options.ping_s,
            ping_timeout=self.options.ping_s,
            close_timeout=1.0,
            server_header=None,
            logger=stream_log(),
        )
        self.port = next(iter(self._server.sockets)).getsockname()[1]

    async def _shut(self) -> None:
        self._server.close()
        await self._server.wait_closed()

    def _hand_out(self, messages: tuple[Message, ...]) -> None:
        for viewer in self._viewers:
            viewer.offer(messages)

    async def _attend(self, connection: ServerConnection) -> None:
        """Read from one viewer until it disconnects; messages are sent to it concurrently."""
        endpoint = connection.transport.get_extra_info("socket")
        if endpoint is not None:
            endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SMALLEST_BUFFER)
        viewer = _Viewer()
        viewer.offer(self.hub.newest().values())
        self._viewers.add(viewer)
        self.visits += 1
        feeding = asyncio.create_task(_feed(connection, viewer))
        try:
            await self._listen(connection, viewer)
        finally:
            self._viewers.discard(viewer)
            feeding.cancel()

    async def _listen(self, connection: ServerConnection, viewer: _Viewer) -> None:
        """Pass on the requests of a viewer; invalid data and floods end the connection."""
        from websockets.exceptions import ConnectionClosed

        second, count = 0, 0
        with contextlib.suppress(ConnectionClosed):
            async for frame in connection:
                if not frame and viewer.confirm():
                    continue
                now = int(self._loop.time())
                second, count = (now, 1) if now != second else (second, count + 1)
                wanted = _wanted(frame) if count <= MOST_FRAMES else None
                if wanted is None:
                    await connection.close(1008, "not understood" if count <= MOST_FRAMES else "too much")
                    return
                self.hub.received(wanted, str(connection.id))

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file; None accepts a viewer."""
        headers, path = request.headers, request.path.partition("?")[0]
        host = headers.get("Host")
        reached_at = str(connection.transport.get_extra_info("sockname")[0])
        if not self.access.knows_host(host, reached_at) or not same_origin(headers.get("Origin"), host):
            return _response(HTTPStatus.FORBIDDEN, b"not from there\n")
        if not self.access.allows(headers.get("Authorization"), headers.get("Cookie")):
            await asyncio.sleep(0.3)  # slows down password guessing
            more = {"Content-Type": TYPES[".html"]}
            if path not in ASKED_BY_PAGE:
                more["WWW-Authenticate"] = 'Basic realm="femsense"'
            return _response(HTTPStatus.UNAUTHORIZED, PASSWORD_NEEDED, more)
        if path == "/ws":
            full = len(self._viewers) >= self.options.most_viewers
            return _response(HTTPStatus.SERVICE_UNAVAILABLE, b"too many viewers\n") if full else None
        content = self._content(path.lstrip("/") or "index.html")
        if content is None:
            return _response(HTTPStatus.NOT_FOUND, b"not here\n")
        more = {"Content-Type": TYPES.get(Path(path if path != "/" else "index.html").suffix, "application/octet-stream")}
        if self.access.password is not None:
            secure = "; Secure" if self.access.scheme == "https" else ""
            more["Set-Cookie"] = f"{COOKIE}={self.access.ticket}; HttpOnly; SameSite=Strict; Path=/{secure}"
        return _response(HTTPStatus.OK, content, more)

    def _content(self, name: str) -> bytes | None:
        """Return a file of the page, or the mesh of a robot; no other file is read."""
        if name.startswith("robots/") and name.endswith(".glb"):
            message = self.hub.newest().get(topic(name[len("robots/") : -len(".glb")], Kind.GLB))
            return None if message is None else message.payload
        if name == "stream.json":
            return json.dumps({"format": "femsense-stream-1", "trouble": self.trouble()}).encode()
        content = self.page.get(name)
        try:
            return content.read_bytes() if isinstance(content, Path) else content
        except OSError:
            return None


async def _feed(connection: ServerConnection, viewer: _Viewer) -> None:
    """Send to a viewer what waits for it, until it disconnects."""
    from websockets.exceptions import ConnectionClosed

    with contextlib.suppress(ConnectionClosed):
        while await viewer.wake.wait():
            if waiting := viewer.take():
                viewer.sent += 1
                await connection.send(pack(waiting))
                if not viewer.confirmed:
                    asyncio.ensure_future(await connection.ping()).add_done_callback(viewer.answer)


def _wanted(frame: str | bytes) -> Message | None:
    """Return the message of a viewer if viewers may send it."""
    if isinstance(frame, str):
        return None
    try:
        messages = list(unpack(frame))
    except InputError:
        return None
    return messages[0] if len(messages) == 1 and messages[0].kind in RECEIVED else None


def _response(status: HTTPStatus, body: bytes, more: Mapping[str, str] | None = None) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    headers = Headers(
        {
            "Content-Type": "text/plain; charset=utf-8",
            "Content-Length": str(len(body)),
            "Connection": "close",
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            **(more or {}),
        }
    )
    return Response(status.value, status.phrase, headers, body)


def require_websockets() -> None:
    """Raise MissingDependency if the package is not installed."""
    needed("websockets", "xr", "streaming")
