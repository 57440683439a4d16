"""How far `improve` is and how long it still takes: states that were solved, against what its stages usually take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from femsense.core.work import Work, counting

CALIBRATION, SEARCH, ALL_STATES, VERDICT = "calibration", "search", "all states", "verdict"
PASSES = {CALIBRATION: 10.0, SEARCH: 30.0, ALL_STATES: 6.0, VERDICT: 4.0}
"""Equilibria that a stage usually takes for each fitted state (`benchmarks/distinct_states.py` prints them)."""
COSTS = {"equilibria": 1.0, "responses": 1.5, "refined": 12.0}
"""What each kind of work takes, in equilibria."""
QUADRATIC = 10.0
"""What a state on quadratic elements takes, in that of one on linear ones."""
MORE = 0.25
"""A stage that has taken as long as was planned is expected to take this share of that besides; less, the longer it has taken."""
EVERY = 5.0
"""Seconds after which it is said again how far the work is."""


class WorkPlan:
    """Tells what is going on, with the share of the work that is done and about how long the rest takes."""

    def __init__(self, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        """tell: is told in words; clock: seconds."""
        self.tell, self.clock, self.begun = tell, clock, clock()
        self.rest: list[float] = []
        """What is expected of the stage at hand and of each that follows, in equilibria on linear elements."""
        self.done, self.weight = 0.0, 1.0
        """What the stages before took, and what an equilibrium of the stage at hand costs."""
        self.work = Work()
        self.seen = 0.0
        self.text, self.furthest, self.said = "", 0.0, -EVERY

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Count the work that is done meanwhile."""
        with counting(self._go_on) as self.work:
            yield

    def plan(self, stages: Sequence[str], states: int, *, quadratic: bool) -> None:
        """Expect these stages from now on, in so many fitted states; what is at hand has ended."""
        self._end()
        self.weight = QUADRATIC if quadratic else 1.0
        self.rest = [PASSES[stage] * states * self.weight for stage in stages]

    def next_stage(self) -> None:
        """Begin the next stage."""
        self._end()
        self.rest = self.rest[1:]

    def __call__(self, text: str) -> None:
        """Tell what is going on from now on."""
        self.text = text
        self._say()

    @property
    def share(self) -> float:
        """Share of the work that is done; it never falls."""
        done, rest = self._done_and_rest()
        self.furthest = max(self.furthest, done / (done + rest) if done and self.rest else 0.0)
        return self.furthest

    @property
    def seconds_left(self) -> float:
        """Seconds that the rest takes if it goes on as it did; inf as long as nothing is planned or done."""
        done, rest = self._done_and_rest()
        return (self.clock() - self.begun) * rest / done if done and self.rest else float("inf")

    def _done_and_rest(self) -> tuple[float, float]:
        own = self._own()
        now = (
            max(self.rest[0] - own, MORE * self.rest[0] * min(1.0, (self.rest[0] / max(own, 1e-9)) ** 0.5)) if self.rest else 0.0
        )
        return self.done + own, now + sum(self.rest[1:])

    def _own(self) -> float:
        """Return what the stage at hand has taken."""
        return self.weight * (self._counted() - self.seen)

    def _counted(self) -> float:
        return sum(cost * float(getattr(self.work, kind)) for kind, cost in COSTS.items())

    def _end(self) -> None:
        self.done += self._own()
        self.seen = self._counted()

    def _go_on(self) -> None:
        if self.text and self.clock() >= self.said + EVERY:
            self._say()

    def _say(self) -> None:
        self.said = self.clock()
        left = self.seconds_left
        self.tell(f"{self.text} ({self.share:.0%}, about {in_words(left)} left)" if left < float("inf") else self.text)


def in_words(seconds: float) -> str:
    """Return a time as people say it: seconds, from two minutes on minutes."""
    return f"{max(round(seconds), 1)} s" if seconds < 120.0 else f"{round(seconds / 60.0)} min"
