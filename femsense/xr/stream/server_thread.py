"""A server with its asyncio loop in a thread of its own."""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from threading import Event, Thread
from typing import Any

from femsense.xr.stream.quiet import stream_log

LEAVE_S = 3.0
"""Time that clients have to leave when a server ends [s]."""


class ServerThread(ABC):
    """Opens a server in a thread of its own, and shuts it down at the end."""

    def __init__(self, name: str) -> None:
        """name: of the thread."""
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_noted)
        self._finish = asyncio.Event()
        self._failed: BaseException | None = None
        self._ready = Event()
        self._thread = Thread(target=self._run, daemon=True, name=name)

    def close(self) -> None:
        """Let clients go and free the port."""
        self._call(self._finish.set)
        self._thread.join(5.0)

    def _start(self) -> BaseException | None:
        """Open the server, and return why it cannot serve; None where it does."""
        self._thread.start()
        self._ready.wait()
        return self._failed

    def _call(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function in the thread of the server; returns at once."""
        with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
            self._loop.call_soon_threadsafe(function, *arguments)

    # ---- in the thread of the server

    @abstractmethod
    async def _open(self) -> None:
        """Begin to serve."""

    @abstractmethod
    async def _shut(self) -> None:
        """Serve no more."""

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        try:
            await self._open()
        except Exception as error:  # amqtt wraps system errors in its own classes
            self._failed = error.__cause__ or error
        self._ready.set()
        if self._failed is None:
            await self._finish.wait()
            with contextlib.suppress(Exception):
                await asyncio.wait_for(self._shut(), LEAVE_S)
        for task in asyncio.all_tasks() - {asyncio.current_task()}:
            task.cancel()


def _noted(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an exception of a background task, which would otherwise be printed."""
    stream_log().error(context["message"], exc_info=context.get("exception"))
