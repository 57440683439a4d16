"""Progress of `improve`: the share of the work that is done and the remaining time, from the number of states solved."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from femsense.core.work import Work, counting

CALIBRATION, SEARCH, ALL_STATES, VERDICT = "calibration", "search", "all states", "verdict"
PASSES = {CALIBRATION: 10.0, SEARCH: 30.0, ALL_STATES: 6.0, VERDICT: 4.0}
"""Typical number of equilibria per fitted state in each stage (`benchmarks/distinct_states.py` prints them)."""
COSTS = {"equilibria": 1.0, "responses": 1.5, "refined": 12.0}
"""Cost of each kind of work, in equilibria."""
QUADRATIC = 10.0
"""Cost of a state on quadratic elements, relative to linear ones."""
MORE = 0.25
"""Remaining work of a stage that has reached its estimate, as a share of the estimate; it decreases as the stage continues."""
EVERY = 5.0
"""Interval at which progress is repeated [s]."""


class WorkPlan:
    """Reports the current step with the share of the work that is done and the remaining time."""

    def __init__(self, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        """Arguments: `tell` receives the text; `clock` returns seconds."""
        self.tell, self.clock, self.begun = tell, clock, clock()
        self.rest: list[float] = []
        """Estimated work of the current stage and of each later one, in equilibria on linear elements."""
        self.done, self.weight = 0.0, 1.0
        """Work of the completed stages, and the cost of an equilibrium in the current one."""
        self.work = Work()
        self.seen = 0.0
        self.text, self.furthest, self.said = "", 0.0, -EVERY

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Count the work done inside the context."""
        with counting(self._go_on) as self.work:
            yield

    def plan(self, stages: Sequence[str], states: int, *, quadratic: bool) -> None:
        """Plan these stages, each with this number of fitted states, and end the current one."""
        self._end()
        self.weight = QUADRATIC if quadratic else 1.0
        self.rest = [PASSES[stage] * states * self.weight for stage in stages]

    def next_stage(self) -> None:
        """Begin the next stage."""
        self._end()
        self.rest = self.rest[1:]

    def __call__(self, text: str) -> None:
        """Name the current step and report it."""
        self.text = text
        self._say()

    @property
    def share(self) -> float:
        """Share of the work that is done; it never decreases."""
        done, rest = self._done_and_rest()
        self.furthest = max(self.furthest, done / (done + rest) if done and self.rest else 0.0)
        return self.furthest

    @property
    def seconds_left(self) -> float:
        """Remaining time at the average rate so far [s]; inf before anything is planned or done."""
        done, rest = self._done_and_rest()
        return (self.clock() - self.begun) * rest / done if done and self.rest else float("inf")

    def _done_and_rest(self) -> tuple[float, float]:
        own = self._own()
        now = (
            max(self.rest[0] - own, MORE * self.rest[0] * min(1.0, (self.rest[0] / max(own, 1e-9)) ** 0.5)) if self.rest else 0.0
        )
        return self.done + own, now + sum(self.rest[1:])

    def _own(self) -> float:
        """Return the work of the current stage."""
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
    """Return a duration in seconds, from two minutes on in minutes."""
    return f"{max(round(seconds), 1)} s" if seconds < 120.0 else f"{round(seconds / 60.0)} min"
