"""What the commands of one recording share that take many: `--jobs`, `--workers`, `--dask`, `--memory`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from femsense.app.command_line.answer import Answer, ManyJobs
from femsense.app.command_line.parameters import option, required

if TYPE_CHECKING:
    from femsense.loop.search.all_recordings import Spread

T = TypeVar("T")
Jobs = Annotated[
    str | None,
    option("--jobs", "TABLE|GLOB", "Many jobs: a table (CSV, Parquet) with robot, recording, options by name; or a pattern."),
]
Workers = Annotated[int | None, option("--workers", "N", "Many jobs: so many processes; by default one a core.", min=0)]
Dask = Annotated[str | None, option("--dask", "ADDRESS|local|FILE", "Many jobs: on workers of dask; see femsense docs many.")]
Memory = Annotated[float | None, option("--memory", "GB", "Many jobs: what a worker may take at most.")]
MANY = ("jobs", "workers", "dask", "memory")


def several(
    context: typer.Context,
    units: Sequence[str | Path] | None,
    *,
    output: bool = True,
    one_each: bool = True,
) -> Answer | None:
    """Return the answer that many jobs are to run; None where the command is asked of one recording only.

    Arguments:
        context: of the command.
        units: what a job is about, from the command line.
        output: all results go below `-o`.
        one_each: several units are several jobs. False: they are one joint job, which has its own use for workers; only `--jobs` asks for more.
    """
    from femsense.many.jobs import is_glob, parts_of

    given = context.params
    asked = [name for name in MANY if given[name] is not None]
    if not one_each:
        if given["jobs"] is None:
            return None
    elif not asked and len(units or []) < 2 and not any(is_glob(unit) or parts_of(Path(unit)) for unit in units or []):
        return None
    if given["jobs"] is not None and units:
        raise typer.BadParameter(f"--jobs says what the jobs are about, and {units[0]} stands on the command line too")
    if given["jobs"] is None:
        required(context, units or None, _label(context), "argument")
    if output and (given["output"] is None or _source(context, "output") != "COMMANDLINE"):
        required(context, None, "'-o' / '--output'", "option")
    options = {p.name: p for p in context.command.params if p.param_type_name == "option" and p.name is not None}
    left_out = {*MANY, "output", "json", "again"}
    chosen = {name: given[name] for name in options if name not in left_out and _source(context, name) == "COMMANDLINE"}
    return Answer(
        {},
        "",
        many=ManyJobs(
            context.command,
            chosen,
            given.get("robot"),
            list(units or []),
            given["jobs"],
            given["output"] if output else None,
            given["workers"],
            given["dask"],
            given["memory"],
            bool(given.get("again")),
            _options_of_others(context),
        ),
    )


@contextlib.contextmanager
def spread_over(count: int, most: int, workers: int | None, dask: str | None, memory: float | None) -> Iterator[Spread | None]:
    """Yield what spreads so many recordings of one joint job over workers; None where this process works alone.

    Arguments:
        count: of recordings; no more than `most` need no engine.
        workers, dask, memory: as on the command line.

    Raises:
        BadParameter: a cluster for recordings that this process fits together.
    """
    from femsense.many.engines import open_engine, spread
    from femsense.many.limits import available_cores, memory_share

    if count <= most and (dask is not None or memory is not None):
        raise typer.BadParameter(f"--dask and --memory are of many jobs, or of more than {most} recordings")
    if count <= most or (workers == 0 and dask is None):
        yield None
        return
    with open_engine(workers, dask, memory_share(workers or available_cores(), memory)) as engine:
        yield partial(spread, engine)


def only(context: typer.Context, units: Sequence[T] | None) -> T:
    """Return the one recording that a command is asked of."""
    return required(context, units or None, _label(context), "argument")[0]


def _label(context: typer.Context) -> str:
    last = [p for p in context.command.params if p.param_type_name == "argument"][-1]
    return f"'{(last.metavar or last.name or '').rstrip('…')}'"


def _options_of_others(context: typer.Context) -> frozenset[str]:
    """Return the names of the options of all commands that take tables, without dashes in front."""
    group = None if context.parent is None else context.parent.command
    parameters = [command.params for command in getattr(group, "commands", {}).values()]
    tables = [params for params in parameters if any(p.name == "jobs" for p in params)]
    return frozenset(max(p.opts, key=len).lstrip("-") for params in tables for p in params if p.param_type_name == "option")


def _source(context: typer.Context, name: str) -> str:
    source = context.get_parameter_source(name)
    return "" if source is None else source.name
