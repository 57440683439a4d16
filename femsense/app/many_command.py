"""A command on many recordings: its jobs, the run over them, and its answer."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from femsense.app.command_line.answer import Answer, ManyJobs, progress_bar
from femsense.app.many_jobs import jobs_of
from femsense.core.errors import DataError
from femsense.core.parallel import available_cores
from femsense.io.folder_lock import only_writer
from femsense.many.drive import Progress, run_jobs
from femsense.many.engines import open_engine
from femsense.many.jobs import expanded
from femsense.many.limits import memory_share
from femsense.many.outcome import JobStatus, Outcome, Scalar
from femsense.many.summary import check_no_result, check_summary_folder, read_summary, write_summary
from femsense.report.words import duration

Say = Callable[[str], None]
Run = Callable[..., Outcome]
LINE_S = 30.0
"""Period of the lines on progress where no terminal shows a bar."""
NO_WORKER = "no worker yet"
LISTED = 5
"""Jobs without a result that are listed."""


def run_many(asked: ManyJobs, run_job: Run, *, say: Say) -> Answer:
    """Run the jobs of a command, and write their summary.

    Arguments:
        asked: of the command line.
        run_job: runs one in a worker, by its name there: called with a job, `memory_bytes` and `in_process`.
        say: called with lines on progress.

    Raises:
        FemsenseError: bad input, no engine, a full disk, or another command that works on the same folder.
    """
    command = str(asked.command.name)
    out = _folder_of_all(asked)
    check_summary_folder(out)
    if asked.output is not None:
        check_no_result(out)
    jobs = jobs_of(asked, out)
    workers = None if asked.workers == 0 else asked.workers
    memory = memory_share(workers or available_cores(), asked.memory_gb)
    if asked.dask is not None and asked.dask != "local" and asked.memory_gb is None:
        memory = None  # that of its workers
    in_process = asked.workers == 0 and asked.dask is None
    work = partial(run_job, memory_bytes=None if in_process else memory, in_process=in_process)
    with only_writer(out), open_engine(asked.workers, asked.dask, memory) as engine, _shown(command, say) as progress:
        outcomes = run_jobs(jobs, work, engine, again=asked.again, progress=progress)
    folders = {job.name: job.writes.parent if job.writes.suffix in (".json", ".html") else job.writes for job in jobs}
    try:
        _summarise(out, command, outcomes, folders)
    except OSError as error:
        raise DataError(
            f"{out}: the summary is not written: {error.strerror}; results are kept, and the same command continues"
        ) from error
    return _answer(out, command, outcomes)


def _folder_of_all(asked: ManyJobs) -> Path:
    if asked.output is not None:
        return asked.output.expanduser().absolute()
    return expanded(asked.units or [str(asked.jobs)])[0].parent


def _summarise(out: Path, command: str, outcomes: Sequence[Outcome], folders: Mapping[str, Path]) -> None:
    """Write the summary; reports next to results of another command renew the links of its summary."""
    before = read_summary(out) if command == "report" else None
    if before is not None and before[0] != "report":
        write_summary(out, *before)
    else:
        write_summary(out, command, outcomes, folders)


# Progress


@contextlib.contextmanager
def _shown(command: str, say: Say) -> Iterator[Callable[[Progress], None]]:
    """Yield a function that shows progress: in a bar on a terminal, else in a line from time to time."""
    with progress_bar(command) as bar:
        last = time.monotonic()

        def show(now: Progress) -> None:
            nonlocal last
            text = f"{command}: {progress_text(now)}"
            if bar is not None:
                bar(now.finished, now.total, text)
            elif time.monotonic() - last >= LINE_S:
                last = time.monotonic()
                say(text)

        yield show


def progress_text(now: Progress) -> str:
    """Return how far many jobs have come, in one line."""
    parts = [f"{now.finished} of {now.total}"]
    parts += [f"{now.kept} were there"] if now.kept else []
    parts += [f"{now.failed} without a result"] if now.failed else []
    parts += [f"{now.running} running"] if now.running else [NO_WORKER] if now.finished < now.total else []
    parts += [f"{duration(now.seconds_left)} left"] if now.seconds_left is not None and now.finished < now.total else []
    parts += [f"slowest {now.slowest.name} {duration(now.slowest.seconds)}"] if now.slowest is not None else []
    return ", ".join(parts)


# The answer


def row_of(command: str, document: Mapping[str, Any]) -> dict[str, Scalar]:
    """Return the result of a command in a few numbers: columns of the summary."""
    d = document
    if command == "calibrate":
        worst = max(d["marker_rms_m"].items(), key=lambda item: item[1] or 0.0, default=(None, None))
        return {"calibration": d["status"], "rms_m": d["rms_m"], "noise_m": d["noise_m"], "worst_marker": worst[0]}
    if command == "estimate":
        statuses = Counter(frame["status"] for frame in d["failed"])
        said = ", ".join([f"{d['frames_ok']} ok", *(f"{n} {status}" for status, n in statuses.most_common(4))])
        names = ("frames", "contacts", "frames_with_contact", "largest_force_n", "rms_before_m", "rms_after_m", "ms_per_frame")
        return {"frame_statuses": said, **{name: d[name] for name in names}, "frames_unexplained": len(d["unexplained"])}
    if command == "improve":
        rms = {
            f"{when}_{name}": (d[when] or {}).get(name)
            for when in ("before", "after")
            for name in ("train_rms_m", "validation_rms_m")
        }
        return {"verdict": d["verdict"], "effects": ", ".join(e["name"] for e in d["effects"]), "noise_m": d["noise_m"], **rms}
    if command == "import":
        return {name: d.get(name) for name in ("format", "frames") if isinstance(d.get(name), str | int)}
    return {}


def _answer(out: Path, command: str, outcomes: Sequence[Outcome]) -> Answer:
    counts = Counter(o.status.value for o in outcomes)
    bad = [o for o in outcomes if not o.is_good]
    said = ", ".join(f"{n} {'were there' if status == JobStatus.KEPT else status}" for status, n in counts.items())
    lines = [f"{command}: {said}, of {len(outcomes)} jobs"]
    lines += [f"  {o.name}: {o.status.value}: {o.reason.splitlines()[0] if o.reason else ''}" for o in bad[:LISTED]]
    lines += [f"  … and {len(bad) - LISTED} more"] if len(bad) > LISTED else []
    poison = out / "poison.csv"
    files = [file for name in ("summary.csv", "summary.html", "poison.csv") if (file := out / name).is_file()]
    text = "\n".join([*lines, "", *(f"written: {file}" for file in files)])
    results = [
        {"name": o.name, "status": o.status.value, "reason": o.reason, "seconds": round(o.seconds, 3), **o.row} for o in outcomes
    ]
    document = {
        "folder": str(out),
        "command": command,
        "counts": dict(counts),
        "summary": str(out / "summary.csv"),
        "poison": str(poison) if poison.is_file() else None,
        "jobs": results,
    }
    return Answer(document, text, exit_status=1 if bad else 0)
