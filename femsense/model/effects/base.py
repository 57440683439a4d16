"""What an effect is: a name, parameters with units and bounds, and how it changes a robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from femsense.core.errors import InputError
from femsense.model.robot import Robot

Entry = dict[str, Any]
"""One table of `[[effects]]`, without its name."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """One number of an effect, as the fit sees it."""

    key: str
    """The key in robot.toml."""
    part: int | str | tuple[str, int] | None
    """Component of a vector, name of a cable, (marker, component), or None for a single number."""
    unit: str
    null: float
    """The fit's coordinate at which the effect vanishes."""
    low: float
    """Lowest plausible value of the coordinate."""
    high: float
    """Highest plausible value of the coordinate."""
    step: float
    """Step for derivatives; small against what matters."""
    scale: str = "linear"
    """How the coordinate u gives the value: "linear" (u), "log" (exp u) or "reciprocal" (1/u)."""
    known: float = float("inf")
    """Standard deviation to which the coordinate is known to be at `null` beforehand."""

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
        if isinstance(self.part, tuple):
            return f"{self.key}[{self.part[0]}][{self.part[1]}]"
        return self.key if self.part is None else f"{self.key}[{self.part}]"


@dataclass(frozen=True, slots=True)
class Effect:
    """A named thing that a plain model may lack."""

    name: str
    lacks: str
    """What the plain model lacks, in a few words."""
    parameters: Callable[[Robot, str], tuple[Parameter, ...]]
    """(robot, control) → the parameters that a fit moves; control is "tension" or "displacement". Empty: cannot act here."""
    apply: Callable[[Robot, Entry], Robot]
    """(robot, entry) → the robot with the effect. Raises InputError where the entry does not fit the robot."""
    seeds: Callable[[Robot], Sequence[Entry]] = lambda robot: ({},)
    """(robot) → starting points for what is not in `parameters` (places, radii); each is tried."""
    keys: tuple[str, ...] = ()
    """All keys that an entry may have."""
    history: bool = False
    """Whether the state depends on what was before."""
    discrete: bool = False
    """Whether a seed changes the model by itself, by no small amount: it is then tried as a whole. Its parameters, if it has any,
    start at their `null`, which is a plausible value and leaves no plain model."""
    polish: Callable[[Robot, str, Entry], tuple[Parameter, ...]] = lambda robot, control, seed: ()
    """(robot, control, seed) → what the seed holds still while effects are compared and a joint fit may move after that; `null`
    is the seed's own value."""
    nearby: Callable[[Robot, Entry], Sequence[Entry]] = lambda robot, seed: ()
    """(robot, seed) → seeds between this one and its neighbours; tried once this one is known to be the best."""


def build_entry(parameters: Sequence[Parameter], coordinates: Sequence[float], seed: Mapping[str, Any]) -> Entry:
    """Return the table of `[[effects]]` for coordinates of the fit."""
    fitted = {p.key for p in parameters}
    entry: Entry = {key: value for key, value in seed.items() if key not in fitted}
    for parameter, coordinate in zip(parameters, coordinates):
        value = parameter.value(float(coordinate))
        if parameter.part is None:
            entry[parameter.key] = value
        elif isinstance(parameter.part, int):
            entry.setdefault(parameter.key, []).append(value)
        elif isinstance(parameter.part, tuple):
            entry.setdefault(parameter.key, {}).setdefault(parameter.part[0], []).append(value)
        else:
            entry.setdefault(parameter.key, {})[parameter.part] = value
    return entry


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
    names = robot.body.cable_names
    value = entry.get(key, default)
    if not isinstance(value, Mapping):
        return np.full(len(names), number({key: value}, key, where))
    unknown = sorted(set(value) - set(names))
    if unknown:
        raise InputError("unknown cable", where=f"{where}.{key}", found=unknown[0], expected=", ".join(names))
    return np.array([number(dict(value), name, f"{where}.{key}", default=default) for name in names])
