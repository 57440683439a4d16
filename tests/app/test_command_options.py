"""Options of the command line and the types of the library that they fill."""

from __future__ import annotations

import inspect
from dataclasses import MISSING, dataclass, fields
from enum import Enum
from typing import Any

import pytest

from femsense.app.cli import COMMANDS
from femsense.app.command_line.parameters import filled
from femsense.io.importers.frames import Options
from femsense.io.meshing.filling import MeshOptions
from femsense.loop.improve import ImproveOptions
from femsense.sensing.types import SensingOptions


@dataclass(frozen=True)
class Wanted:
    size: float = 1.0
    names: tuple[str, ...] = ()
    quick: bool = False


def test_options_are_filled_with_the_parameters_of_their_names() -> None:
    assert filled(Wanted, {"size": 2.0, "other": 3.0}) == Wanted(2.0)
    assert filled(Wanted, {"size": 2.0, "names": None}, names=("a",)) == Wanted(2.0, ("a",))


@pytest.mark.parametrize(
    ("command", "type_"), [("import", Options), ("mesh", MeshOptions), ("estimate", SensingOptions), ("improve", ImproveOptions)]
)
def test_a_default_of_a_command_is_that_of_the_library(command: str, type_: type[Any]) -> None:
    of_command = {p.name: p.default for p in inspect.signature(COMMANDS[command]).parameters.values()}
    of_library = {f.name: f.default for f in fields(type_) if f.default is not MISSING and f.name in of_command}
    shown = {name: value.value if isinstance(value, Enum) else value for name, value in of_command.items() if name in of_library}
    assert shown == {name: None if value == () else value for name, value in of_library.items()} and len(shown) > 1
