"""Decisions before the frames of a bag are read: columns, clock, loads, poses of markers."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.importers.frames import unit_of
from femsense.io.importers.options import Clock, Options
from femsense.io.importers.ros.bag import Bag, Message
from femsense.io.importers.ros.messages import header_of, markers_of, sdk_values, stamp_of
from femsense.io.importers.ros.topics import Choice, Stream, transform_between, transforms_of
from femsense.io.importers.several import camera_names
from femsense.io.importers.tables.mapping import Becomes, Target, kind_of_target, parse_target

LAG_S = 0.5
"""A message is written at most this much later than others of its moment."""
PEEKED = 50
"""Number of first messages that decide whether the header stamps of a topic are a clock."""

SCANNED = 5000
"""Number of first messages of motors that decide which of their fields is used."""


class Stamps(StrEnum):
    """Which time stamps are taken."""

    HEADER = "header"
    RECORD = "record"
    METADATA = "metadata"
    """Of the device, as the RealSense SDK keeps them next to images."""


@dataclass(frozen=True, slots=True)
class Taken:
    """A value of a message that becomes an input."""

    field: str
    """"position", "effort", "velocity", or "" where the message has one field only."""
    target: Target
    """Its name is the column of frames.csv."""


@dataclass(frozen=True, eq=False, slots=True)
class Plan:
    """Mapping of the messages of a bag to frames."""

    choice: Choice
    clock: Stamps
    actuation: str | None
    columns: dict[str, dict[str, Taken]]
    """Topic → name of a value → its target."""
    load_points: dict[str, list[float]]
    T_camera_markers: dict[str, FloatArray]
    metadata: dict[str, str]
    """Topic of a stream's metadata → its images, where the SDK keeps the device's times there."""
    up: str | None
    notes: tuple[str, ...]
    marker_names: dict[str, str]
    """Name of a marker, or topic of one without a name → its name in the recording."""
    scale: float | None
    """Metres in one unit of clouds, markers and depth in floating point; None where no option gives it: metres."""
    names: dict[str, tuple[Becomes, ...]]
    """Name that `--map` accepts → its allowed targets."""


def plan_of(bag: Bag, choice: Choice, options: Options, clock: Stamps) -> Plan:
    """Return the reading plan of a bag: streams, columns, clock."""
    notes = list(choice.notes)
    names = _mappable(bag, choice, options)
    pressures = [s.topic.name for s in choice.inputs if _is_pressure(s)]
    own = dict(zip(pressures, camera_names(pressures))) if len(pressures) > 1 else {}
    columns = {s.topic.name: _input_columns(bag, s, options, own.get(s.topic.name, "")) for s in choice.inputs}
    notes += _notes_of_twice(columns) + _notes_of_units(columns)
    fields = {one.field for values in columns.values() for one in values.values()} - {""}
    actuation = {frozenset({"effort"}): "tension", frozenset({"position"}): "displacement"}.get(frozenset(fields))
    points = {}
    for stream in choice.loads:
        target = options.columns.get(stream.topic.name, "")
        if target.startswith("load@"):
            points[stream.topic.name] = _load_point(target)
            notes.append(f"the forces of {stream.topic.name} (frame {stream.frame or '–'}) are taken in the robot's axes")
        else:
            notes.append(
                f"the wrenches of {stream.topic.name} are left out: --map {stream.topic.name}=load@X,Y,Z states where they act"
            )
    poses = _marker_poses(bag, choice, notes)
    used = [s for s in choice.markers if s.topic.name in poses]
    choice = replace(choice, markers=tuple(used), loads=tuple(s for s in choice.loads if s.topic.name in points))
    renamed = {old: new.removeprefix("marker.") for old, new in options.columns.items() if new.startswith("marker.")}
    scale = None if options.unit is None else unit_of(options, None, bag.path, 0.0)
    return Plan(
        choice,
        clock,
        actuation,
        columns,
        points,
        poses,
        _metadata(bag, choice, clock),
        options.up,
        tuple(notes),
        renamed,
        scale,
        names,
    )


def _notes_of_twice(columns: dict[str, dict[str, Taken]]) -> list[str]:
    """Return a note for each input that several topics hold."""
    topics: dict[str, list[str]] = {}
    for topic, values in columns.items():
        for one in values.values():
            topics.setdefault(one.target.name, []).append(topic)
    return [
        f"{column} stands in {' and '.join(held)}: that of {held[-1]} is taken; --map {held[0]}.NAME={column} takes another's"
        for column, held in topics.items()
        if len(held) > 1
    ]


FIELDS = {
    "effort": "effort, which is N or N m by its message, is taken as newtons",
    "position": "position, which is m or rad by its message, is taken as metres",
    "velocity": "velocity is taken as it is",
    "": "values without a unit are taken as they are, in newtons or metres",
}
PRESSURES = "pressures are taken as pascals above the surroundings; FluidPressure is absolute by its definition"


def _notes_of_units(columns: dict[str, dict[str, Taken]]) -> list[str]:
    """Return the assumptions about inputs whose unit is not declared."""
    notes = []
    for topic, values in columns.items():
        for field in FIELDS:
            names = [one.target.name for one in values.values() if one.field == field and not one.target.scaled]
            if names and names[0].startswith("chamber_"):
                notes.append(f"{topic} → {', '.join(names)}: {PRESSURES}: --map NAME={names[0]}*Pa_abs makes them relative")
            elif names:
                begin = f"{topic} → {', '.join(names)}: {FIELDS[field]}"
                notes.append(f"{begin}; motors count ticks, radians or milliampere: --map NAME={names[0]}*FACTOR")
    return notes


def _mappable(bag: Bag, choice: Choice, options: Options) -> dict[str, tuple[Becomes, ...]]:
    """Return the names that `--map` may take; those of markers are sought in the messages where one is not known otherwise."""
    names: dict[str, tuple[Becomes, ...]] = dict.fromkeys((s.topic.name for s in choice.loads), (Becomes.LOAD,))
    names |= dict.fromkeys((s.topic.name for s in choice.markers), (Becomes.MARKER,))
    for stream in choice.inputs if options.columns else ():
        for name, fld in _largest_values(bag, stream):
            whole = (stream.topic.name,) if _is_pressure(stream) else ()
            names |= dict.fromkeys(
                (name, *whole, f"{stream.topic.name}.{name}", *([f"{name}.{fld}"] if fld else [])), (Becomes.INPUT,)
            )
    for stream in choice.markers:
        for message in bag.messages([stream.topic.name]):
            if set(options.columns) <= set(names):
                break
            with contextlib.suppress(InputError):
                found = markers_of(bag.decode(message), stream.topic.type)
                names |= {label: (Becomes.MARKER,) for label, _ in found if label and label not in names}
    return names


def _is_pressure(stream: Stream) -> bool:
    """Whether a topic holds one pressure, which its own name names."""
    return stream.topic.type.endswith("FluidPressure")


def _input_columns(bag: Bag, stream: Stream, options: Options, own: str) -> dict[str, Taken]:
    """Return name in the message → target; `own` is the name of a pressure if several topics contain one."""
    topic = stream.topic.name
    given = _largest_values(bag, stream)
    names = list(dict.fromkeys(name for name, _ in given))
    columns: dict[str, Taken] = {}
    for name in names:
        available = [fld for n, fld in given if n == name]
        usual = next(
            (fld for fld in ("effort", "position", "") if fld in available and (fld != "effort" or given[name, fld] != 0.0)),
            available[0],
        )
        for key in (
            *([topic] if _is_pressure(stream) else []),
            f"{name}.{usual}",
            name,
            f"{topic}.{name}",
            *(f"{name}.{fld}" for fld in available),
        ):
            if key in options.columns:
                fld = key.rpartition(".")[2] if key.rpartition(".")[2] in available else usual
                columns[name] = Taken(fld, parse_target(options.columns[key]))
    if not columns and not any(key in options.columns for key in names):
        targets = {parse_target(new).name for new in options.columns.values() if kind_of_target(new) is Becomes.INPUT}
        prefix = "chamber_" if _is_pressure(stream) else "cable_"
        for name in names:
            usual = "effort" if any(given.get((n, "effort"), 0.0) for n in names) else "position"
            fld = usual if (name, usual) in given else next(f for n, f in given if n == name)
            column = name if name.startswith(("cable_", "chamber_")) else prefix + (own or name)
            if column not in targets:  # --map takes another topic's for it
                columns[name] = Taken(fld, Target(column))
    return columns


def _largest_values(bag: Bag, stream: Stream) -> dict[tuple[str, str], float]:
    """Return (name, field) → the largest magnitude in the first messages: efforts are often zero until something moves."""
    largest: dict[tuple[str, str], float] = {}
    for message, _ in zip(bag.messages([stream.topic.name]), range(SCANNED)):
        try:
            values = named_values(bag.decode(message), stream.topic.type)
        except InputError:
            continue  # reported when the frames are read
        for key, value in values.items():
            largest[key] = max(largest.get(key, 0.0), abs(value))
    return largest


def _load_point(target: str) -> list[float]:
    try:
        values = [float(part) for part in target.removeprefix("load@").split(",")]
    except ValueError:
        values = []
    if len(values) != 3:
        raise InputError(
            "not a place of a load", where="--map", found=target, expected="load@X,Y,Z: metres on the body at rest, robot frame"
        )
    return values


def _marker_poses(bag: Bag, choice: Choice, notes: list[str]) -> dict[str, FloatArray]:
    """Return T_camera_markers of the topics of markers that can be had in the camera's frame."""
    target, poses = choice.primary.frame, {}
    tree = transforms_of(bag) if choice.markers else {}
    for stream in choice.markers:
        T = np.eye(4) if stream.frame == target else transform_between(tree, target, stream.frame)
        if T is None:
            notes.append(
                f"the markers of {stream.topic.name} are left out: no static transform joins {stream.frame!r} and {target!r}"
            )
        else:
            poses[stream.topic.name] = T
    return poses


def clock_of(bag: Bag, choice: Choice, options: Options) -> Stamps:
    """Return whose time stamps are used.

    METADATA where the RealSense SDK keeps the device's time there; HEADER where the stamps of all streams with a header go on like
    the time of recording (those of the SDK may count from elsewhere); else RECORD.
    """
    if options.clock != Clock.AUTO:
        return Stamps(options.clock)
    sdk = is_sdk(choice.primary.topic.name)
    if sdk and _metadata(bag, choice, Stamps.METADATA):
        return Stamps.METADATA
    for stream in chosen_streams(choice):
        shifts, last = [], -np.inf
        for message, _ in zip(bag.messages([stream.topic.name]), range(PEEKED)):
            try:
                decoded = bag.decode(message)
            except InputError:
                continue  # reported when the frames are read
            if header_of(decoded) is None:
                continue
            time, _ = stamp_of(decoded)
            if time <= 0.0 or time < last:
                return Stamps.RECORD
            last = time
            shifts.append(message.record - time)
        if shifts and not sdk and (np.ptp(shifts) > LAG_S or abs(float(np.median(shifts))) > LAG_S):
            return Stamps.RECORD
    return Stamps.HEADER


def _metadata(bag: Bag, choice: Choice, clock: Stamps) -> dict[str, str]:
    """Return topic of metadata → topic of images where the first of them holds a time of the device."""
    if clock is not Stamps.METADATA:
        return {}
    names = {t.name: t.type for t in bag.topics}
    pictures = [s.topic.name for s in (choice.primary, choice.color) if s is not None]
    found = {f"{name.split('/image/')[0]}/image/metadata": name for name in pictures}
    texts = all(names.get(topic) == "std_msgs/msg/String" for topic in found)
    return found if texts and all(device_time(bag.first([topic])) is not None for topic in found) else {}


def device_time(decoded: Any) -> float | None:
    """Return the device's time [s] in the text of an image's metadata; None where it holds none."""
    parts = sdk_values(decoded)
    return 1e-3 * float(parts["timestamp"]) if "timestamp" in parts else None


def time_of(bag: Bag, plan: Plan, message: Message, decoded: Any = None) -> float:
    """Return the time of a message [s] on the chosen clock: of its header, where it has one, else of its recording."""
    if plan.clock is not Stamps.HEADER:
        return message.record
    time, _ = stamp_of(bag.decode(message) if decoded is None else decoded)
    return time if time > 0.0 else message.record


def chosen_streams(choice: Choice) -> list[Stream]:
    """Return the streams that are read, each once."""
    chosen = [choice.primary, *choice.markers, *choice.inputs, *choice.loads]
    chosen += [choice.color] if choice.color is not None else []
    return list({s.topic.name: s for s in chosen}.values())


def is_sdk(name: str) -> bool:
    """Return whether a topic is of a file of the RealSense SDK."""
    return name.startswith("/device_") and "/sensor_" in name


def named_values(decoded: Any, kind: str) -> dict[tuple[str, str], float]:
    """Return (name, field) → value of a message of inputs."""
    if kind.endswith("FluidPressure"):
        return {("pressure", ""): float(decoded.fluid_pressure)}
    if not kind.endswith("JointState"):
        return {(str(i), ""): float(value) for i, value in enumerate(decoded.data)}
    return {
        (name, fld): float(values[i])
        for fld in ("position", "velocity", "effort")
        for values in [getattr(decoded, fld)]
        for i, name in enumerate(decoded.name)
        if i < len(values)
    }
