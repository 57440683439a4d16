"""How late readings arrive, by the time that their sender gives them.

A sender's clock has an unknown offset, so that only differences of delays are known. With t the sender's time of a reading and a its
arrival on our clock, the delay beyond the smallest that was seen is

    age = (a − t) − min (a − t),

where the minimum may grow by `DRIFT` to follow clocks of another rate (Paxson 1998, On calibrating measurements of packet transit
times). A time that is a date, seconds since 1970, needs no minimum: its age is today's time minus t.
"""

from __future__ import annotations

import math
import time

DRIFT = 2e-4
"""Relative rate at which the minimum may grow: clocks of quartz differ by less than 100 ppm."""
DAY_S = 86_400.0
"""A time within a day of ours is a date."""
COARSE_S = 0.1
"""A clock that repeats a time and then advances by more counts whole seconds or the like: it says nothing of ages."""
SWAPPED_S = 1.0
"""A reading older than the one before by less has overtaken it on the way; by more, the sender's clock has begun anew."""


class SenderClock:
    """Follows the times of one sender."""

    def __init__(self) -> None:
        self._newest = self._least = self._at = math.nan
        self._is_coarse = self._is_repeated = False

    def age_s(self, time_s: float, arrived: float) -> float | None:
        """Return the age of a reading at its arrival [s]; None where a newer one has arrived before.

        Arguments:
            time_s: sender's time of the reading [s]; nan where it gives none: it is then new at its arrival.
            arrived: of our monotonic clock [s].
        """
        if math.isnan(time_s):
            return 0.0
        step = time_s - self._newest
        if -SWAPPED_S < step < 0.0:
            return None
        if not step >= 0.0:  # the first reading, or the sender began anew
            self._least, self._at, self._is_coarse = arrived - time_s, arrived, False
        elif self._is_repeated and step > 0.0:
            self._is_coarse = step > COARSE_S
        self._is_repeated = step == 0.0
        delay = arrived - time_s
        self._least = min(self._least + DRIFT * max(0.0, arrived - self._at), delay)
        self._newest, self._at = time_s, arrived
        if self._is_coarse or self._is_repeated:
            return 0.0
        since = time.time() - time_s
        return max(delay - self._least, since if abs(since) < DAY_S else 0.0)
