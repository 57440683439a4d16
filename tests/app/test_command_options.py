"""Options of the command line and the types of the library that they fill."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer

from femsense.app.cli import run
from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer
from femsense.app.command_line.parameters import argument
from femsense.core.errors import InputError
from femsense.core.options import Flag


def lengths(texts: list[str]) -> tuple[float, ...]:
    if "x" in texts:
        raise InputError("not a length", where="--length", found="x")
    return tuple(map(float, texts))


class Shape(StrEnum):
    round = "round"
    flat = "flat"


@dataclass(frozen=True)
class Wanted:
    size: Annotated[float, Flag("-s --size", "MM", "How large.", min=0.5)] = 1.0
    lengths: Annotated[tuple[float, ...], Flag("--length", "MM", "How long.", read=lengths)] = ()
    files: Annotated[Sequence[Path], Flag("--file", "FILE", "Which files.")] = ()
    shape: Annotated[Shape, Flag("--shape", help="Which shape.")] = Shape.round
    quick: bool = False


def program(seen: list[Any]) -> typer.Typer:
    """Return a program with one command, which keeps what it is given."""

    @command()
    def work(place: Annotated[str, argument("PLACE", "Where.")], wanted: Wanted) -> Answer:
        """Work."""
        seen.append((place, wanted))
        return Answer({"size": wanted.size}, "done")

    made = typer.Typer(callback=lambda: None, pretty_exceptions_enable=False)
    made.command("work")(work)
    return made


def test_a_field_with_a_flag_is_an_option_and_others_keep_their_defaults() -> None:
    seen = list[Any]()
    assert run(["work", "here", "-s", "2", "--length", "3", "--length", "4", "--file", "a"], program=program(seen)) == 0
    assert run(["work", "there"], program=program(seen)) == 0
    assert seen == [("here", Wanted(2.0, (3.0, 4.0), (Path("a"),))), ("there", Wanted())]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["work"], "Missing argument 'PLACE'"),
        (["work", "here", "--size", "0"], "greater than or equal to 0.5"),
        (["work", "here", "--length", "x"], "--length: not a length"),
        (["work", "here", "--shape", "x"], "Invalid value for '--shape': 'x' is not one of 'round', 'flat'. See: "),
        (["work", "here", "--quick"], "No such option: --quick"),
    ],
)
def test_what_an_options_type_does_not_take_is_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words, program=program([])) == 2 and said in capsys.readouterr().err
