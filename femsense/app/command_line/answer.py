"""The output of a command: its answer, its progress, and lines on standard error."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer


@dataclass(frozen=True, eq=False, slots=True)
class ManyJobs:
    """A command on many recordings; `femsense.app.many_command` runs it."""

    command: Any
    """Of the command line, with its parameters."""
    given: dict[str, Any]
    """Parameter → value, of the options on the command line that each job gets."""
    robot: str | None
    """For all jobs."""
    units: Sequence[str | Path]
    """Recordings, scripts or folders, one or several a job; may hold patterns. Empty: those of `jobs`."""
    jobs: str | None
    """A table, or a pattern."""
    output: Path | None
    """Folder of all results; None: each result is written into the folder that it is about."""
    workers: int | None
    dask: str | None
    memory_gb: float | None
    again: bool
    others: frozenset[str]
    """Options of other commands: their columns of a table are ignored here."""


@dataclass(frozen=True, eq=False, slots=True)
class Served:
    """A server of a command, which runs until it ends by itself or by Ctrl-C."""

    wait: Callable[[], None]
    end: Callable[[], None]
    """Called at the end, however it came."""


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """The answer of a command."""

    document: dict[str, Any]
    """For `--json`."""
    text: str
    """For people."""
    exit_status: int = 0
    then: Served | None = None
    """The server that runs after the answer was printed."""
    many: ManyJobs | None = None
    """Jobs whose outcomes replace this answer."""


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None] | None]:
    """Yield the function to which a library function reports its progress: a bar on a terminal, else None."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    cut = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # a long label is cut, the other columns are not
    columns = (
        TextColumn("{task.description}", table_column=cut),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True, expand=True) as bar:
        task = bar.add_task(title, total=None, count="")

        def advance(done: int | str, total: int | None = None, label: str = title) -> None:
            nonlocal task
            if isinstance(done, int):
                bar.update(task, completed=done, total=total, description=label, count=f"{done}/{total}")
                return
            words, clock = label_and_clock(done)
            if bar.tasks[-1].total is None:
                bar.update(task, description=words, count=clock)
                return
            bar.remove_task(task)  # an update cannot take a total away
            task = bar.add_task(words, total=None, count=clock)

        yield advance


def label_and_clock(text: str) -> tuple[str, str]:
    """Return the label of a text and the clock in the brackets at its end, such as "refitting (40%, about 3 min left)"."""
    words, opened, rest = text.rpartition(" (")
    return (words, rest[:-1]) if opened and rest.endswith(" left)") else (text, "")


def say(text: str) -> None:
    """Write a line for people on standard error."""
    typer.echo(text, err=True)
