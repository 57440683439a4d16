"""Jobs of tests: what a worker does with the words of one. Workers import this module by its name."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from femsense.core.errors import DataError, InputError
from femsense.io.files import write_text
from femsense.many.jobs import RECORDS, Job
from femsense.many.outcome import Outcome
from femsense.many.work import Result, work_on

EATEN = 4_000_000_000
"""So many bytes does `eat` want."""


def job(folder: Path, name: str, *words: str) -> Job:
    """Return a job that reads `folder/input/NAME` and writes `folder/out/NAME/result.txt`."""
    source = folder / "input" / name
    if not source.exists():
        write_text(source, name)
    out = folder / "out"
    return Job(name, (*words, str(source), str(out / name)), (source,), out / name, out / RECORDS / "test" / f"{name}.json")


def act(words: Sequence[str]) -> Result:
    """Do what the first word says, with a source and a folder of the result."""
    what, source, target = words[0], Path(words[-2]), Path(words[-1])
    sys.stdout.write(f"{what} {source.name}\n")
    match what:
        case "write":
            write_text(target / "result.txt", source.read_text(encoding="utf-8").upper())
        case "refuse":
            raise DataError("too few markers")
        case "misread":
            raise InputError("no such file", where=source)
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "abort":
            os.abort()
        case "die once":
            if not target.with_suffix(".died").exists():
                write_text(target.with_suffix(".died"), "")
                os.kill(os.getpid(), signal.SIGKILL)
            write_text(target / "result.txt", "late")
        case "eat":
            np.ones(EATEN // 8)
        case "fill":
            full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
            raise InputError("internal error") from full  # as a command says it
        case "wait":
            time.sleep(float(words[1]))
            write_text(target / "result.txt", "slow")
        case "environment":
            started = dict(item.partition("=")[::2] for item in Path("/proc/self/environ").read_text().split("\0"))
            write_text(target / "result.txt", "\n".join(started.get(name, "") for name in words[1:-2]))
    return Result({"size": len(source.name), "pid": os.getpid()})


def work(job: Job) -> Outcome:
    """Run a job of a test in a worker that may take 2 GB."""
    return work_on(job, act, memory_bytes=2_000_000_000)


def work_here(job: Job) -> Outcome:
    """Run a job of a test in this process."""
    return work_on(job, act, in_process=True)


def said(words: Sequence[str]) -> str:
    """Do what the first word says for a file, whose name is the answer."""
    what, file = words[0], Path(words[1])
    if what == "die" or (what == "die once" and not file.exists()):
        write_text(file, "")
        os.kill(os.getpid(), signal.SIGKILL)
    return file.name
