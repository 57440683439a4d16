"""A client of a remote WebSocket that reconnects by itself."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from threading import Event
from typing import TYPE_CHECKING, Any

from femsense.core.errors import InputError
from femsense.xr.stream.connecting import NO_ANSWER, why_not
from femsense.xr.stream.server_thread import stream_log
from femsense.xr.stream.websocket import require_websockets

if TYPE_CHECKING:
    from websockets.sync.connection import Connection

WAIT_S = 0.1
AGAIN_S = (0.2, 0.5, 1.0, 2.0)
"""How long to wait before the next attempt to connect [s]; the last for all further ones."""


class WebSource:
    """Hands on the frames of a WebSocket one by one; none waits here while another is handled."""

    def __init__(
        self, url: str, *, headers: Mapping[str, str] | None = None, lost: Callable[[], None] = lambda: None, **more: Any
    ) -> None:
        """Prepare; no connection is opened yet.

        Arguments:
            url: ws:// or wss://.
            headers: of the request.
            lost: called at the end of each connection or attempt.
            more: arguments of `websockets.sync.client.connect`.

        Raises:
            MissingDependency: the package websockets is not installed.
        """
        require_websockets()
        self._url, self._headers, self._lost, self._more = url, dict(headers or {}), lost, more
        self._connection: Connection | None = None
        self.away = NO_ANSWER
        """Why there is no connection; empty with one."""

    def run(self, receive: Callable[[bytes], None], stop: Event) -> None:
        """Call receive(frame), text as UTF-8, until `stop` is set; an InputError or OSError of it ends the connection."""
        from websockets.exceptions import WebSocketException

        attempt = 0
        while not stop.is_set():
            try:
                self._read(receive, stop)
                attempt, self.away = 0, NO_ANSWER
            except (OSError, WebSocketException, EOFError, InputError) as error:
                self.away = why_not(error, tls=self._url.startswith("wss"), password="Authorization" in self._headers)
            self._connection = None
            self._lost()
            stop.wait(AGAIN_S[min(attempt, len(AGAIN_S) - 1)])
            attempt += 1

    def send(self, frame: bytes) -> None:
        """Send a frame if connected; without a connection it is dropped as outdated."""
        if (connection := self._connection) is not None:
            with contextlib.suppress(Exception):  # gone meanwhile
                connection.send(frame)

    def _read(self, receive: Callable[[bytes], None], stop: Event) -> None:
        from websockets.exceptions import ConnectionClosed
        from websockets.sync.client import connect

        known: dict[str, Any] = {"compression": None, "open_timeout": 5, "proxy": None, "max_queue": 1, "logger": stream_log()}
        with connect(self._url, additional_headers=self._headers, **known, **self._more) as connection:
            self._connection, self.away = connection, ""
            while not stop.is_set():
                try:
                    frame = connection.recv(WAIT_S)
                except TimeoutError:
                    continue
                except ConnectionClosed:
                    return
                receive(frame.encode() if isinstance(frame, str) else frame)
