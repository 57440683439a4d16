"""What the commands of one recording share that take many: `--jobs`, `--workers`, `--dask`, `--memory`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from femsense.app.command_line.answer import Answer, ManyJobs
from femsense.app.command_line.parameters import option, required

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
        one_each: several units are several jobs. False: they are one joint job, and only `--jobs` asks for more.
    """
    from femsense.many.jobs import is_glob, parts_of

    given = context.params
    asked = [name for name in MANY if given[name] is not None]
    if not one_each:
        if given["jobs"] is None:
            if given["dask"] is not None or given["memory"] is not None:
                raise typer.BadParameter("--dask and --memory are of many jobs, and --jobs says which")
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
