"""The jobs of a command on many recordings: from its command line, or from a table."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from femsense.app.command_line.answer import ManyJobs
from femsense.app.command_line.parameters import run_of
from femsense.app.command_line.several import MANY
from femsense.core.errors import FemsenseError, InputError
from femsense.core.text import did_you_mean
from femsense.io.robot_toml import find_robot
from femsense.many.jobs import RECORDS, Job, Row, expanded, is_glob, names_of, read_table
from femsense.many.records import AGAIN

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
JOINT = ("import", "improve")
"""Commands whose cell of that column may hold several inputs."""
YES, NO = ("1", "true", "yes"), ("0", "false", "no")


@dataclass(frozen=True, slots=True)
class Task:
    """A job before it has a name and a place."""

    units: list[str]
    """Recordings, scripts, sources or folders."""
    robot: str | None
    options: dict[str, list[str]]
    """Parameter → its words on a command line."""
    name: str = ""
    """As a table gives it; empty: by the first unit."""

    @property
    def first(self) -> Path:
        """The path of the first unit."""
        return Path(self.units[0].rpartition("=")[2] if len(self.units) > 1 else self.units[0])


def jobs_of(asked: ManyJobs, out: Path) -> list[Job]:
    """Return the jobs of a command, with names that differ.

    Arguments:
        asked: as the command line has it.
        out: folder of all results.

    Raises:
        InputError: a table, a pattern or a robot that cannot be used; two jobs of one name.
    """
    options = {p.name: p for p in asked.command.params if p.param_type_name == "option"}
    common = {name: _words(options[name], value) for name, value in asked.given.items()}
    if asked.jobs is not None and not is_glob(asked.jobs) and Path(asked.jobs).suffix in TABLES:
        tasks = [_of_row(row, asked, common) for row in read_table(Path(asked.jobs).expanduser())]
    else:
        tasks = [Task([str(unit)], asked.robot, common) for unit in expanded(asked.units or [str(asked.jobs)])]
    if not tasks:
        raise InputError("no jobs", where=asked.jobs, found="a header and no rows", expected="one row for each job")
    return [_job(asked, out, task) for task in _named(tasks)]


def _named(tasks: Sequence[Task]) -> list[Task]:
    """Return tasks with names by their first units; where the same unit occurs twice, by its number too."""
    unnamed = [task.first for task in tasks if not task.name]
    if len(set(unnamed)) == len(unnamed):
        found = iter(names_of(unnamed))
        named = [task if task.name else replace(task, name=next(found)) for task in tasks]
    else:
        named = [replace(task, name=task.name or f"{task.first.stem}-{i + 1:04d}") for i, task in enumerate(tasks)]
    twice = next((name for name, count in Counter(task.name for task in named).items() if count > 1), None)
    if twice is not None:
        raise InputError("two jobs have the same name", where="--jobs: name", found=twice, expected="a name for each job")
    return named


def _job(asked: ManyJobs, out: Path, task: Task) -> Job:
    """Return the words of a job's command line, its input and its output."""
    command, name, units, target = str(asked.command.name), task.name, task.units, out / task.name
    words, reads = [command], list[Path]()
    if any(p.name == "robot" for p in asked.command.params):
        if task.robot is None:
            raise InputError("no robot", where="ROBOT", expected="on the command line, or in a column `robot` of the table")
        place = find_robot(task.robot).absolute()
        words.append(str(place.parent) if Path(task.robot).expanduser().exists() else task.robot)
        reads.append(place.parent)
    if command == "report":
        units = [str(run_of(Path(unit))) for unit in units]
    words += units
    reads += [Path(unit.rpartition("=")[2] if "=" in unit and not Path(unit).exists() else unit) for unit in units]
    for option, own in task.options.items():
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
    except FemsenseError:  # the job reports it
        return []


# Options


def _name_of(option: Any) -> str:
    """Return the long name of an option."""
    return str(max(option.opts, key=len))


def _words(option: Any, value: Any) -> list[str]:
    """Return an option with its value as on a command line, paths absolute."""
    if isinstance(value, bool):
        return [_name_of(option)] if value else list(option.secondary_opts[:1])
    values = value if isinstance(value, list | tuple) else [value]
    texts = [str(one.expanduser().absolute() if isinstance(one, Path) else one) for one in values]
    return [word for text in texts for word in (_name_of(option), text)]


def _of_row(row: Row, asked: ManyJobs, common: Mapping[str, list[str]]) -> Task:
    """Return the task of a row of a table; `common` are the options of all rows. Raises InputError."""
    options = {_name_of(p).lstrip("-"): p for p in asked.command.params if p.param_type_name == "option"}
    foreign, unit = asked.others - options.keys(), UNITS[str(asked.command.name)]
    cells = {column: text for column, text in row.cells.items() if column.replace("_", "-") not in foreign}
    name, robot = cells.pop("name", ""), cells.pop("robot", asked.robot)
    if name.startswith(".") or "/" in name or "\\" in name:
        raise InputError("not the name of a folder", where=f"{row.where}: name", found=name, expected="without / and not hidden")
    about = cells.pop(unit, None) or cells.pop("recording", None)
    if about is None:
        raise InputError("nothing to work on", where=row.where, expected=f"a column {unit}")
    units = [_placed(text, row.folder) for text in (shlex.split(about) if asked.command.name in JOINT else [about])]
    if robot is not None and (row.folder / robot).exists():
        robot = str(row.folder / robot)
    own = dict(common)
    for column, text in cells.items():
        option = options.get(column.replace("_", "-"))
        if option is None or option.name in (*MANY, "output", "json", "again"):
            known = [*options, "name", "robot", unit]
            raise InputError(
                "unknown column", where=row.where, found=column, expected=", ".join(known), hint=did_you_mean(column, known)
            )
        own[option.name] = _cell_words(option, text, row, column)
    return Task(units, robot, own, name)


def _cell_words(option: Any, text: str, row: Row, column: str) -> list[str]:
    """Return an option with the value of a cell. Raises InputError for a flag that is neither yes nor no."""
    if option.is_flag:
        if text.lower() not in (*YES, *NO):
            raise InputError("neither yes nor no", where=f"{row.where}: {column}", found=text, expected="yes or no")
        return _words(option, text.lower() in YES)
    values = shlex.split(text) if option.multiple else [text]
    is_path = "Path" in str(option.type_descriptor.annotation)
    return _words(option, [_placed(value, row.folder) if is_path else value for value in values])


def _placed(text: str, folder: Path) -> str:
    """Return a path of a table, or NAME=PATH, with the table's folder in front of a relative path."""
    name, mark, path = text.partition("=")
    if mark and not (folder / text).exists():
        return f"{name}={_placed(path, folder)}"
    return str(folder / Path(text).expanduser())
