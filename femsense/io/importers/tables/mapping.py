"""`--map NAME=TARGET`: the target of a name in the recording, and the unit next to a name."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean, plain_name
from femsense.core.units import Quantity, Unit, unit_named, units_of
from femsense.io.importers.tables.csv_tables import column_unit


class Becomes(StrEnum):
    """Kind of target of a name in the recording; the values show how it is written."""

    INPUT = "cable_NAME or chamber_NAME"
    MARKER = "marker.NAME"
    LOAD = "load@X,Y,Z"
    TIME = "time"
    AXIS = "NAME.x, NAME.y or NAME.z"


COLUMN = (Becomes.INPUT, Becomes.TIME, Becomes.AXIS)
"""Kinds of target of a column of a table."""
TARGETS = (
    "cable_NAME, chamber_NAME, time (a factor or a unit may follow: *0.001, *kPa, *1-101325), NAME.x, marker.NAME or load@X,Y,Z"
)
NAME = re.compile(r"[^\s,;\"'*=@](?:[^,;\"'*=@]*[^\s,;\"'*=@])?")
IN_BRACKETS = re.compile(r".+?[\[(]\s*([^\[\]]+?)\s*[\])]\s*")
NUMBER = r"\d*\.?\d+(?:[eE][-+]?\d+)?"
SCALE = re.compile(rf"([-+]?{NUMBER}\.?)([-+]{NUMBER})?")
QUANTITIES = {"time": (Quantity.TIME,), "chamber": (Quantity.PRESSURE,), "cable": (Quantity.FORCE, Quantity.LENGTH)}
"""First word of a target → quantities of its values."""


@dataclass(frozen=True, slots=True)
class Target:
    """Target of a name: value = factor × value in the file + offset."""

    name: str
    factor: float = 1.0
    offset: float = 0.0
    unit: Unit | None = None
    """Where one was named."""
    scaled: bool = False
    """Whether the target has a factor or a unit."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table that becomes an input."""

    name: str
    """In the recording."""
    index: int
    """In the table."""
    factor: float = 1.0
    offset: float = 0.0

    def values(self, rows: npt.ArrayLike) -> FloatArray:
        """Return the column of rows (n, columns) or of one row (columns,) in SI units."""
        return np.asarray(self.factor * np.asarray(rows, dtype=np.float64)[..., self.index] + self.offset)


def check_targets(columns: Mapping[str, str]) -> None:
    """Refuse invalid targets, and two names with the same target. Raises InputError."""
    names: dict[str, str] = {}
    for old, new in columns.items():
        if kind_of_target(new) is None:
            raise InputError("not a target", where=f"--map {old}={new}", found=new, expected=TARGETS)
        name = new if new.startswith("load@") else parse_target(new).name
        if name in names and not name.startswith("load@"):
            raise InputError(
                "two names become the same",
                where=f"--map {old}={new}",
                found=f"{names[name]} and {old}",
                expected="a target each",
            )
        names[name] = old


def kind_of_target(target: str) -> Becomes | None:
    """Return the kind of a target; None for an invalid one. Raises InputError for an invalid factor."""
    if target.startswith("load@"):
        return Becomes.LOAD
    name = parse_target(target).name
    if name == "time":
        return Becomes.TIME
    stem, dot, last = name.rpartition(".")
    for begin in ("cable_", "chamber_"):
        if name.startswith(begin):
            return Becomes.INPUT if NAME.fullmatch(name.removeprefix(begin)) else None
    if "*" in target:  # lengths have --unit
        return None
    if dot and last in ("x", "y", "z") and NAME.fullmatch(stem):
        return Becomes.AXIS
    return Becomes.MARKER if name.startswith("marker.") and NAME.fullmatch(name.removeprefix("marker.")) else None


def parse_target(target: str) -> Target:
    """Return a target such as cable_north, cable_north*4.615, chamber_a*bar or chamber_a*1-101325.

    Raises:
        InputError: the text after the asterisk is neither a factor, nor a factor with an offset, nor a unit of the target's quantity.
    """
    name, star, text = target.partition("*")
    name = plain_name(name)
    if not star:
        return Target(name)
    match, unit = SCALE.fullmatch(text.replace(" ", "")), unit_named(text)
    if match is not None and math.isfinite(float(match[1])) and float(match[1]) != 0.0:
        return Target(name, float(match[1]), float(match[2] or 0.0), scaled=True)
    wanted = QUANTITIES.get(name.partition("_")[0], ())
    if match is None and unit is not None and unit.quantity in wanted:
        return Target(name, unit.size, unit.zero, unit, scaled=True)
    units = "|".join(units_of(*wanted))
    raise InputError(
        "not a factor", where="--map", found=target, expected=f"NAME=TARGET*NUMBER, or *{units}" if units else TARGETS
    )


def check_names(
    columns: Mapping[str, str], known: Mapping[str, Sequence[Becomes]], path: Path, elsewhere: Sequence[str] = ()
) -> None:
    """Refuse names that the source lacks, and markers mapped to inputs or inputs mapped to markers.

    Arguments:
        columns: name in the source → target.
        known: name in the source → its allowed targets.
        path: the source, for the message.
        elsewhere: names of the columns of an actuation log, which are searched first.

    Raises:
        InputError: lists the existing names.
    """
    for old, new in columns.items():
        if old not in known:
            raise unknown_name(old, new, known, path, elsewhere)
        able, kind = known[old], kind_of_target(new)
        if kind not in able and not (kind is Becomes.AXIS and new.startswith("marker.") and Becomes.MARKER in able):
            raise InputError(
                f"{old} cannot become {new}",
                where=f"{path}, --map {old}={new}",
                found=new,
                expected="; ".join(able),
            )


def check_taken(columns: Mapping[str, str], known: Mapping[str, Sequence[Becomes]], path: Path) -> None:
    """Refuse a marker that gets the name of another one of the same source, which keeps it. Raises InputError."""
    for old, new in columns.items():
        name = new.removeprefix("marker.")
        both = known.get(old, ()), known.get(name, ())
        if all(Becomes.MARKER in able for able in both) and name not in {old, old.rpartition(":")[2], *columns}:
            raise InputError(
                "two names become the same",
                where=f"{path}, --map {old}={new}",
                found=f"{old} and {name}",
                expected="a name that no other marker has, or a mapping of that one too",
            )


def unknown_name(old: str, new: str, names: Iterable[str], path: Path, elsewhere: Sequence[str] = ()) -> InputError:
    """Return the error about a name that neither the source nor its log of actuation has."""
    listed = [name for name in dict.fromkeys(names) if name]
    text = ", ".join(listed[:20]) + (" …" if len(listed) > 20 else "") or "no names that can be mapped"
    return InputError(
        "a name that the source does not have",
        where=f"{path}, --map {old}={new}",
        found=old,
        expected=f"{path.name}: {text}; the log: {', '.join(elsewhere[:20])}" if elsewhere else text,
        hint=did_you_mean(old, [*listed, *elsewhere]),
    )


# Columns of tables


def resolved(columns: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    """Return the mapping with names as the table has them: a unit in brackets, or from the row of units, may be left out."""
    full = {name: name for name in names}
    for name in names:
        if IN_BRACKETS.fullmatch(name):
            full.setdefault(column_unit(name)[0], name)
    return {full.get(old, old): new for old, new in columns.items()}


def mappable(names: Sequence[str]) -> dict[str, Sequence[Becomes]]:
    """Return the names of a table's columns, with and without a unit in brackets, as `check_names` takes them."""
    return dict.fromkeys([*names, *(column_unit(name)[0] for name in names if IN_BRACKETS.fullmatch(name))], COLUMN)


def mapped_inputs(names: Sequence[str], columns: Mapping[str, str]) -> tuple[list[Column], set[str]]:
    """Return the mapped inputs in SI units, and the quantity of the cables by their units ("tension", "displacement").

    A factor or unit in the mapping takes precedence over the unit after the name; without either the values are in N, m or Pa.

    Raises:
        InputError: a unit of another quantity than the target's.
    """
    found, kinds = list[Column](), set[str]()
    for old, new in columns.items():
        if kind_of_target(new) is not Becomes.INPUT or old not in names:
            continue
        target = parse_target(new)
        if not target.scaled:
            unit = unit_beside(old, target.name)
            target = target if unit is None else Target(target.name, unit.size, unit.zero, unit)
        found.append(Column(target.name, list(names).index(old), target.factor, target.offset))
        kinds |= cable_kind(target.name, target.unit)
    return found, kinds


def cable_kind(target: str, unit: Unit | None) -> set[str]:
    """Return the quantity of a cable's column by its unit."""
    if unit is None or not target.startswith("cable_"):
        return set()
    return {"tension" if unit.quantity is Quantity.FORCE else "displacement"}


def unit_beside(name: str, target: str, *, mapped: bool = True) -> Unit | None:
    """Return a column's unit; None without one in its name.

    A single letter counts only in brackets: a cable may be named arm_n.

    Raises:
        InputError: the unit is of another quantity, or unknown.
    """
    wanted = QUANTITIES["time" if target == "time" else target.partition("_")[0]]
    bracketed, (bare, unit) = IN_BRACKETS.fullmatch(name), column_unit(name)
    spelt = name[len(bare) :].strip(" _[]()./")
    sure = bool(bracketed) or len(spelt) > 1 or target == "time"
    if unit is not None and unit.quantity in wanted and sure:
        return unit
    other = unit is not None and len(spelt) > 1 and (mapped or unit.quantity not in (Quantity.TIME, Quantity.LENGTH))
    if bracketed or other:
        raise InputError(
            "a unit that is not the input's" if target != "time" else "a unit that is not one of time",
            where=f"column {name}",
            found=bracketed[1] if bracketed else spelt,
            expected="|".join(units_of(*wanted)),
            hint=f"--map '{name}={bare if target == name else target}*FACTOR' states one of it in SI units",
        )
    return None
