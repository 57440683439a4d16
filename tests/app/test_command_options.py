"""Options of the command line and the types of the library that they fill."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, dataclass, fields
from enum import Enum
from typing import Annotated, Any

import pytest
import typer

from femsense.app.cli import COMMANDS, run
from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer
from femsense.app.command_line.parameters import argument, filled
from femsense.core.errors import InputError
from femsense.core.options import Flag
from femsense.loop.improve import ImproveOptions
from femsense.sensing.types import SensingOptions


def lengths(texts: list[str]) -> tuple[float, ...]:
    if "x" in texts:
        raise InputError("not a length", where="--length", found="x")
    return tuple(map(float, texts))


@dataclass(frozen=True)
class Wanted:
    size: Annotated[float, Flag("-s --size", "MM", "How large.", min=0.5)] = 1.0
    lengths: Annotated[tuple[float, ...], Flag("--length", "MM", "How long.", read=lengths)] = ()
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


def test_options_are_filled_with_the_parameters_of_their_names() -> None:
    assert filled(Wanted, {"size": 2.0, "other": 3.0}) == Wanted(2.0)
    assert filled(Wanted, {"size": 2.0, "lengths": None}, lengths=(1.0,)) == Wanted(2.0, (1.0,))


def test_a_field_with_a_flag_is_an_option_and_others_keep_their_defaults() -> None:
    seen = list[Any]()
    assert run(["work", "here", "-s", "2", "--length", "3", "--length", "4"], program=program(seen)) == 0
    assert run(["work", "there"], program=program(seen)) == 0
    assert seen == [("here", Wanted(2.0, (3.0, 4.0))), ("there", Wanted())]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["work"], "Missing argument 'PLACE'"),
        (["work", "here", "--size", "0"], "greater than or equal to 0.5"),
        (["work", "here", "--length", "x"], "--length: not a length"),
        (["work", "here", "--quick"], "No such option: --quick"),
    ],
)
def test_what_an_options_type_does_not_take_is_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words, program=program([])) == 2 and said in capsys.readouterr().err


@pytest.mark.parametrize(("name", "type_"), [("estimate", SensingOptions), ("improve", ImproveOptions)])
def test_a_default_of_a_command_is_that_of_the_library(name: str, type_: type[Any]) -> None:
    of_command = {p.name: p.default for p in inspect.signature(COMMANDS[name][0]).parameters.values()}
    of_library = {f.name: f.default for f in fields(type_) if f.default is not MISSING and f.name in of_command}
    shown = {name: value.value if isinstance(value, Enum) else value for name, value in of_command.items() if name in of_library}
    assert shown == {name: None if value == () else value for name, value in of_library.items()} and len(shown) > 1
