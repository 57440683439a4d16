"""A slot for the newest item between two threads: live inputs are never queued."""

from __future__ import annotations

import time
from threading import Condition
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """Holds one item; a newer one replaces it. Safe for any number of writers and readers.

    A queue between a fast source and a slow consumer grows, and with it the age of what the consumer sees. A slot bounds that age by
    the time of one step of the consumer.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._items: list[T] = []  # none or one: an item may itself be None
        self.dropped = 0
        """Number of items that were replaced before anybody took them."""

    def put(self, item: T) -> None:
        """Replace the item; returns immediately."""
        with self._changed:
            self.dropped += len(self._items)
            self._items = [item]
            self._changed.notify()

    def take(self, timeout_s: float) -> T | None:
        """Return the item and empty the slot; None where nothing comes within a time [s]."""
        end = time.monotonic() + timeout_s
        with self._changed:
            while not self._items:
                if not self._changed.wait(max(0.0, end - time.monotonic())) and not self._items:
                    return None
            return self._items.pop()
