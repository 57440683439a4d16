"""Engines that run jobs. Each has the shape of `concurrent.futures.Executor`: in process, processes (pebble), or dask.

`ENGINES` is their registry; `open_engine` opens one.
"""

from __future__ import annotations

import contextlib
import logging
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any, ParamSpec, Protocol, TypeVar

from femsense.core.errors import DataError, InputError
from femsense.core.packages import needed
from femsense.core.parallel import available_cores
from femsense.core.text import one_line
from femsense.many import limits

P = ParamSpec("P")
T = TypeVar("T")
LIFE = 200
"""Jobs after which a process is replaced by a fresh one: memory that libraries keep does not grow without bound."""
AHEAD = 2
"""Jobs for each worker that are given to processes at a time."""
AHEAD_DASK = 4
"""The same of a cluster, where a worker should find its next job without asking the driver …"""
FEWEST_DASK = 200
"""… and no fewer jobs than this: a cluster that starts small sees how much there is to do."""
CONNECT = "10s"
"""A scheduler that does not answer within this time is taken as absent."""
GONE = "the scheduler is gone, and its workers with it; results so far are kept, and the same command continues"
DURATIONS = ("--lifetime", "--lifetime-stagger")
TTL = "1 hour"
"""Longest silence of a dask worker: compiled code can hold Python's lock for minutes."""


@dataclass(frozen=True, slots=True)
class Death:
    """A worker that died while it had a job."""

    exit_code: int | None
    """Negative: the signal. None if unknown."""
    count: int = 1
    """How many workers died before this was reported."""

    @property
    def text(self) -> str:
        """How it died."""
        if self.exit_code is None:
            return "its worker died"
        if self.exit_code >= 0:
            return f"its worker ended with status {self.exit_code}"
        with contextlib.suppress(ValueError):
            return f"its worker was ended by {signal.Signals(-self.exit_code).name}"
        return f"its worker was ended by signal {-self.exit_code}"


class Engine(Protocol):
    """Runs functions somewhere."""

    @property
    def ahead(self) -> int:
        """Number of jobs to submit at a time."""

    @property
    def workers(self) -> int:
        """Number of workers at the moment."""

    def submit(self, function: Callable[P, T], /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Begin function(*arguments, **named); as of `concurrent.futures.Executor`."""

    def death_in(self, error: BaseException) -> Death | None:
        """Return which death of a worker an error of a future reports; None where it reports none."""


def spread(engine: Engine, function: Callable[..., T], tasks: Iterable[tuple[Any, ...]]) -> Iterator[T]:
    """Yield function(*task) of each task, in order; an engine gets a few tasks ahead.

    A task that loses its worker is run once more. Raises DataError if it loses that one too, or if the scheduler is gone, and the
    exceptions of the function.
    """
    waiting, left = deque[tuple[tuple[Any, ...], Future[T]]](), iter(tasks)

    def submitted() -> Iterator[tuple[tuple[Any, ...], Future[T]]]:
        return ((task, engine.submit(function, *task)) for task in left)

    waiting.extend(islice(submitted(), engine.ahead))
    try:
        while waiting:
            task, future = waiting.popleft()
            wait([future])
            if future.cancelled():
                raise DataError(GONE)
            error = future.exception()
            if error is not None and engine.death_in(error) is not None:
                future = engine.submit(function, *task)
                error = future.exception()
                death = None if error is None else engine.death_in(error)
                if death is not None:
                    raise DataError(f"{task[-1]}: this has ended two workers: {death.text}") from error
            yield future.result()
            waiting.extend(islice(submitted(), 1))
    finally:
        for _, future in waiting:
            future.cancel()


# In process


class InProcess(Executor):
    """Runs each function at once, in this process."""

    workers = ahead = 1

    def submit(self, function: Callable[P, T], /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Run a function; its future is done."""
        future: Future[T] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future

    def death_in(self, error: BaseException) -> Death | None:
        """Nothing dies here but the process itself."""
        return None


# Processes


class Processes:
    """A pool of processes with one thread each; if one dies, its job alone fails, and another takes its place."""

    def __init__(self, pool: Any, workers: int) -> None:
        self.pool, self.workers, self.ahead = pool, workers, AHEAD * workers

    def submit(self, function: Callable[P, T], /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Have a process run a function."""
        future: Future[T] = self.pool.schedule(function, args=arguments, kwargs=named)
        return future

    def death_in(self, error: BaseException) -> Death | None:
        """Return the exit code of a process that died."""
        from pebble import ProcessExpired

        return Death(error.exitcode) if isinstance(error, ProcessExpired) else None


@contextmanager
def processes(workers: int, memory: int | None = None) -> Iterator[Processes]:
    """Open a pool; each process may take `memory` [bytes].

    Processes are spawned, because a fork would copy the threads and locks of libraries in an arbitrary state. If the block ends by an
    error, such as Ctrl-C, running processes are terminated.
    """
    from pebble import ProcessPool

    with limits.environment(limits.ONE_THREAD):
        pool: Any = ProcessPool(
            max_workers=workers,
            max_tasks=LIFE,
            context=get_context("spawn"),
            initializer=limits.limit_memory,
            initargs=(memory,),
        )
        try:
            yield Processes(pool, workers)
            pool.close()
        except BaseException:
            pool.stop()
            raise
        finally:
            pool.join()


# Dask


class Dask:
    """A cluster of dask.distributed with one thread a worker."""

    def __init__(self, client: Any) -> None:
        self.client, self.known = client, 1
        self.executor = client.get_executor(pure=False, retries=1)

    @property
    def workers(self) -> int:
        """Threads of all workers that are there now; as last known, where the scheduler does not answer."""
        with contextlib.suppress(Exception):
            self.known = sum(self.client.nthreads().values())
        return self.known

    @property
    def ahead(self) -> int:
        """Enough that no worker waits for the driver."""
        return max(FEWEST_DASK, AHEAD_DASK * self.workers)

    def submit(self, function: Callable[P, T], /, *arguments: P.args, **named: P.kwargs) -> Future[T]:
        """Have a worker run a function."""
        future: Future[T] = self.executor.submit(function, *arguments, **named)
        return future

    def death_in(self, error: BaseException) -> Death | None:
        """Return how many workers died; dask does not say how."""
        from distributed.scheduler import KilledWorker

        return Death(None, error.allowed_failures + 1) if isinstance(error, KilledWorker) else None


@contextmanager
def dask(where: str, workers: int | None, memory: int | None) -> Iterator[Dask]:
    """Open a cluster.

    Arguments:
        where: "local"; the address of a scheduler; its scheduler file (.json); or a configuration of dask-jobqueue (.yaml).
        workers: how many to start; None: one a core of this machine. A scheduler that runs already has its own.
        memory: of a worker that is started here [bytes].

    Raises:
        InputError: no scheduler answers, or the file cannot be used. MissingDependency: dask is not installed.
    """
    dask_, distributed = needed("dask", "dask", "--dask"), needed("distributed", "dask", "--dask")
    known = [name for name in logging.root.manager.loggerDict if name.startswith(("distributed.", "tornado."))]
    for name in ["distributed", "tornado", *known]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)  # the driver reports an error in one line
    settings = {
        "distributed.scheduler.worker-ttl": TTL,
        "distributed.scheduler.allowed-failures": 0,  # the driver counts, and knows which job was running
        "distributed.nanny.pre-spawn-environ": limits.ONE_THREAD,
        "distributed.comm.timeouts.connect": CONNECT,
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask_.config.set(settings))
        file = Path(where).expanduser()
        try:
            if where == "local":
                cluster = distributed.LocalCluster(
                    n_workers=workers or available_cores(),
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=memory or "auto",
                    dashboard_address=None,
                    silence_logs=logging.CRITICAL,
                )
                client = distributed.Client(stack.enter_context(cluster))
            elif file.suffix in (".yaml", ".yml"):
                client = distributed.Client(stack.enter_context(_jobqueue(file, workers)))
            elif file.suffix == ".json":
                file.stat()  # dask waits for a file that is missing
                client = distributed.Client(scheduler_file=str(file))
            else:
                client = distributed.Client(where)
        except (OSError, ValueError) as error:
            raise InputError(
                "no dask scheduler answers",
                where=f"--dask {where}",
                found=one_line(error, 200) or type(error).__name__,
                expected="tcp://HOST:8786, local, a scheduler file (.json), or a configuration of dask-jobqueue (.yaml)",
            ) from None
        with client:
            yield Dask(client)


def _jobqueue(file: Path, workers: int | None) -> Any:
    """Return the cluster that a YAML file of dask-jobqueue declares. Raises InputError."""
    needed("dask_jobqueue", "dask", "--dask FILE")
    import dask as dask_
    import yaml
    from dask_jobqueue import JobQueueCluster
    from dask_jobqueue.local import LocalCluster  # a queue on this machine, to try a file

    kinds = {kind.job_cls.default_config_name(): kind for kind in {*JobQueueCluster.__subclasses__(), LocalCluster}}
    try:
        document = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise InputError("cannot be read", where=file, found=one_line(error, 200), expected="YAML") from None
    tables = document.get("jobqueue") if isinstance(document, dict) else None
    names = [name for name in tables if name in kinds] if isinstance(tables, dict) else []
    if len(names) != 1:
        raise InputError(
            "not one cluster",
            where=f"{file}: jobqueue",
            found=", ".join(names) or "none",
            expected=f"one of {', '.join(sorted(map(str, kinds)))}",
            hint="femsense docs many shows a file",
        )
    _check_durations(file, document["jobqueue"][names[0]])
    dask_.config.update(dask_.config.config, document)
    cluster = kinds[names[0]]()
    cluster.scale(jobs=workers or 1)
    return cluster


def _check_durations(file: Path, table: Any) -> None:
    """Raise InputError for a lifetime that dask's workers cannot read: each would end at once, and the driver wait forever."""
    from dask.utils import parse_timedelta

    table = table if isinstance(table, dict) else {}
    words = table.get("worker-extra-args") or table.get("worker_extra_args") or ()
    for flag, value in pairwise(map(str, words)):
        try:
            if flag in DURATIONS:
                parse_timedelta(value)
        except (ValueError, KeyError):
            raise InputError("not a duration", where=f"{file}: {flag}", found=value, expected="one unit: 230m, or 3.8h") from None


# The registry


ENGINES: dict[str, Callable[..., Any]] = {"in process": InProcess, "processes": processes, "dask": dask}


def open_engine(workers: int | None, where: str | None, memory: int | None) -> contextlib.AbstractContextManager[Engine]:
    """Return an engine: dask if `where` is given, in process for 0 workers, else processes, one a core."""
    if where is not None:
        chosen: contextlib.AbstractContextManager[Engine] = ENGINES["dask"](where, workers, memory)
        return chosen
    if workers == 0:
        chosen = ENGINES["in process"]()
        return chosen
    chosen = ENGINES["processes"](workers or available_cores(), memory)
    return chosen
