"""From a function of the library's types to a command of Typer: the one place where parameters of commands are made.

A command is a function of what it works on. `command` adds `--json`, expands each options type into an option for each of its fields
that carries a `Flag`, and adds the options of many jobs where a command takes several recordings.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from inspect import Parameter
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from femsense.app.command_line.answer import Answer
from femsense.app.command_line.parameters import Json, missing, option
from femsense.app.command_line.several import MANY, Several, several
from femsense.core.options import Flag

Command = Callable[..., Answer]


def command(of: Several | None = None) -> Callable[[Command], Command]:
    """Return a decorator that makes a command of a function.

    The function's parameters are arguments (`argument`), options (`option`), and options types. Where a command takes many jobs, a
    parameter without a default may be missing on the command line as long as `--jobs` names a table that has it.

    Arguments:
        of: how a command takes several recordings; None: it takes no jobs.
    """

    def adapt(function: Command) -> Command:
        own = list(inspect.signature(function, eval_str=True).parameters.values())
        shown = {"context": Parameter("context", Parameter.KEYWORD_ONLY, annotation=typer.Context)}
        for parameter in own:
            expanded = _of_options(parameter.annotation) if is_dataclass(parameter.annotation) else [_shown(parameter, of)]
            shown |= {each.name: each for each in expanded}
        for name, annotation in MANY.items() if of is not None else ():
            shown.setdefault(name, Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=annotation))
        shown["json"] = Parameter("json", Parameter.KEYWORD_ONLY, default=False, annotation=Json)

        def run(context: typer.Context, **given: Any) -> Answer:
            if of is not None and (jobs := several(context, of)) is not None:
                return jobs
            given["context"] = context
            for parameter in own:
                if parameter.default is Parameter.empty and given.get(parameter.name, "") in (None, []):
                    raise missing(context, parameter.name)
            return function(
                **{p.name: _filled(p.annotation, given) if is_dataclass(p.annotation) else given[p.name] for p in own}
            )

        run.__name__, run.__doc__ = function.__name__, function.__doc__
        run.__annotations__ = {name: parameter.annotation for name, parameter in shown.items()}
        run.__signature__ = inspect.Signature(list(shown.values()))  # type: ignore[attr-defined]
        return run

    return adapt


def _shown(parameter: Parameter, of: Several | None) -> Parameter:
    """Return a parameter as Typer sees it: one that a table of jobs may hold instead is optional."""
    if of is None or parameter.default is not Parameter.empty or parameter.annotation is typer.Context:
        return parameter.replace(kind=Parameter.KEYWORD_ONLY)
    type_, info = parameter.annotation.__origin__, parameter.annotation.__metadata__[0]
    return parameter.replace(kind=Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[type_ | None, info])


def _of_options(type_: Any) -> Iterator[Parameter]:
    """Yield a parameter for each field of an options type that carries a `Flag`; one that is read or a sequence may be repeated."""
    types, defaults = get_type_hints(type_), {field.name: field.default for field in fields(type_)}
    for name, flag in _flags(type_).items():
        limits = {name: limit for name, limit in (("min", flag.min), ("max", flag.max)) if limit is not None}
        said = option(flag.flags, flag.metavar, flag.help, **limits)
        taken, default = types[name], defaults[name]
        if flag.read is not None:
            taken, default = list[str] | None, None
        elif get_origin(taken) is Sequence:
            taken, default = list[get_args(taken)] | None, None  # type: ignore[misc]
        yield Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[taken, said])


def _filled(type_: Any, given: dict[str, Any]) -> Any:
    """Return an options type made of the values on the command line. Raises InputError where a text cannot be read."""
    types, values = get_type_hints(type_), {}
    for name, flag in _flags(type_).items():
        read = flag.read or (tuple if get_origin(types[name]) is Sequence else None)
        values[name] = given[name] if read is None else read(given[name] or [])
    return type_(**values)


def _flags(type_: Any) -> dict[str, Flag]:
    """Return the flags of the fields of an options type, by name."""
    hints = get_type_hints(type_, include_extras=True)
    said = [(name, item) for name, hint in hints.items() for item in getattr(hint, "__metadata__", ())]
    return {name: item for name, item in said if isinstance(item, Flag)}
