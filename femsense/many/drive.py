"""Running many jobs: those without a result are given to an engine, deaths of workers are counted, and outcomes are collected."""

from __future__ import annotations

import contextlib
import json
import queue
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

from femsense.core.errors import DataError, InputError
from femsense.core.text import with_type
from femsense.many import limits
from femsense.many.engines import GONE, Death, Engine
from femsense.many.jobs import Job
from femsense.many.outcome import JobStatus, Outcome
from femsense.many.records import Record, Stats, is_valid, log_of, read_record, running_mark, shortened, stamp_of, write_record

MOST_DEATHS = 2
"""A job that has killed this number of workers is not run again."""
LOOK_S = 1.0
"""Progress is reported at least as often."""
MOST_IDLE_DEATHS = 3
"""Number of deaths in a row, for each job at hand, of workers that had not begun: beyond it, workers cannot start at all."""
LOG_LINES = 3
"""Number of last lines of a job's log in the reason of a crash."""
OOM_SIGNAL = -9
Work = Callable[[Job], Outcome]


@dataclass(frozen=True, slots=True)
class Progress:
    """How far many jobs have come."""

    total: int
    finished: int
    """Jobs with an outcome, results that were there included."""
    kept: int
    failed: int
    running: int
    seconds: float
    """Since the beginning [s]."""
    seconds_left: float | None
    """At the rate so far [s]; None before the first job has ended."""
    slowest: Outcome | None


class _Gathered:
    """Outcomes so far."""

    def __init__(self, jobs: Sequence[Job]) -> None:
        self.jobs, self.found, self.began = jobs, dict[str, Outcome](), time.monotonic()
        self.ran = 0
        self.slowest: Outcome | None = None

    def add(self, outcome: Outcome, *, ran: bool) -> None:
        self.found[outcome.name] = outcome
        self.ran += ran
        if ran and outcome.status is not JobStatus.KEPT and (self.slowest is None or outcome.seconds > self.slowest.seconds):
            self.slowest = outcome

    def progress(self, running: int) -> Progress:
        seconds, missing = time.monotonic() - self.began, len(self.jobs) - len(self.found)
        return Progress(
            total=len(self.jobs),
            finished=len(self.found),
            kept=sum(o.status is JobStatus.KEPT for o in self.found.values()),
            failed=sum(not o.is_good for o in self.found.values()),
            running=running,
            seconds=seconds,
            seconds_left=seconds / self.ran * missing if self.ran else None,
            slowest=self.slowest,
        )


def recorded(jobs: Iterable[Job]) -> dict[str, Outcome]:
    """Return the outcomes that need no new run, by name: valid results of the same input, and jobs that killed their workers."""
    known: dict[Path, Stats] = {}
    found = dict[str, Outcome]()
    for job in jobs:
        record = read_record(job.record)
        if record is None or record.stamp != stamp_of(job, known):
            continue
        if is_valid(job, record):
            found[job.name] = replace(record.outcome, status=JobStatus.KEPT)
        elif record.outcome.deaths >= MOST_DEATHS:
            found[job.name] = record.outcome
    return found


def run_jobs(
    jobs: Sequence[Job],
    work: Work,
    engine: Engine,
    *,
    again: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> list[Outcome]:
    """Run jobs on an engine; return their outcomes in the same order.

    Arguments:
        jobs: with names that differ.
        work: runs one, in a worker; it is sent there, so that it has to be importable.
        engine: open.
        again: also run jobs that have a recorded result.
        progress: called after each outcome and about once a second.

    Raises:
        DataError: the disk is full, or the workers are gone; outcomes so far are recorded, and the same call continues.
    """
    gathered = _Gathered(jobs)
    for job in jobs if again else ():
        job.record.unlink(missing_ok=True)
    for known in recorded(jobs).values():
        gathered.add(known, ran=False)
    idle_deaths = 0
    waiting = deque(job for job in jobs if job.name not in gathered.found)
    running = dict[Future[Outcome], Job]()
    finished: queue.SimpleQueue[Future[Outcome]] = queue.SimpleQueue()
    try:
        while waiting or running:
            ahead = engine.ahead
            while waiting and len(running) < ahead:
                job = waiting.popleft()
                future = engine.submit(work, job)
                running[future] = job
                future.add_done_callback(finished.put)
            with contextlib.suppress(queue.Empty):
                future = finished.get(timeout=LOOK_S)
                job = running.pop(future)
                outcome = _outcome(job, future, engine)
                if outcome is not None:
                    gathered.add(outcome, ran=True)
                    _check_disk(outcome, gathered)
                else:
                    waiting.appendleft(job)
                idle_deaths = 0 if outcome is not None or job.record.is_file() else idle_deaths + 1
                if idle_deaths > MOST_IDLE_DEATHS * ahead:
                    raise DataError("workers die before they begin a job: femsense doctor checks the installation")
            if progress is not None:
                progress(gathered.progress(min(len(running), engine.workers)))
    finally:
        for future, job in running.items():
            future.cancel()
            running_mark(job).unlink(missing_ok=True)  # stopped, and no fault of these jobs
    return [gathered.found[job.name] for job in jobs]


def _check_disk(outcome: Outcome, gathered: _Gathered) -> None:
    if outcome.status is JobStatus.DISK_FULL:
        raise DataError(
            f"the disk is full: {outcome.reason}\n{len(gathered.found) - 1} of {len(gathered.jobs)} jobs are done; "
            f"make room, and the same command continues"
        )


def _outcome(job: Job, future: Future[Outcome], engine: Engine) -> Outcome | None:
    """Return the outcome of a job that has ended; None where it is run once more. Raises DataError without workers."""
    if future.cancelled():
        raise DataError(GONE)
    error = future.exception()
    if error is None:
        return future.result()
    death = engine.death_in(error)
    if death is None:
        raise DataError(
            f"the workers cannot run jobs: {with_type(error, 300)}\nresults so far are kept, and the same command continues"
        ) from error
    mark = _running(job)
    return None if mark is None else _after_death(job, death, mark)


def _running(job: Job) -> Mapping[str, object] | None:
    """Return the mark of a job that was running; None where its worker died before it began. The mark is removed."""
    mark = running_mark(job)
    try:
        found = json.loads(mark.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    mark.unlink(missing_ok=True)
    return found if isinstance(found, dict) else {}


def _after_death(job: Job, death: Death, mark: Mapping[str, object]) -> Outcome | None:
    """Record that a job has killed a worker. Return its outcome from MOST_DEATHS on, else None."""
    before, stamp = read_record(job.record), stamp_of(job)
    deaths = death.count + (before.outcome.deaths if before is not None and before.stamp == stamp else 0)
    host = str(mark.get("host", ""))
    counted = mark.get("oom_kills")
    local = host == socket.gethostname() and isinstance(counted, int)
    by_kernel = death.exit_code in (None, OOM_SIGNAL) and local and isinstance(counted, int) and limits.oom_kills() > counted
    if by_kernel:
        status, why = JobStatus.OUT_OF_MEMORY, "the kernel ended its worker because the memory was used up"
    else:
        status, why = JobStatus.CRASHED, death.text + (f" on {host}" if host and not local else "")
    said = _last_lines(log_of(job))
    outcome = Outcome(job.name, status, shortened(why + (f"; its log ends: {said}" if said else "")), host=host, deaths=deaths)
    with contextlib.suppress(OSError, InputError):
        write_record(job, Record(outcome, stamp, "", {}))
    return outcome if deaths >= MOST_DEATHS else None


def _last_lines(log: Path) -> str:
    try:
        lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    fatal = next((line for line in lines if line.startswith("Fatal Python error")), None)
    return fatal or " / ".join(lines[-LOG_LINES:])
