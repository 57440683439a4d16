"""`--map NAME=TARGET`: what a name in a source becomes in the recording, and what a unit beside a name says."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.io.importers.csv_tables import FORCES, LENGTHS, PRESSURES, SECONDS, number_in, split_unit

INPUT, MARKER, LOAD, COLUMN = "input", "marker", "load", "input, time, axis"
"""What a name may become."""
TARGETS = "cable_NAME, chamber_NAME, time (a factor may follow: *0.001), NAME.x, marker.NAME or load@X,Y,Z"
SHAPES = {
    INPUT: "cable_NAME or chamber_NAME",
    MARKER: "marker.NAME",
    LOAD: "load@X,Y,Z",
    "time": "time",
    "axis": "NAME.x, NAME.y or NAME.z",
}
NAME = re.compile(r"[^\s,;\"'*=@](?:[^,;\"'*=@]*[^\s,;\"'*=@])?")
IN_BRACKETS = re.compile(r".+?[\[(]\s*([^\[\]()]+?)\s*[\])]\s*")
Column = tuple[str, int, float]
"""Name in the recording, column of the table, factor."""


def check_targets(columns: Mapping[str, str]) -> None:
    """Refuse what is no target, and two names that become the same. Raises InputError."""
    names: dict[str, str] = {}
    for old, new in columns.items():
        if kind_of_target(new) is None:
            raise InputError("not a target", where=f"--map {old}={new}", found=new, expected=TARGETS)
        name = new if new.startswith("load@") else split_factor(new)[0]
        if name in names and not name.startswith("load@"):
            raise InputError(
                "two names become the same",
                where=f"--map {old}={new}",
                found=f"{names[name]} and {old}",
                expected="a target each",
            )
        names[name] = old


def kind_of_target(target: str) -> str | None:
    """Return INPUT, MARKER, LOAD, "time" or "axis"; None for what is no target. Raises InputError: a factor that is none."""
    if target.startswith("load@"):
        return LOAD
    name, _ = split_factor(target)
    if name == "time":
        return "time"
    stem, dot, last = name.rpartition(".")
    for begin, kind in (("cable_", INPUT), ("chamber_", INPUT)):
        if name.startswith(begin):
            return kind if NAME.fullmatch(name.removeprefix(begin)) else None
    if "*" in target:  # lengths have --unit
        return None
    if dot and last in ("x", "y", "z") and NAME.fullmatch(stem):
        return "axis"
    return MARKER if name.startswith("marker.") and NAME.fullmatch(name.removeprefix("marker.")) else None


def split_factor(target: str) -> tuple[str, float]:
    """Return name and factor of a target such as cable_north*4.615. Raises InputError."""
    name, star, factor = target.partition("*")
    value = number_in(factor) if star else 1.0
    if value is None or not math.isfinite(value) or value == 0.0:
        raise InputError("not a factor", where="--map", found=target, expected="NAME=TARGET*NUMBER")
    return name.strip(), value


def check_names(columns: Mapping[str, str], known: Mapping[str, str], path: Path, elsewhere: Sequence[str] = ()) -> None:
    """Refuse names that the source lacks, and markers that would become inputs or the other way round.

    Arguments:
        columns: name in the source → target.
        known: name in the source → what it may become, of INPUT, MARKER, LOAD, COLUMN.
        path: the source, for the message.
        elsewhere: names of the columns of a log of actuation, which were looked at first.

    Raises:
        InputError: with the names that are there.
    """
    for old, new in columns.items():
        if old not in known:
            raise unknown_name(old, new, known, path, elsewhere)
        able, kind = known[old].split(", "), kind_of_target(new)
        if kind not in able and not (kind == "axis" and new.startswith("marker.") and MARKER in able):
            raise InputError(
                f"{old} cannot become {new}",
                where=f"{path}, --map {old}={new}",
                found=new,
                expected="; ".join(SHAPES[word] for word in able),
            )


def check_taken(columns: Mapping[str, str], known: Mapping[str, str], path: Path) -> None:
    """Refuse a marker that gets the name of another one of the same source, which keeps it. Raises InputError."""
    for old, new in columns.items():
        name = new.removeprefix("marker.")
        if known.get(old) == MARKER == known.get(name) and name not in {old, old.rpartition(":")[2], *columns}:
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
            full.setdefault(split_unit(name)[0], name)
    return {full.get(old, old): new for old, new in columns.items()}


def mappable(names: Sequence[str]) -> dict[str, str]:
    """Return the names of a table's columns, with and without a unit in brackets, as `check_names` takes them."""
    return dict.fromkeys([*names, *(split_unit(name)[0] for name in names if IN_BRACKETS.fullmatch(name))], COLUMN)


def mapped_inputs(names: Sequence[str], columns: Mapping[str, str]) -> tuple[list[Column], set[str]]:
    """Return the mapped inputs in SI units, and what the units say that cables hold ("tension", "displacement").

    A factor in the mapping stands for the unit; else the unit behind the name counts; without one the values are in N, m or Pa.

    Raises:
        InputError: a unit that is none of what the column becomes.
    """
    found, kinds = list[Column](), set[str]()
    for old, new in columns.items():
        if kind_of_target(new) != INPUT or old not in names:
            continue
        name, factor = split_factor(new)
        unit = ""
        if "*" not in new:
            factor, unit = unit_beside(old, name)
        found.append((name, list(names).index(old), factor))
        kinds |= cable_kind(name, unit)
    return found, kinds


def cable_kind(target: str, unit: str) -> set[str]:
    """Return what a unit says that a cable's column holds."""
    if not unit or not target.startswith("cable_"):
        return set()
    return {"tension" if unit in FORCES else "displacement"}


def unit_beside(name: str, target: str, *, mapped: bool = True) -> tuple[float, str]:
    """Return SI units in one of a column's, and its unit, "" where its name says none.

    A single letter counts only in brackets: a cable may be named arm_n.

    Raises:
        InputError: the unit is of another quantity, or unknown.
    """
    sizes = SECONDS if target == "time" else PRESSURES if target.startswith("chamber_") else FORCES | LENGTHS
    bracketed, unit = IN_BRACKETS.fullmatch(name), split_unit(name)[1]
    if unit in sizes and (bracketed or len(unit) > 1 or target == "time"):
        return sizes[unit], unit
    other = mapped and len(unit) > 1 and unit in SECONDS | PRESSURES | FORCES | LENGTHS
    if bracketed or other:
        raise InputError(
            "a unit that is not the input's" if target != "time" else "a unit that is not one of time",
            where=f"column {name}",
            found=bracketed[1] if bracketed else unit,
            expected="|".join(sizes),
            hint=f"--map '{name}={target}*FACTOR' says what one of it is in SI units",
        )
    return 1.0, ""
