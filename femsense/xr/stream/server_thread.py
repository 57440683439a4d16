"""A server with its asyncio loop in a thread of its own, and the log of libraries on broken connections."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from threading import Thread
from typing import Any

from femsense.core.errors import InputError

LEAVE_S = 3.0
"""Time that clients have to leave when a server ends [s]."""


class ServerThread(ABC):
    """Opens a server in a thread of its own, and shuts it down at the end."""

    def __init__(self, name: str) -> None:
        """name: of the thread."""
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_noted)
        self._thread = Thread(target=self._run, daemon=True, name=name)

    def close(self) -> None:
        """Let clients go and free the port."""
        if self._thread.is_alive():
            with contextlib.suppress(TimeoutError):
                asyncio.run_coroutine_threadsafe(self._finish(), self._loop).result(LEAVE_S + 1.0)
            self._call(self._loop.stop)
            self._thread.join(1.0)

    def _start(self, trouble: str, *, where: str, hint: str) -> None:
        """Open the server. Raises InputError with these words if it cannot serve."""
        self._thread.start()
        try:
            asyncio.run_coroutine_threadsafe(self._open(), self._loop).result()
        except Exception as error:  # amqtt wraps system errors in its own classes
            self.close()
            raise InputError(trouble, where=where, found=error.__cause__ or error, hint=hint) from None

    def _call(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function in the thread of the server; returns at once."""
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            self._loop.call_soon_threadsafe(function, *arguments)

    def _run(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_forever()

    # ---- in the thread of the server

    @abstractmethod
    async def _open(self) -> None:
        """Begin to serve."""

    @abstractmethod
    async def _shut(self) -> None:
        """Serve no more."""

    async def _finish(self) -> None:
        with contextlib.suppress(Exception):
            await asyncio.wait_for(self._shut(), LEAVE_S)
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()


def _noted(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an exception of a background task, which would otherwise be printed."""
    stream_log().error(context["message"], exc_info=context.get("exception"))


def stream_log() -> logging.Logger:
    """Return the log `femsense.stream` of library messages on broken connections, which prints nothing by default.

    A client that disconnects, or fails a handshake, is not an error of the program. `connecting` reports why there is no connection.
    """
    log = logging.getLogger("femsense.stream")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
        log.propagate = False
    return log
