"""Options of a source of another program, in Python and on the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from femsense.core.errors import InputError
from femsense.core.options import Flag

UNITS = ("m", "cm", "mm", "in", "ft")
"""Units of length that `--unit` takes, in any spelling that `core.units` knows."""


class Axis(StrEnum):
    """A vertical axis."""

    x = "x"
    y = "y"
    z = "z"


class Clock(StrEnum):
    """Which time stamps of a bag are used."""

    AUTO = "auto"
    """Those of headers where these are a clock, else those of recording."""
    HEADER = "header"
    RECORD = "record"
    """Of the moment at which a message was written."""


class Inputs(StrEnum):
    """The quantity of the cable inputs."""

    tension = "tension"
    displacement = "displacement"


class Zero(StrEnum):
    """Whether the zero of the inputs is known."""

    absolute = "absolute"
    unknown = "unknown"


@dataclass(frozen=True, slots=True)
class InputOptions:
    """Options of the inputs of a recording."""

    inputs: Annotated[Inputs | None, Flag("--inputs", help="Quantity of the cable inputs.")] = None
    """None: as declared by the source."""
    zero: Annotated[Zero | None, Flag("--zero", help="Their zero.")] = None
    actuation: Annotated[Path | None, Flag("--actuation", "FILE", "A CSV file with the inputs over time.")] = None
    offset: Annotated[
        float | None, Flag("--offset", "S", "Time of the frames minus time of that file; default: from the motion.")
    ] = None
    """None: found from the motion."""


def columns_named(columns: Sequence[str]) -> dict[str, str]:
    """Return the mappings NAME=TARGET of `--map` as name in the source → name in the recording. Raises InputError."""
    pairs = [text.rpartition("=") if "@" not in text else text.partition("=") for text in columns]
    for text, (old, mark, new) in zip(columns, pairs):
        if not (old and mark and new):
            raise InputError(
                "not a mapping", where="--map", found=text, expected="NAME=TARGET, such as motor1=cable_north or 3=tip.x"
            )
    return {old: new for old, _, new in pairs}


def shifts_named(shifts: Sequence[str]) -> dict[str, float]:
    """Return the seconds CAMERA=S of `--shift` as camera → seconds. Raises InputError."""
    found: dict[str, float] = {}
    for text in shifts:
        name, _, value = text.rpartition("=")
        try:
            found[name] = float(value)
        except ValueError:
            name = ""
        if not name:
            raise InputError("not a shift of a camera's times", where="--shift", found=text, expected="CAMERA=SECONDS")
    return found


def free_named(ranges: Sequence[str]) -> list[tuple[float, float]]:
    """Return the spans FROM:TO of `--free` [s]. Raises InputError."""
    spans = []
    for text in ranges:
        try:
            first, last = (float(part) for part in text.split(":"))
        except ValueError:
            first, last = 1.0, 0.0
        if first > last:
            raise InputError("not a span of time", where="--free", found=text, expected="FROM:TO, seconds after the first frame")
        spans.append((first, last))
    return spans


@dataclass(frozen=True, eq=False, slots=True)
class Options:
    """Options of a source; by default everything is taken from the file."""

    format: Annotated[str | None, Flag("--format", "NAME", "Format, if it is not identified; see femsense docs importing.")] = (
        None
    )
    topics: Annotated[Sequence[str], Flag("--topic", "NAME", "Topics of a bag, or markers of a motion capture, to import.")] = ()
    """Topics, streams, tracks or names."""
    columns: Annotated[
        Mapping[str, str],
        Flag(
            "--map",
            "NAME=TARGET",
            "Meaning of a name of the source: motor1=cable_north*4.6, 3=tip.x, /ft=load@X,Y,Z.",
            read=columns_named,
        ),
    ] = field(default_factory=dict)
    """Name in the source → name in the recording, such as cable_north, chamber_a, marker.x or load@0.1,0,0.02;
    may end in *FACTOR."""
    unit: Annotated[str | None, Flag("--unit", "m|cm|mm|in|ft", "Unit of lengths.")] = None
    """One of UNITS."""
    up: Annotated[Axis | None, Flag("--up", None, "Vertical axis of the source; it is rotated to z.")] = None
    clock: Annotated[Clock, Flag("--clock", None, "Which time stamps of a bag.")] = Clock.AUTO
    rate: Annotated[float | None, Flag("--rate", "HZ", "Frame rate of a source without times.")] = None
    """Frames a second."""
    base: Annotated[str | None, Flag("--base", "FRAME", "Robot frame in the static transforms of a bag.")] = None
    """Coordinate frame of the static transforms: poses of cameras are taken from them."""
    shifts: Annotated[
        Mapping[str, float], Flag("--shift", "CAMERA=S", "Seconds to add to a camera's times.", read=shifts_named)
    ] = field(default_factory=dict)
    """Camera → seconds, where clocks differ."""
    depth_unit: Annotated[
        float | None, Flag("--depth-unit", "M", "Metres per unit of integer depth images, if not that of the source.")
    ] = None
    every: Annotated[int, Flag("--every", "N", "Import every N-th frame.", min=1)] = 1
    free: Annotated[
        Sequence[tuple[float, float]],
        Flag("--free", "FROM:TO", "Contact-free interval, in seconds after the first frame.", read=free_named),
    ] = ()
    """From and to [s]."""
    log_names: Sequence[str] = ()
    """Columns of a separate actuation log, for messages."""
