"""The types of an effect: a name, parameters with units and bounds, and a function that changes a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import InputError
from femsense.model.robot import Robot

Entry = dict[str, Any]
"""One table of `[[effects]]`, without its name."""


@dataclass(frozen=True, slots=True)
class KnownLength:
    """Prior on the length of a vector."""

    value: float
    """In the unit of its components."""
    std: float
    """Its standard deviation, in the same unit."""


@dataclass(frozen=True, slots=True)
class InRecording:
    """The part of a parameter that a recording has for itself."""

    part: int | str | tuple[str, int] | None
    """As of `Parameter.part`."""
    recording: str
    """Label of the recording or its session."""
    labels: tuple[str, ...] = field(default=(), compare=False)
    """Labels of all recordings: where one has no parameter of its own, the effect is absent."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect, as the fit sees it."""

    key: str
    """The key in robot.toml."""
    part: int | str | tuple[str, int] | InRecording | None
    """Component of a vector, name of a cable, (marker, component), or None for a single number; any of them in one recording."""
    unit: str
    null: float
    """The fit's coordinate at which the effect vanishes."""
    low: float
    """Lowest plausible value of the coordinate."""
    high: float
    """Highest plausible value of the coordinate."""
    step: float
    """Step of finite differences, small against relevant changes."""
    scale: str = "linear"
    """How the coordinate u gives the value: "linear" (u), "log" (exp u) or "reciprocal" (1/u)."""
    known: float = float("inf")
    """Standard deviation to which the coordinate is known to be at `null` beforehand."""
    plausible: float | None = None
    """Usual size of its distance from `null`, in the coordinate; None: `USUAL` of the range between the bounds."""
    of_range: bool = False
    """Whether `plausible` and the prior of calibration are relative to the range of the input of its cable."""
    length: KnownLength | None = None
    """Prior on the length of the vector of which it is a component."""

    @property
    def usual_size(self) -> float:
        """Return the plausible distance from `null`, in the coordinate; a share of the cable's range where it is `of_range`."""
        return USUAL * (self.high - self.low) if self.plausible is None else self.plausible

    def value(self, coordinate: float) -> float:
        """Return the value in robot.toml's unit."""
        if self.scale == "log":
            return float(np.exp(coordinate))
        if self.scale == "reciprocal":
            return float(1.0 / coordinate) if coordinate > 0 else float("inf")
        return float(coordinate)

    def coordinate(self, value: float) -> float:
        """Return the fit's coordinate of a value."""
        if self.scale == "log":
            return float(np.log(value))
        if self.scale == "reciprocal":
            return 0.0 if np.isinf(value) else 1.0 / value
        return float(value)

    def value_std(self, coordinate: float, std: float) -> float:
        """Return the standard deviation of the value (first order)."""
        if self.scale == "log":
            return float(np.exp(coordinate) * std)
        if self.scale == "reciprocal":
            return float(std / coordinate**2) if coordinate > 0 else float("inf")
        return float(std)

    @property
    def label(self) -> str:
        return self.key + "".join(f"[{step}]" for step in path_of(self.part))


def path_of(part: int | str | tuple[str, int] | InRecording | None) -> tuple[str | int, ...]:
    """Return the keys and numbers that lead from a key of an entry to the value of a part; components of a vector come last."""
    if isinstance(part, InRecording):
        own = path_of(part.part)
        at = len(own) - 1 if own and isinstance(own[-1], int) else len(own)
        return (*own[:at], part.recording, *own[at:])
    if part is None:
        return ()
    return part if isinstance(part, tuple) else (part,)


def part_in(parameter: Parameter, label: str) -> int | str | tuple[str, int] | None:
    """Return the part of a parameter as it is in a recording with this label; None where it belongs to another."""
    part = parameter.part
    if not isinstance(part, InRecording):
        return part
    return part.part if part.recording == label else None


USUAL = 0.05
"""Default typical size of a parameter, as a share of the range between its bounds."""


class Experiment(Enum):
    """Experiments that distinguish an effect from others, in the order in which they are proposed."""

    TURN_THE_BASE = 1
    LOAD_UNLOAD_AND_HOLD = 2
    KNOWN_WEIGHT = 3
    MORE_MARKERS = 4
    MOVE_THE_CAMERA = 5


@dataclass(frozen=True, slots=True)
class Calibrated:
    """How an effect is fitted along with everything, as part of calibration."""

    std: float
    """Standard deviation of its coordinates beforehand, while a model is fitted to data."""
    planned_std: float
    """The same while an experiment is planned."""
    of_inputs: bool
    """Whether it is an offset of the inputs, not a property of the body. Many effects resemble it, so it is named only if the model lacks
    it; unknown initial inputs include it."""


@dataclass(frozen=True, slots=True)
class Alias:
    """An effect that another one is confused with whatever the data are."""

    name: str
    common: bool = False
    """Whether that holds for equal changes of all parameters; otherwise for mirrored ones."""
    told_by: str = ""
    """The recording that distinguishes the two, in words."""


@dataclass(frozen=True, slots=True)
class Effect:
    """A physical effect that a model may lack, such as the friction of a cable: its parameters, and how it changes a robot."""

    name: str
    lacks: str
    """Short description of the effect."""
    parameters: Callable[[Robot, str], tuple[Parameter, ...]]
    """(robot, control) → the parameters that a fit moves; control is "tension" or "displacement". Empty: cannot act here."""
    apply: Callable[[Robot, Entry], Robot]
    """(robot, entry) → the robot with the effect. Raises InputError where the entry does not fit the robot."""
    seeds: Callable[[Robot], Sequence[Entry]] = lambda robot: ({},)
    """(robot) → initial values of quantities that are not in `parameters` (places, radii); each is tried."""
    keys: tuple[str, ...] = ()
    """All keys that an entry may have."""
    path_dependent: bool = False
    """Whether the equilibrium depends on those before, so that all frames from the first on are solved."""
    discrete: bool = False
    """Whether a seed alone changes the model by a finite amount: it is then refitted without linear screening. Its parameters, if any,
    start at their `null`, a plausible value that is not the plain model."""
    polish: Callable[[Robot, str, Entry], tuple[Parameter, ...]] = lambda robot, control, seed: ()
    """(robot, control, seed) → parameters that are fixed while effects are compared and free in the joint fit afterwards; `null` is the
    seed's value."""
    nearby: Callable[[Robot, Entry], Sequence[Entry]] = lambda robot, seed: ()
    """(robot, seed) → seeds between this one and its neighbours; tried once this one is known to be the best."""
    calibrated: Calibrated | None = None
    """How it is fitted along with everything; None: it is sought."""
    aliases: tuple[Alias, ...] = ()
    """Effects with which it is confounded for any data."""
    told_by: Experiment | None = None
    """Recordings that distinguish it from others."""
    planned: Callable[[Robot], Sequence[tuple[str, Effect]]] | None = None
    """(robot) → forms for which an experiment is planned, each with the suffix of its label; None: the effect itself."""
    drives: bool = False
    """Whether it changes only the tensions of a frame, not the body."""
    remeshes: bool = False
    """Whether it changes the mesh."""
    places_markers: bool = False
    """Whether it describes the placement of single markers: rest.csv measures it, and markers are added one at a time."""
    moves_rest: bool = False
    """Whether it changes where markers are measured at rest."""
    turns_with_base: bool = False
    """Whether its columns turn with the base, as a change of gravity does."""
    expected: Callable[[Robot], bool] = lambda robot: False
    """(declared robot) → whether every such body has it, though the robot does not declare it."""
    prior_cost: Callable[[Robot, FloatArray], float] = lambda robot, coordinates: 0.0
    """(declared robot, its coordinates) → −2 log of how likely they are beforehand, 0 at best."""
    plausible: Callable[[Robot, FloatArray], bool] = lambda robot, coordinates: True
    """(declared robot, its coordinates) → whether it is accepted where another effect serves as well, or where the model error remains that
    it may make up for."""
    may_differ: bool = False
    """Whether its values may differ from recording to recording (`per = "recording"`)."""
    sought_by_recording: bool = True
    """Whether it is sought so; else it only is if robot.toml declares it."""


def no_parameters(robot: Robot, control: str) -> tuple[Parameter, ...]:
    """Return no parameters: those of an effect that its seed describes completely."""
    return ()


def known_length(parameters: Sequence[Parameter]) -> tuple[BoolArray, KnownLength] | None:
    """Return which coordinates are the components of a vector of known length, shape (p,), and that length;
    None where there is none."""
    for parameter in parameters:
        if parameter.length is not None:
            return np.array([p.length is parameter.length for p in parameters], dtype=bool), parameter.length
    return None


def range_units(parameters: Sequence[Parameter], cables: Sequence[str], ranges: FloatArray) -> FloatArray:
    """Return the unit of relative parameter sizes, shape (p,): the range of the cable's input [N] or [m], or 1."""
    return np.array([float(ranges[cables.index(str(path_of(p.part)[0]))]) if p.of_range else 1.0 for p in parameters])


def build_entry(parameters: Sequence[Parameter], coordinates: Sequence[float], seed: Mapping[str, Any]) -> Entry:
    """Return the table of `[[effects]]` for coordinates of the fit."""
    fitted = {p.key for p in parameters}
    entry: Entry = {key: value for key, value in seed.items() if key not in fitted}
    absent = absent_elsewhere(parameters)
    for parameter, coordinate in zip((*absent, *parameters), (*(p.null for p in absent), *coordinates)):
        entry[parameter.key] = placed(entry.get(parameter.key), parameter.part, parameter.value(float(coordinate)))
    return entry


def absent_elsewhere(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return the parameters of recordings in which an effect of other recordings is absent; they stay at their null."""
    given = {(p.key, p.part) for p in parameters}
    result = dict[tuple[str, Any], Parameter]()
    for p in parameters:
        own = p.part
        if not isinstance(own, InRecording):
            continue
        for label in own.labels:
            part = replace(own, recording=label)
            if (p.key, part) not in given:
                result.setdefault((p.key, part), replace(p, part=part))
    return tuple(result.values())


def placed(slot: Any, part: int | str | tuple[str, int] | InRecording | None, value: Any) -> Any:
    """Return the value of a key of an entry extended by one part; components of a vector are appended in order."""
    return _placed(slot, path_of(part), value)


def _placed(slot: Any, path: tuple[str | int, ...], value: Any) -> Any:
    if not path:
        return value
    if isinstance(path[0], int):
        return [*(slot or []), value]
    table = dict(slot or {})
    return {**table, path[0]: _placed(table.get(path[0]), path[1:], value)}


def number(
    entry: Entry, key: str, where: str, *, low: float = -np.inf, high: float = np.inf, default: float | None = None
) -> float:
    """Return a number of an entry after checking its range. Raises InputError."""
    value = entry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value) or not low <= value <= high:
        raise InputError("not a number in range", where=f"{where}.{key}", found=value, expected=f"{low:g} … {high:g}")
    return float(value)


def vector(entry: Entry, key: str, where: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return three numbers of an entry. Raises InputError."""
    value = np.asarray(entry.get(key, []), dtype=object)
    try:
        result = value.astype(np.float64)
    except (TypeError, ValueError):
        result = np.full(1, np.nan)
    if result.shape != (3,) or not np.isfinite(result).all():
        raise InputError("not a vector", where=f"{where}.{key}", found=entry.get(key), expected="three finite numbers")
    return result


def per_cable(entry: Entry, key: str, where: str, robot: Robot, default: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return one value a cable from a number or a table name → value. Raises InputError."""
    return per_name(entry, key, where, robot.body.cable_names, default, kind="cable")


def per_name(
    entry: Entry, key: str, where: str, names: Sequence[str], default: float, *, kind: str
) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return one value for each of some names (of cables, or another kind) from a number or a table name → value.

    Raises InputError.
    """
    value = entry.get(key, default)
    if not isinstance(value, Mapping):
        return np.full(len(names), number({key: value}, key, where))
    unknown = sorted(set(value) - set(names))
    if unknown:
        raise InputError(f"unknown {kind}", where=f"{where}.{key}", found=unknown[0], expected=", ".join(names))
    return np.array([number(dict(value), name, f"{where}.{key}", default=default) for name in names])
