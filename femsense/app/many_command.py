"""A command on many recordings: its jobs, the run over them, and its answer."""

from __future__ import annotations

import contextlib
import inspect
import shlex
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

from femsense.app.command_line.answer import Answer, ManyJobs
from femsense.app.command_line.parameters import run_of
from femsense.core.errors import DataError, FemsenseError, InputError
from femsense.core.text import did_you_mean
from femsense.io.folder_lock import only_writer
from femsense.io.robot_toml import find_robot
from femsense.many.drive import Progress, run_jobs
from femsense.many.engines import open_engine
from femsense.many.jobs import RECORDS, Job, Row, expanded, is_glob, names_of, read_table
from femsense.many.limits import available_cores, memory_share
from femsense.many.outcome import Outcome, Scalar, Status
from femsense.many.records import AGAIN
from femsense.many.summary import check_no_result, check_summary_folder, read_summary, write_summary
from femsense.report.words import duration

Say = Callable[[str], None]
Run = Callable[..., Outcome]
TABLES = (".csv", ".parquet")
UNITS = {
    "calibrate": "recording",
    "estimate": "recording",
    "improve": "recording",
    "simulate": "script",
    "import": "source",
    "report": "dir",
}
"""Command → column of a table that holds the input of a job; all commands take `recording` too."""
TRUE, FALSE = ("1", "true", "yes"), ("0", "false", "no")
LINE_S = 30.0
"""Period of the lines on progress where no terminal shows a bar."""
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
    jobs = _jobs(asked, command, out)
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
            f"{out}: the summary is not written: {error.strerror}; results are kept, and the same command goes on"
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


# Jobs


def _jobs(asked: ManyJobs, command: str, out: Path) -> list[Job]:
    """Return the jobs of a command. Raises InputError."""
    options = {p.name: p for p in asked.command.params if p.param_type_name == "option"}
    common = {name: _words(options[name], value) for name, value in asked.given.items()}
    if asked.jobs is not None and not is_glob(asked.jobs) and Path(asked.jobs).suffix in TABLES:
        rows = read_table(Path(asked.jobs).expanduser())
        if not rows:
            raise InputError("no jobs", where=asked.jobs, found="a header and no rows", expected="one row for each job")
        hints = get_type_hints(inspect.unwrap(asked.command.callback))
        paths = {name for name in options if "Path" in str(hints.get(name))}
        foreign = asked.others - {max(p.opts, key=len).lstrip("-") for p in options.values()}
        rows = [replace(row, cells={c: v for c, v in row.cells.items() if c.replace("_", "-") not in foreign}) for row in rows]
        parts = [_of_row(row, command, options, paths, asked.robot) for row in rows]
    else:
        units = expanded(asked.units or [str(asked.jobs)])
        parts = [("", asked.robot, [str(unit)], {}) for unit in units]
    firsts = [Path(units[0].rpartition("=")[2] if len(units) > 1 else units[0]) for _, _, units, _ in parts]
    names = [own or name for (own, *_), name in zip(parts, _names(parts, firsts))]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError("two jobs have the same name", where="--jobs: name", found=twice, expected="a name for each job")
    return [
        _job(asked, command, out, name, robot, units, {**common, **own}) for name, (_, robot, units, own) in zip(names, parts)
    ]


def _names(parts: Sequence[tuple[str, str | None, list[str], dict[str, list[str]]]], firsts: Sequence[Path]) -> list[str]:
    """Return names of jobs by their input; where the same input occurs twice, by its number too."""
    unnamed = [first for first, (own, *_) in zip(firsts, parts) if not own]
    if len(set(unnamed)) == len(unnamed):
        found = iter(names_of(unnamed))
        return ["" if own else next(found) for own, *_ in parts]
    return [f"{first.stem}-{i + 1:04d}" for i, first in enumerate(firsts)]


def _job(
    asked: ManyJobs,
    command: str,
    out: Path,
    name: str,
    robot: str | None,
    units: list[str],
    options: dict[str, list[str]],
) -> Job:
    """Return one job: the words of its command line, and what it reads and writes."""
    words, reads = [command], list[Path]()
    if any(p.name == "robot" for p in asked.command.params):
        if robot is None:
            raise InputError("no robot", where="ROBOT", expected="on the command line, or in a column `robot` of the table")
        place = find_robot(robot).absolute()
        words.append(str(place.parent) if Path(robot).expanduser().exists() else robot)
        reads.append(place.parent)
    units = [str(run_of(Path(unit))) for unit in units] if command == "report" else units
    words += units
    reads += [Path(unit.rpartition("=")[2] if "=" in unit and not Path(unit).exists() else unit) for unit in units]
    target = out / name
    for option, own in options.items():
        if option == "calibration" and Path(own[1]).is_dir():
            own = [own[0], str(Path(own[1]) / name / "calibration.json")]
        words += own
        reads += [Path(word) for word in own if Path(word).is_absolute()]
    if command == "simulate":
        reads += _meshes_of_script(Path(units[0]))
    writes = {"calibrate": target / "calibration.json", "report": Path(units[0]) / "report.html"}.get(command, target)
    words += [] if command == "report" else ["-o", str(writes)]
    words += [AGAIN] if asked.again and any(p.name == "again" for p in asked.command.params) else []
    if command == "report":
        from femsense.report.found import MARKERS

        reads = [Path(units[0]) / marker for marker in MARKERS]
    return Job(name, tuple(words), tuple(reads), writes, out / RECORDS / command / f"{name}.json")


def _meshes_of_script(script: Path) -> list[Path]:
    from femsense.rig.script import read_script

    try:
        return [(script.parent / item.mesh).absolute() for item in read_script(script).objects if item.mesh is not None]
    except FemsenseError:  # the job says it
        return []


def _words(option: Any, value: Any) -> list[str]:
    """Return an option with its value as on a command line, paths absolute."""
    name = max(option.opts, key=len)
    if isinstance(value, bool):
        return [name] if value else list(option.secondary_opts[:1])
    values = value if isinstance(value, list | tuple) else [value]
    return [word for one in values for word in (name, str(one.expanduser().absolute() if isinstance(one, Path) else one))]


def _of_row(
    row: Row, command: str, options: Mapping[str, Any], paths: Collection[str], robot: str | None
) -> tuple[str, str | None, list[str], dict[str, list[str]]]:
    """Return name, robot, units and options of a row of a table; `paths` names options that are paths. Raises InputError."""
    cells = dict(row.cells)
    name, robot = cells.pop("name", ""), cells.pop("robot", robot)
    if name.startswith(".") or "/" in name or "\\" in name:
        raise InputError("not the name of a folder", where=f"{row.where}: name", found=name, expected="without / and not hidden")
    about = cells.pop(UNITS[command], None) or cells.pop("recording", None)
    if about is None:
        raise InputError("nothing to work on", where=row.where, expected=f"a column {UNITS[command]}")
    several = command in ("import", "improve")
    units = [_placed(text, row.folder) for text in (shlex.split(about) if several else [about])]
    if robot is not None and (row.folder / robot).exists():
        robot = str(row.folder / robot)
    own = dict[str, list[str]]()
    by_name = {max(p.opts, key=len).lstrip("-"): p for p in options.values()}
    for column, text in cells.items():
        option = by_name.get(column.replace("_", "-"))
        if option is None or option.name in ("jobs", "workers", "dask", "memory", "output", "json", "again"):
            known = [*by_name, "name", "robot", UNITS[command]]
            raise InputError(
                "unknown column", where=row.where, found=column, expected=", ".join(known), hint=did_you_mean(column, known)
            )
        own[option.name] = _cell_words(option, text, row, column, is_path=option.name in paths)
    return name, robot, units, own


def _cell_words(option: Any, text: str, row: Row, column: str, *, is_path: bool) -> list[str]:
    """Return an option whose value stands in a cell. Raises InputError for a flag that is neither yes nor no."""
    flag = max(option.opts, key=len)
    if option.is_flag:
        if text.lower() not in (*TRUE, *FALSE):
            raise InputError("neither yes nor no", where=f"{row.where}: {column}", found=text, expected="yes or no")
        return [flag] if text.lower() in TRUE else list(option.secondary_opts[:1])
    values = shlex.split(text) if option.multiple else [text]
    return [word for value in values for word in (flag, _placed(value, row.folder) if is_path else value)]


def _placed(text: str, folder: Path) -> str:
    """Return a path of a table, or NAME=PATH, with the table's folder in front of a relative path."""
    name, mark, path = text.partition("=")
    if mark and not (folder / text).exists():
        return f"{name}={_placed(path, folder)}"
    return str(folder / Path(text).expanduser())


# Progress


@contextlib.contextmanager
def _shown(command: str, say: Say) -> Iterator[Callable[[Progress], None]]:
    """Yield what shows progress: a bar on a terminal, else a line now and then."""
    if not sys.stderr.isatty():
        last = time.monotonic()

        def tell(now: Progress) -> None:
            nonlocal last
            if time.monotonic() - last >= LINE_S:
                last = time.monotonic()
                say(f"{command}: {progress_text(now)}")

        yield tell
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn(command), BarColumn(bar_width=20), TextColumn("{task.description}"), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True, expand=False) as bar:
        task = bar.add_task("")
        yield lambda now: bar.update(task, completed=now.finished, total=now.total, description=progress_text(now))


def progress_text(now: Progress) -> str:
    """Return how far many jobs have come, in one line."""
    parts = [f"{now.finished} of {now.total}"]
    parts += [f"{now.kept} were there"] if now.kept else []
    parts += [f"{now.failed} without a result"] if now.failed else []
    parts += [f"{now.running} running"]
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
    said = ", ".join(f"{n} {'were there' if status == Status.KEPT else status}" for status, n in counts.items())
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
