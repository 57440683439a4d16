"""Where goes what the libraries beneath say of connections that break off: to the log `femsense.stream`, which prints nothing by itself.

A client that hangs up, or fails a handshake, is no error of the program. Why there is no connection is said in words (`connecting`).
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
    """Have the log told what tasks of a loop raise that nobody waits for; by itself the loop would print it."""

    def tell(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        stream_log().error(context["message"], exc_info=context.get("exception"))

    loop.set_exception_handler(tell)
