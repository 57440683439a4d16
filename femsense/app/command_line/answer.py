"""What a command says: its answer, its progress, and lines beside."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import typer


@dataclass(frozen=True, eq=False, slots=True)
class ManyJobs:
    """A command that is asked of many recordings; `femsense.app.many_command` runs it."""

    command: Any
    """Of the command line, with its parameters."""
    given: dict[str, Any]
    """Parameter → value, of the options on the command line that each job gets."""
    robot: str | None
    """For all jobs."""
    units: Sequence[str | Path]
    """What each job is about; may hold patterns. Empty: `jobs` says it."""
    jobs: str | None
    """A table, or a pattern."""
    output: Path | None
    """Folder of all results; None: each result stands in what it is about."""
    workers: int | None
    dask: str | None
    memory_gb: float | None
    again: bool
    others: frozenset[str]
    """Options of other commands: their columns of a table are of no concern here."""


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """What a command has to say."""

    document: dict[str, Any]
    """For `--json`."""
    text: str
    """For people."""
    exit_status: int = 0
    then: Callable[[], None] | None = field(default=None)
    """What goes on after it was said, until Ctrl-C."""
    many: ManyJobs | None = None
    """Jobs to run first: what they come to is the answer."""


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Callable[..., None] | None]:
    """Yield what a library function reports its progress to: a bar on a terminal, else None."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    label = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # a long one is cut, what stands beside it is not
    columns = (
        TextColumn("{task.description}", table_column=label),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True, expand=True) as bar:
        task = bar.add_task(title, total=None, count="")

        def advance(done: int | str, total: int | None = None) -> None:
            nonlocal task
            if isinstance(done, int):
                bar.update(task, completed=done, total=total, description=title, count=f"{done}/{total}")
                return
            words, clock = label_and_clock(done)
            if bar.tasks[-1].total is None:
                bar.update(task, description=words, count=clock)
                return
            bar.remove_task(task)  # an update cannot take a total away
            task = bar.add_task(words, total=None, count=clock)

        yield advance


def label_and_clock(text: str) -> tuple[str, str]:
    """Return what is going on, and how far that is where it ends with that in brackets: "refitting (40%, about 3 min left)"."""
    words, opened, rest = text.rpartition(" (")
    return (words, rest[:-1]) if opened and rest.endswith(" left)") else (text, "")


def say(text: str) -> None:
    """Tell people what happens, on standard error."""
    typer.echo(text, err=True)
