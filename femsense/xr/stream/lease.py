"""Who steers: one client at a time holds a lease with a number and a time, whatever way its messages come.

A client asks by a message without a number. The lease that is granted has a new number, larger than any before, and ends after `hold_s`
without a message that quotes it. Messages of one client carry a number that grows. So a message that was recorded, that a broker
delivers again, or that was held up longer than a lease lasts moves nothing.

A stop ends the lease. After it, nobody is granted one for armed messages before having sent one that is not armed: hands that hold on
through a stop have to let go.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum

KNOWN = 1000
"""Clients whose numbers are remembered."""
GRACE = 4.0
"""A client whose lease ran out is preferred to others for this many times its duration: a page that was busy comes back."""


class Ruling(Enum):
    """What becomes of a message."""

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


@dataclass(frozen=True, slots=True)
class Claim:
    """What a message says of its sender."""

    way: str
    """How it came: the connection of a WebSocket, the name of a broker's client, or the broker."""
    client: str
    seq: int
    number: int
    """Of the lease; 0: it asks for one."""
    held: bool
    armed: bool


class Lease:
    """The lease of one robot."""

    def __init__(self, hold_s: float) -> None:
        """hold_s: how long it lasts without a message [s]."""
        self.hold_s = hold_s
        self.number = int(1000.0 * time.time())  # beyond those of any earlier server
        self.client = ""
        """Who holds it; empty: nobody."""
        self.stopped = False
        """Whether it was ended by a stop and nobody has held it since."""
        self._holder: tuple[str, str] | None = None
        self._renewed_at = float("-inf")
        self._known: dict[tuple[str, str], _Known] = {}
        self._stops = 0

    def rule(self, claim: Claim, now: float) -> Ruling:
        """Decide about a message that arrives at a time [s]."""
        who = (claim.way, claim.client)
        known = self._known.pop(who, _Known(-1))
        self._known[who] = known
        if len(self._known) > KNOWN:
            del self._known[next(iter(self._known))]
        if claim.seq <= known.seq:
            return Ruling.OLD
        known.seq = claim.seq
        if not claim.armed:
            known.disarmed = self._stops
        if not claim.held:
            return self._release(who)
        if claim.number:
            renewed = claim.number == self.number and who == self._holder and self.is_held(now)
            self._renewed_at = now if renewed else self._renewed_at
            return Ruling.RENEWED if renewed else Ruling.OLD
        if self._holder not in (None, who) and now - self._renewed_at <= GRACE * self.hold_s:
            return Ruling.REFUSED
        if claim.armed and known.disarmed < self._stops:
            return Ruling.REFUSED
        self.number += 1
        self.client, self._holder, self._renewed_at, self.stopped = claim.client, who, now, False
        return Ruling.GRANTED

    def is_held(self, now: float) -> bool:
        """Return whether somebody holds it at a time [s]."""
        return bool(self.client) and now - self._renewed_at <= self.hold_s

    def expire(self, now: float) -> bool:
        """End it where it has run out at a time [s]; return whether it has just now."""
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
