"""Mapping from device time stamps to the clock of this machine."""

from __future__ import annotations

DRIFT = 1e-4
"""Largest relative drift between two quartz clocks."""


class ClockMap:
    """Maps stamps of another clock to the monotonic clock of this machine.

    offset = min over messages of (arrival − stamp): transport can delay a message but not advance it, so the minimum contains the
    smallest delay. It rises by DRIFT per second to follow a slower clock. The smallest transport delay is not observable and
    remains in the offset.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._at = 0.0

    def host_time(self, stamp_s: float, arrived_s: float) -> float:
        """Return the time of a stamp on the monotonic clock [s], given the arrival time of its message [s]."""
        found = arrived_s - stamp_s
        if self._offset is None:
            self._offset = found
        else:
            self._offset = min(found, self._offset + DRIFT * max(0.0, arrived_s - self._at))
        self._at = arrived_s
        return stamp_s + self._offset

    def restart(self) -> None:
        """Discard the offset, after the other clock was reset."""
        self._offset = None
