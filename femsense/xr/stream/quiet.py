"""Logging of library messages on broken connections: they go to the log `femsense.stream`, which prints nothing by default.

A client that disconnects, or fails a handshake, is not an error of the program. `connecting` reports why there is no connection.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Any


def stream_log() -> logging.Logger:
    """Return the log."""
    log = logging.getLogger("femsense.stream")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
        log.propagate = False
    return log


def keep_quiet(loop: asyncio.AbstractEventLoop) -> None:
    """Log exceptions of background tasks of a loop, which would otherwise be printed."""

    def tell(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        stream_log().error(context["message"], exc_info=context.get("exception"))

    loop.set_exception_handler(tell)
