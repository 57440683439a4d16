"""Conversion between the types of a result and the plain tables of loop.json.

A type is declared once: `table_of` writes it, `femsense.io.tables.validated` reads it. An unknown number is NaN in a type and null in a
file. A missing key takes its default and an unknown key is ignored, so that files of other versions can be read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

NONE_AS = "none_as"
ABSENT = object()
LEFT_OUT = {NONE_AS: ABSENT}
"""Metadata of a field that is left out of the table if it is None …"""
AS_EMPTY = {NONE_AS: dict[str, Any]()}
"""… and of one that becomes an empty table then."""
NAN = float("nan")
Number = Annotated[float, BeforeValidator(lambda value: NAN if value is None else value)]
"""NaN if unknown."""
Vector = tuple[Number, ...]
Triple = Annotated[Vector, Field(min_length=3, max_length=3)]


class Columns:
    """A table as columns of equal length."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Raise ValueError if columns differ in length."""
        columns = (getattr(self, f.name) for f in fields(self) if f.name != "direction")  # type: ignore[arg-type]
        if len({len(column) for column in columns if isinstance(column, tuple)}) > 1:
            raise ValueError("the columns differ in length")


def table_of(value: Any, *, without: Sequence[str] = ()) -> Any:
    """Return dataclasses as tables named by their fields, except `without`, tuples as lists; other values unchanged."""
    if is_dataclass(value) and not isinstance(value, type):
        own = {f.name: _own(f, getattr(value, f.name)) for f in fields(value) if f.name not in without}
        return {name: table_of(item) for name, item in own.items() if item is not ABSENT}
    if isinstance(value, Mapping):
        return {key: table_of(item) for key, item in value.items()}
    return [table_of(item) for item in value] if isinstance(value, list | tuple) else value


def _own(f: Any, value: Any) -> Any:
    """Return the table entry of a field, with the substitute for None."""
    return f.metadata.get(NONE_AS) if value is None else value
