"""Brokers that disconnect on packets above their size limit: such packets are left out, with a warning."""

from __future__ import annotations

import math
import time
import warnings

from femsense.xr.stream.hub import Message

SOON_S = 3.0
"""A broker that refuses a packet closes the connection this soon after it was greeted [s]."""
TIMES = 2
"""Number of consecutive disconnections after which the packet size is the likely cause."""
SMALLEST = 1024
"""No broker has a limit below this [bytes]."""


class PacketLimit:
    """The size of packets that one broker takes, by how its connections end."""

    def __init__(self, broker: str) -> None:
        """broker: its name in the warning."""
        self.broker = broker
        self.limit = math.inf
        """Packets of this size and more are left out [bytes]."""
        self._largest, self._ends, self._greeted = 0, 0, -math.inf

    def fitting(self, messages: tuple[Message, ...]) -> tuple[Message, ...]:
        """Return the messages to send to a broker after a connection."""
        fits = tuple(message for message in messages if len(message.payload) < self.limit)
        self._largest = max((len(message.payload) for message in fits), default=0)
        self._greeted = time.monotonic()
        return fits

    def ended(self) -> None:
        """Record a disconnection; warn if the largest packet is the likely cause, and leave it out from then on."""
        self._ends = self._ends + 1 if time.monotonic() - self._greeted < SOON_S else 0
        if self._ends < TIMES or self._largest < SMALLEST:
            return
        self.limit, self._ends = self._largest, 0
        warnings.warn(
            f"the broker {self.broker} closes the connection after a packet of {self._largest} bytes (the mesh): has it a limit "
            "(max_packet_size)? Poses go on without it",
            stacklevel=2,
        )
