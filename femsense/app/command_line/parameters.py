"""Parameters that several commands share, and readers of their texts."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.exceptions import TyperException

from femsense.core.errors import InputError

SEVERAL = ("--at", "--validation", "--reference", "--effects", "--without", "--target", "--force", "--topic", "--map")
"""Options that take several values after one another."""
FREE = ("", "*")
"""Text of a free coordinate."""


def option(flags: str, metavar: str | None = None, help: str = "", **limits: Any) -> Any:
    """Return an option of a command, for `Annotated`: its flags separated by blanks, its placeholder, and its description."""
    return typer.Option(*flags.split(), metavar=metavar, help=help, **limits)


def argument(metavar: str, help: str) -> Any:
    """Return an argument of a command, for `Annotated`."""
    return typer.Argument(metavar=metavar, help=help, show_default=False)


RobotPath = Annotated[str, argument("ROBOT", "A folder with robot.toml, or the name of a robot of the package.")]
Recordings = Annotated[
    list[Path], argument("RECORDING…", "A folder with recording.toml; several folders, or a pattern, are several jobs.")
]


RunPath = Annotated[Path, argument("RUN", "A folder that femsense estimate wrote.")]
Json = Annotated[bool, option("--json", help="One JSON object on standard output, nothing else there.")]


def run_of(folder: Path) -> Path:
    """Return the folder of a run: that of a session where one is given, made where a killed session left it unfinished."""
    if not (folder / "session.json").is_file():
        return folder
    from femsense.live.recorder import session_run

    return session_run(folder)


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


def missing(context: typer.Context, name: str) -> TyperException:
    """Return the error for a missing parameter that --plan or --jobs does not need."""
    parameter = next(p for p in context.command.params if p.name == name)
    is_argument = parameter.param_type_name == "argument"
    names = [str(parameter.metavar).rstrip("…")] if is_argument else parameter.opts
    error = TyperException(f"Missing {parameter.param_type_name} {' / '.join(map(repr, names))}.")
    error.ctx = context  # type: ignore[attr-defined]
    return error


def three_numbers(text: str, *, free: bool = False) -> tuple[float, float, float] | None:
    """Return the numbers of X,Y,Z; None for other text.

    Arguments:
        text: of the command line.
        free: an empty number, or "*", is left free: NaN.
    """
    try:
        x, y, z = (math.nan if free and part.strip() in FREE else float(part) for part in text.split(","))
    except ValueError:
        return None
    return (x, y, z) if free or all(map(math.isfinite, (x, y, z))) else None


def places(texts: Sequence[str]) -> list[tuple[float, float, float]] | None:
    """Return places given as x,y,z [m]; None where none is given. Raises typer.BadParameter."""
    found = []
    for text in texts:
        place = three_numbers(text)
        if place is None:
            raise typer.BadParameter(f"{text!r} is not a place: three numbers in metres are, such as --at 0.1,0,0.015")
        found.append(place)
    return found or None


def split_names(texts: Sequence[str] | None) -> list[str] | None:
    """Return names separated by commas or given in several options; None without such an option."""
    names = [name.strip() for text in texts or [] for name in text.split(",") if name.strip()]
    if texts and not names:
        raise InputError(
            "no name",
            where="--effects, --without",
            found=", ".join(map(repr, texts)),
            expected="names of effects, with commas between",
        )
    return names or None
