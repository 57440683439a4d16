"""Counts of work done: a measure of progress that does not depend on the machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from threading import Lock


@dataclass(slots=True)
class Work:
    """How much was done, in states."""

    equilibria: int = 0
    """Equilibria that were solved, those on the way to a load included."""
    responses: int = 0
    """Linear responses of states, each to all its right-hand sides at once."""
    refined: int = 0
    """States that were continued on a finer mesh."""


_adding = Lock()
_counting: ContextVar[tuple[tuple[Work, Callable[[], None] | None], ...]] = ContextVar("counting", default=())


@contextmanager
def counting(tell: Callable[[], None] | None = None) -> Iterator[Work]:
    """Yield a counter of the work of this thread and of its helper threads.

    Arguments:
        tell: called after whatever was counted.
    """
    work = Work()
    token = _counting.set((*_counting.get(), (work, tell)))
    try:
        yield work
    finally:
        _counting.reset(token)


def count(*, equilibria: int = 0, responses: int = 0, refined: int = 0) -> None:
    """Add work that was done to the active counter (`counting`), if there is one."""
    for work, tell in _counting.get():
        with _adding:
            work.equilibria += equilibria
            work.responses += responses
            work.refined += refined
        if tell is not None:
            tell()
