"""Options of commands that take many recordings: `--jobs`, `--workers`, `--dask`, `--memory`."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from femsense.app.command_line.answer import Answer, ManyJobs
from femsense.app.command_line.parameters import missing, option

if TYPE_CHECKING:
    from femsense.loop.search.all_recordings import Spread


class Several(Enum):
    """How a command handles several inputs."""

    EACH = "each"
    """Each is a job."""
    TOGETHER = "together"
    """All recordings are one joint job, which uses the workers itself; only `--jobs` makes several."""


Jobs = Annotated[
    str | None,
    option("--jobs", "TABLE|GLOB", "Several jobs: a table (CSV, Parquet) with robot, recording, options by name; or a pattern."),
]
Workers = Annotated[int | None, option("--workers", "N", "Several jobs: number of processes; default: one per core.", min=0)]
Dask = Annotated[str | None, option("--dask", "ADDRESS|local|FILE", "Several jobs: on workers of dask; see femsense docs many.")]
Memory = Annotated[float | None, option("--memory", "GB", "Several jobs: memory limit of a worker.")]
MANY = {"jobs": Jobs, "workers": Workers, "dask": Dask, "memory": Memory}
"""Options of commands that take many jobs."""


def several(context: typer.Context, of: Several) -> Answer | None:
    """Return an answer with many jobs; None where the command is about one recording only.

    Arguments:
        context: of the command; its last argument holds the recordings, scripts or folders, and all results go below its `-o`, if any.
        of: whether each of them is a job.
    """
    from femsense.many.jobs import is_glob, parts_of

    given = context.params
    about = next(str(p.name) for p in reversed(context.command.params) if p.param_type_name == "argument")
    units: list[str | Path] = given[about] or []
    asked = given["jobs"] is not None
    if of is Several.EACH:
        asked = any(given[name] is not None for name in MANY) or len(units) > 1
        asked = asked or any(is_glob(unit) or parts_of(Path(unit)) for unit in units)
    if not asked:
        return None
    if given["jobs"] is not None and units:
        raise typer.BadParameter(f"--jobs declares the jobs, and {units[0]} stands on the command line too")
    if given["jobs"] is None and not units:
        raise missing(context, about)
    if "output" in given and (given["output"] is None or _source(context, "output") != "COMMANDLINE"):
        raise missing(context, "output")
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
            units,
            given["jobs"],
            given.get("output"),
            given["workers"],
            given["dask"],
            given["memory"],
            bool(given.get("again")),
            _options_of_others(context),
        ),
    )


@contextlib.contextmanager
def spread_over(count: int, most: int, workers: int | None, dask: str | None, memory: float | None) -> Iterator[Spread | None]:
    """Yield a function that spreads the recordings of one joint job over workers; None where this process works alone.

    Arguments:
        count: of recordings; no more than `most` need no engine.
        workers, dask, memory: as on the command line.

    Raises:
        BadParameter: a cluster for recordings that this process fits together.
    """
    from femsense.core.parallel import available_cores
    from femsense.many.engines import open_engine, spread
    from femsense.many.limits import memory_share

    if count <= most and (dask is not None or memory is not None):
        raise typer.BadParameter(f"--dask and --memory apply to several jobs, or to more than {most} recordings")
    if count <= most or (workers == 0 and dask is None):
        yield None
        return
    with open_engine(workers, dask, memory_share(workers or available_cores(), memory)) as engine:
        yield partial(spread, engine)


def _options_of_others(context: typer.Context) -> frozenset[str]:
    """Return the names of the options of all commands that take tables, without dashes in front."""
    group = None if context.parent is None else context.parent.command
    parameters = [command.params for command in getattr(group, "commands", {}).values()]
    tables = [params for params in parameters if any(p.name == "jobs" for p in params)]
    return frozenset(max(p.opts, key=len).lstrip("-") for params in tables for p in params if p.param_type_name == "option")


def _source(context: typer.Context, name: str) -> str:
    source = context.get_parameter_source(name)
    return "" if source is None else source.name
