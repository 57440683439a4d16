"""Latency of readings, from the time stamps of their sender.

The offset of a sender's clock is unknown, so that only differences of delays can be measured. With t the sender's time of a reading and a its
arrival on our clock, the delay in excess of the smallest observed one is

    age = (a − t) − min (a − t),

where the minimum may grow by `DRIFT` to follow clocks of another rate (Paxson 1998, On calibrating measurements of packet transit
times). A time stamp in seconds since 1970 needs no minimum: its age is the current time minus t.
"""

from __future__ import annotations

import math
import time

DRIFT = 2e-4
"""Relative rate at which the minimum may grow: clocks of quartz differ by less than 100 ppm."""
DAY_S = 86_400.0
"""A time within a day of ours is a date."""
COARSE_S = 0.1
"""A clock that repeats a time and then advances by more than this has a coarse resolution, such as whole seconds: ages cannot be computed."""
SWAPPED_S = 1.0
"""A reading older than the previous one by less than this was overtaken in transit; by more, the sender's clock has restarted."""


class SenderClock:
    """Follows the times of one sender."""

    def __init__(self) -> None:
        self._newest = self._least = self._at = math.nan
        self._is_coarse = self._is_repeated = False

    def age_s(self, time_s: float, arrived: float) -> float | None:
        """Return the age of a reading at its arrival [s]; None if a newer one has arrived before.

        Arguments:
            time_s: sender's time of the reading [s]; nan without one: its age at arrival is then 0.
            arrived: on our monotonic clock [s].
        """
        if math.isnan(time_s):
            return 0.0
        step = time_s - self._newest
        if -SWAPPED_S < step < 0.0:
            return None
        if not step >= 0.0:  # the first reading, or the sender has restarted
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
