"""From stamps of devices to the clock of this machine."""

from __future__ import annotations

DRIFT = 1e-4
"""Two quartz clocks drift apart by at most this share."""


class ClockMap:
    """Maps stamps of another clock to the monotonic clock of this machine by the fastest arrivals.

    offset = min over messages of (arrival − stamp): transport can delay a message and never speed it up, so that the smallest
    difference has the least delay in it. The minimum rises by DRIFT a second, so that it follows a clock that runs slower.
    The shortest transport delay itself cannot be observed and stays in the offset.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._at = 0.0

    def host_time(self, stamp_s: float, arrived_s: float) -> float:
        """Return when a stamp was, on the monotonic clock [s], given when its message arrived [s]."""
        found = arrived_s - stamp_s
        if self._offset is None:
            self._offset = found
        else:
            self._offset = min(found, self._offset + DRIFT * max(0.0, arrived_s - self._at))
        self._at = arrived_s
        return stamp_s + self._offset

    def restart(self) -> None:
        """Forget the offset: the other clock was set anew."""
        self._offset = None
