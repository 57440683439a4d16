"""Logging of library messages on broken connections: they go to the log `femsense.stream`, which prints nothing by default.

A client that disconnects, or fails a handshake, is not an error of the program. `connecting` reports why there is no connection.
"""

from __future__ import annotations

import logging


def stream_log() -> logging.Logger:
    """Return the log."""
    log = logging.getLogger("femsense.stream")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
        log.propagate = False
    return log
