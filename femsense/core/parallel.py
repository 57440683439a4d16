"""Threads over pieces of work that do not wait for each other, such as frames without a past.

Compiled kernels and BLAS let go of Python's lock while they work,
so that two threads take about half the time where the factors are large. Results do not depend on how many there are.
"""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from functools import cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

from femsense.core.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

MOST = 4
"""More threads than this wait for memory and for Python's lock."""
_chosen: list[int] = []


def set_workers(count: int | None) -> None:
    """Set the number of threads; None: by FEMSENSE_WORKERS, or by the machine. Raises InputError."""
    if count is not None and count < 1:
        raise InputError("not a number of threads", where="workers", found=count, expected="1 or more")
    _chosen[:] = [] if count is None else [count]


def workers() -> int:
    """Return the number of threads: as set, by FEMSENSE_WORKERS, or one per core; one in a worker process."""
    if _chosen:
        return _chosen[0]
    said = os.environ.get("FEMSENSE_WORKERS", "")
    if said:
        if not said.isdigit() or int(said) < 1:
            raise InputError("not a number of threads", where="FEMSENSE_WORKERS", found=said, expected="1 or more")
        return int(said)
    if multiprocessing.parent_process() is not None or "PYTEST_XDIST_WORKER" in os.environ:
        return 1
    return min(available_cores(), MOST)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield function(item) of each item in order; no more than two a thread are worked on ahead.

    Meanwhile BLAS takes one thread a call.
    """
    count = workers()
    if count < 2:
        with one_blas_thread():
            yield from map(function, items)
        return
    waiting: deque[Future[Result]] = deque()
    with one_blas_thread(), ThreadPoolExecutor(count) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(copy_context().run, function, item))  # work is counted there, too
                if len(waiting) >= 2 * count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS take one thread a call meanwhile; a decorator, too.

    The threads of a call wait for each other. On matrices as large as ours two of them gain a fifth on an idle machine;
    where other threads are busy, ours or another program's,
    they take twice as long and more (docs/appendix/mechanics-trials.md).
    """
    with _blas().limit(limits=1, user_api="blas"):
        yield


@cache
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def beside(function: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Start a computation in a thread, and return a function that waits for its result and raises its exception.

    With one worker it is computed at the first call instead. Leaving the context waits for the thread.
    """
    if workers() < 2:
        yield lambda: None
        return
    with ThreadPoolExecutor(1) as pool:
        yield pool.submit(function).result
