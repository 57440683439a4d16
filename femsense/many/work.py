"""One job in a worker: under a lock, within its limits, with its output in a log, and with a record at the end."""

from __future__ import annotations

import contextlib
import errno
import faulthandler
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, TextIO

from threadpoolctl import threadpool_limits

from femsense.core.errors import FemsenseError, InputError
from femsense.core.text import with_type
from femsense.io.files import json_text, write_text
from femsense.io.folder_lock import only_writer
from femsense.many import limits
from femsense.many.jobs import Job
from femsense.many.outcome import JobStatus, Outcome, Scalar
from femsense.many.records import (
    Record,
    clear_parts,
    is_valid,
    key_of,
    log_of,
    outputs_of,
    read_record,
    running_mark,
    shortened,
    stamp_of,
    write_record,
)

WAIT_S = 0.5
"""Between two looks whether another process has finished the same job."""
SPARE = 0.9
"""Share of a dask worker's own memory limit beyond which an allocation fails, before its nanny kills the worker."""


@dataclass(frozen=True, slots=True)
class Result:
    """The result of a command."""

    row: Mapping[str, Scalar]
    """Column of the summary → value."""
    reason: str = ""
    """Why the data allow no result; empty where there is one."""


Call = Callable[[Sequence[str]], Result]
"""Runs the words of a job. Raises FemsenseError and whatever goes wrong."""


def work_on(job: Job, call: Call, *, memory_bytes: int | None = None, in_process: bool = False) -> Outcome:
    """Run a job, unless its result is there, and record its outcome. Raises nothing but what stops the worker.

    Arguments:
        job: what to do.
        call: runs its words.
        memory_bytes: limit of this process [bytes]; None: the limit that the worker has.
        in_process: the job runs in the process of the user, whose threads, memory and output are left as they are.
    """
    with _only_worker(job):
        known = read_record(job.record)
        try:
            stamp, key = stamp_of(job), key_of(job)
            if known is not None and known.key == key and is_valid(job, known):
                write_record(job, replace(known, stamp=stamp))
                return replace(known.outcome, status=JobStatus.KEPT)
        except (OSError, FemsenseError):
            stamp = key = ""  # the command reports what is wrong with the input
        deaths = 0 if known is None else known.outcome.deaths
        with _surroundings(job, memory_bytes, in_process):
            outcome = replace(_called(job, call), deaths=deaths)
        with contextlib.suppress(OSError, InputError):  # such as a full disk: then the job is missing, and a rerun does it
            write_record(job, Record(outcome, stamp, key, outputs_of(job) if outcome.is_good else {}))
        return outcome


def _called(job: Job, call: Call) -> Outcome:
    """Run the words of a job and return its outcome."""
    limits.reset_peak()
    began = time.perf_counter()
    row: Mapping[str, Scalar] = {}
    try:
        result = call(job.words)
        status, reason, row = JobStatus.NO_RESULT if result.reason else JobStatus.DONE, result.reason, result.row
    except Exception as error:
        status, cause = _kind_of(error)
        reason = str(cause) if isinstance(cause, FemsenseError) else with_type(cause, 1000)
    if status is JobStatus.OUT_OF_MEMORY:
        reason += "; a worker may not take more memory: --memory, or fewer --workers"
    return Outcome(
        name=job.name,
        status=status,
        reason=shortened(reason),
        row=row,
        seconds=time.perf_counter() - began,
        peak_bytes=limits.peak_memory(),
        host=socket.gethostname(),
    )


def _kind_of(error: BaseException) -> tuple[JobStatus, BaseException]:
    """Return the status of a job that raised an error, and the error to report: a full disk or memory is often its cause."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return JobStatus.OUT_OF_MEMORY, error
        if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
            return JobStatus.DISK_FULL, cause
        cause = cause.__cause__ or cause.__context__
    no_result = isinstance(error, FemsenseError) and error.exit_status == 1
    return JobStatus.NO_RESULT if no_result else JobStatus.FAILED, error


# Around a job


@contextlib.contextmanager
def _only_worker(job: Job) -> Iterator[None]:
    """Hold the lock of a job. Another process that has it, such as one left by a driver that was killed, is waited for."""
    with contextlib.ExitStack() as stack:
        while True:
            try:
                stack.enter_context(only_writer(job.record.with_suffix("")))
                break
            except InputError:
                time.sleep(WAIT_S)
        yield


@contextlib.contextmanager
def _surroundings(job: Job, memory_bytes: int | None, in_process: bool) -> Iterator[None]:
    """Mark a job as running; in a worker, set its limits and send its output, and the place of a crash, to its log."""
    mark = running_mark(job)
    with contextlib.suppress(OSError, InputError):
        clear_parts(job)
        state = {"host": socket.gethostname(), "pid": os.getpid(), "oom_kills": limits.oom_kills()}
        write_text(mark, json_text(state, indent=None))
    try:
        if in_process:
            yield
        else:
            _limit_worker(memory_bytes)
            with contextlib.ExitStack() as stack:
                with contextlib.suppress(OSError):
                    stack.enter_context(_logged(job))
                yield
    finally:
        mark.unlink(missing_ok=True)


@cache
def _limit_worker(memory_bytes: int | None) -> None:
    """Set the limits of this worker, once."""
    os.environ.update(limits.ONE_THREAD)
    threadpool_limits(1)
    own = _dask_limit()
    found = [limit for limit in (memory_bytes, None if own is None else int(SPARE * own)) if limit is not None]
    limits.limit_memory(min(found, default=None))


def _dask_limit() -> int | None:
    """Return the memory limit of the dask worker that this process is [bytes]; None where it is none."""
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        limit: Any = get_worker().memory_manager.memory_limit
    except (ValueError, AttributeError):
        return None
    return None if limit is None else int(limit)


@contextlib.contextmanager
def _logged(job: Job) -> Iterator[None]:
    """Send standard output and error of this process, of its C libraries too, to the log of a job."""
    with log_of(job).open("w", encoding="utf-8") as log:
        streams: list[TextIO] = [sys.stdout, sys.stderr]
        kept = [os.dup(1), os.dup(2)]
        faulthandler.enable(log)
        try:
            for stream, number in zip(streams, (1, 2)):
                stream.flush()
                os.dup2(log.fileno(), number)
            yield
        finally:
            faulthandler.disable()
            for stream, number, old in zip(streams, (1, 2), kept):
                stream.flush()
                os.dup2(old, number)
                os.close(old)
