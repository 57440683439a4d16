"""Control of the robot: one client at a time holds a numbered lease with a time limit, independent of the channel of its messages.

A client requests a lease by a message without a number. A granted lease has a number larger than any before, and ends after `hold_s`
without a message that quotes it. Messages of one client carry an increasing number. A message that was recorded, delivered twice by a
broker, or delayed beyond the end of a lease therefore moves nothing.

A stop ends the lease. After it, a client is granted a lease for armed messages only after it has sent one that is not armed: whoever holds on
through a stop must release first.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum

from femsense.xr.stream.drag_messages import Wish

KNOWN = 1000
"""Clients whose numbers are remembered."""
GRACE = 4.0
"""A client whose lease ran out is preferred to others for this many times its duration: a page that was busy comes back."""


class Ruling(Enum):
    """Result of a message."""

    RENEWED = "renewed"
    GRANTED = "granted"
    RELEASED = "released"
    REFUSED = "refused"
    """Somebody else holds the lease, or armed hands have to let go first."""
    OLD = "old"
    """Its number, or that of the lease, is not the newest."""


@dataclass(slots=True)
class _Known:
    seq: int
    disarmed: int = 0
    """Number of stops when it sent its last message that was not armed."""


class Lease:
    """The lease of one robot."""

    def __init__(self, hold_s: float) -> None:
        """hold_s: how long it lasts without a message [s]."""
        self.hold_s = hold_s
        self.number = int(1000.0 * time.time())  # beyond those of any earlier server
        self.client = ""
        """The holder; empty: none."""
        self.stopped = False
        """Whether a stop ended it and no client has held it since."""
        self._holder: tuple[str, str] | None = None
        self._renewed_at = float("-inf")
        self._known: dict[tuple[str, str], _Known] = {}
        self._stops = 0

    def rule(self, wish: Wish, now: float) -> Ruling:
        """Return whether a message that arrives at a time [s] is accepted."""
        who = (wish.way, wish.client)
        known = self._known.pop(who, _Known(-1))
        self._known[who] = known
        if len(self._known) > KNOWN:
            del self._known[next(iter(self._known))]
        if wish.seq <= known.seq:
            return Ruling.OLD
        known.seq = wish.seq
        if not wish.armed:
            known.disarmed = self._stops
        if not wish.held:
            return self._release(who)
        if wish.number:
            renewed = wish.number == self.number and who == self._holder and self.is_held(now)
            self._renewed_at = now if renewed else self._renewed_at
            return Ruling.RENEWED if renewed else Ruling.OLD
        if self._holder not in (None, who) and now - self._renewed_at <= GRACE * self.hold_s:
            return Ruling.REFUSED
        if wish.armed and known.disarmed < self._stops:
            return Ruling.REFUSED
        self.number += 1
        self.client, self._holder, self._renewed_at, self.stopped = wish.client, who, now, False
        return Ruling.GRANTED

    def is_held(self, now: float) -> bool:
        """Return whether a client holds the lease at a time [s]."""
        return bool(self.client) and now - self._renewed_at <= self.hold_s

    def expire(self, now: float) -> bool:
        """End the lease if it has expired at a time [s]; return whether it has expired now."""
        ran_out = bool(self.client) and not self.is_held(now)
        self.client = "" if ran_out else self.client
        return ran_out

    def stop(self) -> None:
        """End it for everybody."""
        self._stops += 1
        self.number += 1
        self.client, self._holder, self.stopped = "", None, True

    def _release(self, who: tuple[str, str]) -> Ruling:
        if who != self._holder:
            return Ruling.REFUSED
        self.client, self._holder = "", None
        return Ruling.RELEASED
