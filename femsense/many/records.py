"""Records of jobs: the input of each, whether its result is still there, and its outcome.

A record holds two hashes of the input. The *stamp* covers names, sizes and times of files: it is cheap, and where it is the
same nothing is read. The *key* covers their content: where only the stamp differs, such as after a copy, the worker compares
the keys and keeps the result.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import femsense
from femsense.io.files import PART_PREFIX, file_hash, folder_hash, json_text, write_json
from femsense.many.jobs import Job
from femsense.many.outcome import LONGEST_REASON, JobStatus, Outcome

RECORD_FORMAT = "femsense-job-1"
AGAIN = "--again"
"""A word of the command line that changes no result."""
Stats = tuple[tuple[str, int, int], ...]
"""Path from the root, size [bytes] and time [ns] of each file below it."""


@dataclass(frozen=True, slots=True)
class Record:
    """The content of the record of a job."""

    outcome: Outcome
    stamp: str
    key: str
    outputs: dict[str, int]
    """Entry of the result → size of a file [bytes], number of files of a folder."""


def read_record(file: Path) -> Record | None:
    """Return the record of a job; None where there is none that can be read."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        outcome = Outcome(**{**document["outcome"], "status": JobStatus(document["outcome"]["status"])})
        if document["format"] != RECORD_FORMAT:
            return None
        return Record(outcome, str(document["stamp"]), str(document["key"]), dict(document["outputs"]))
    except (OSError, ValueError, LookupError, TypeError):
        return None


def write_record(job: Job, record: Record) -> None:
    """Write the record of a job. Raises OSError and InputError where it cannot be written."""
    write_json(job.record, {"format": RECORD_FORMAT, **asdict(record)})


def is_valid(job: Job, record: Record | None) -> bool:
    """Return whether a result is recorded and complete on disk; other files may lie next to it, such as a report."""
    return (
        record is not None
        and record.outcome.is_good
        and len(record.outputs) > 0
        and record.outputs.items() <= outputs_of(job).items()
    )


def outputs_of(job: Job) -> dict[str, int]:
    """Return the output of a job: size of each file [bytes], number of files of each folder. Hidden files do not count."""
    if job.writes.is_file():
        return {job.writes.name: job.writes.stat().st_size}
    entries = [item for item in job.writes.iterdir() if not item.name.startswith(".")] if job.writes.is_dir() else []
    return {
        item.name: sum(1 for file in item.rglob("*") if file.is_file()) if item.is_dir() else item.stat().st_size
        for item in sorted(entries)
    }


# What a job is made from


def stamp_of(job: Job, known: dict[Path, Stats] | None = None) -> str:
    """Return the hash of a job's words and of names, sizes and times of what it reads.

    `known` keeps what was looked up, for the jobs of one robot.
    """
    known = {} if known is None else known
    for path in job.reads:
        if path not in known:
            known[path] = stats_of(path)
    return _hash([*_identity(job), *(known[path] for path in job.reads)])


def key_of(job: Job) -> str:
    """Return the hash of a job's words and of the content of what it reads. Raises OSError and InputError."""
    return _hash([*_identity(job), *(_content(path, stats_of(path)) for path in job.reads)])


def stats_of(path: Path) -> Stats:
    """Return names, sizes and times of the files at a path, without reading them: unfinished and hidden files do not count."""
    return tuple(sorted(_walk(path, "")))


def _walk(path: Path, prefix: str) -> Iterator[tuple[str, int, int]]:
    if not path.is_dir():
        with contextlib.suppress(OSError):
            found = path.stat()
            yield prefix, found.st_size, found.st_mtime_ns
        return
    with contextlib.suppress(OSError), os.scandir(path) as entries:
        for entry in entries:
            if not entry.name.startswith("."):
                yield from _walk(Path(entry.path), f"{prefix}/{entry.name}")


def _identity(job: Job) -> list[Any]:
    """Return version and words, with paths of input and output replaced: the same content elsewhere is the same job."""
    places = {str(path): f"<{i}>" for i, path in enumerate(job.reads)} | {str(job.writes): "<result>"}
    return [femsense.__version__, [places.get(word, word) for word in job.words if word != AGAIN]]


@lru_cache(maxsize=64)
def _content(path: Path, stats: Stats) -> str:
    """Return the hash of the content at a path; `stats` is a part of the key of the cache, so that a change is noticed."""
    if path.is_file():
        return file_hash(path)
    from femsense.io.provenance import RECORDING_PARTS, robot_input  # takes a second, which a job that is kept need not wait for
    from femsense.io.robot_toml import load_robot

    if (path / "robot.toml").is_file():
        return str(robot_input(load_robot(path))["sha256"])
    if (path / "recording.toml").is_file():
        parts = [path / part for part in RECORDING_PARTS]
        return _hash([(part.name, folder_hash(part) if part.is_dir() else file_hash(part)) for part in parts if part.exists()])
    return folder_hash(path)


def _hash(value: Any) -> str:
    return hashlib.sha256(json_text(value, indent=None).encode()).hexdigest()


# Moments of a job


def running_mark(job: Job) -> Path:
    """Return the file that exists while a worker runs a job: if the worker dies, it identifies the job."""
    return job.record.with_suffix(".running")


def log_of(job: Job) -> Path:
    """Return the log of a job: its output, and the place of a crash."""
    return job.record.with_suffix(".log")


def shortened(reason: str) -> str:
    """Return a reason that is not too long for a summary."""
    return reason if len(reason) <= LONGEST_REASON else reason[: LONGEST_REASON - 1] + "…"


def clear_parts(job: Job) -> None:
    """Remove the unfinished files of workers that died while they wrote the result of a job."""
    for part in job.writes.parent.glob(f"{PART_PREFIX}*-{glob.escape(job.writes.name)}"):
        if "lock-" not in part.name:
            shutil.rmtree(part, ignore_errors=True) if part.is_dir() else part.unlink(missing_ok=True)
