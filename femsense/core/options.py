"""Options types as command lines see them: a field carries its flags and its help, so that an option is declared once.

Nothing is imported here that a command line would have to wait for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Flag:
    """How a field of an options type is written on a command line; stands in the `Annotated` type of the field."""

    flags: str
    """With blanks between them, such as "-o --output"."""
    metavar: str | None = None
    help: str = ""
    min: float | None = None
    max: float | None = None
    read: Callable[[list[str]], Any] | None = None
    """Turns the texts of an option that may be given several times into the value of the field; raises InputError."""
