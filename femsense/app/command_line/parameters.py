"""Parameters that several commands have, and how they are read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from typer.exceptions import TyperException

from femsense.core.errors import InputError

T = TypeVar("T")
SEVERAL = ("--at", "--validation", "--reference", "--effects", "--without", "--target", "--force", "--topic", "--map")
"""Options that take several values after one another."""
RobotPath = Annotated[
    str,
    typer.Argument(
        metavar="ROBOT", help="A folder with robot.toml, or the name of a robot that comes along.", show_default=False
    ),
]
OneRobot = Annotated[
    str | None,
    typer.Argument(
        metavar="ROBOT", help="A folder with robot.toml, or the name of a robot that comes along.", show_default=False
    ),
]
"""A robot that a table of jobs may name instead."""
Recordings = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="RECORDING…", help="A folder with recording.toml; several, or a pattern, are many jobs.", show_default=False
    ),
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="A folder that femsense estimate wrote.", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on standard output, nothing else there.")]


def repeat_options(words: list[str]) -> list[str]:
    """Repeat an option for each of the values that follow it: --validation A B is --validation A --validation B."""
    result: list[str] = []
    option: str | None = None
    count = 0
    for word in words:
        is_value = not word.startswith("-") or re.match(r"-[\d.]", word) is not None
        if option is not None and is_value:
            result += [option, word] if count else [word]
            count += 1
            continue
        option, count = (word, 0) if word in SEVERAL else (None, 0)
        result.append(word)
    return result


def required(context: typer.Context, value: T | None, name: str, kind: str) -> T:
    """Return what only --plan or --jobs can do without."""
    if value is None:
        error = TyperException(f"Missing {kind} {name}.")
        error.ctx = context  # type: ignore[attr-defined]
        raise error
    return value


def places(texts: Sequence[str]) -> list[list[float]] | None:
    """Return places given as x,y,z [m]; None where none is given. Raises typer.BadParameter."""
    places = []
    for text in texts:
        try:
            place = [float(part) for part in text.split(",")]
        except ValueError:
            place = []
        if len(place) != 3:
            raise typer.BadParameter(f"{text!r} is not a place: three numbers in metres are, such as --at 0.1,0,0.015")
        places.append(place)
    return places or None


def split_names(texts: Sequence[str] | None) -> list[str] | None:
    """Return names that stand between commas or in options of their own; None where there is no such option."""
    names = [name.strip() for text in texts or [] for name in text.split(",") if name.strip()]
    if texts and not names:
        raise InputError(
            "no name",
            where="--effects, --without",
            found=", ".join(map(repr, texts)),
            expected="names of effects, with commas between",
        )
    return names or None
