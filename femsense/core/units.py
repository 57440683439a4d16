"""Units of measurement and their SI values. All readers of files, columns and options use this table.

Names are read in any case where that is unambiguous: `KPA` is kPa; `mPa` and `MN` are refused, because MPa and mN may be meant.
Pressures are gauge pressures unless the unit says "absolute" (`bara`, `psia`, `kPa abs`): chambers take the pressure above the surroundings.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from femsense.core.errors import InputError

ATMOSPHERE_PA = 101_325.0
"""Standard atmosphere [Pa], subtracted from absolute pressures."""


PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
"""Units that meshes and tools may have. Dividing by these rounds once: 35 mm become the same number as 0.035."""


class Quantity(StrEnum):
    """The quantity that a unit measures."""

    TIME = "time"
    LENGTH = "length"
    FORCE = "force"
    PRESSURE = "pressure"
    ANGLE = "angle"
    CURRENT = "current"
    VOLTAGE = "voltage"
    TORQUE = "torque"
    COUNT = "counts of a device"


@dataclass(frozen=True, slots=True)
class Unit:
    """One unit."""

    name: str
    """As it is usually written."""
    quantity: Quantity
    size: float
    """SI units in one of it."""
    zero: float = 0.0
    """SI value of a reading of 0: −101325 Pa where pressures are absolute."""


_TABLE: tuple[tuple[Quantity, float, tuple[str, ...]], ...] = (
    (Quantity.TIME, 1.0, ("s", "sec", "secs", "second", "seconds")),
    (Quantity.TIME, 1e-3, ("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds")),
    (Quantity.TIME, 1e-6, ("µs", "us", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds")),
    (Quantity.TIME, 1e-9, ("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds")),
    (Quantity.TIME, 60.0, ("min", "mins", "minute", "minutes")),
    (Quantity.TIME, 3600.0, ("h", "hr", "hrs", "hour", "hours")),
    (Quantity.TIME, 86400.0, ("d", "day", "days")),
    (Quantity.LENGTH, 1.0, ("m", "metre", "metres", "meter", "meters")),
    (Quantity.LENGTH, 1e-1, ("dm", "decimetre", "decimeter", "decimetres", "decimeters")),
    (Quantity.LENGTH, 1e-2, ("cm", "centimetre", "centimetres", "centimeter", "centimeters")),
    (Quantity.LENGTH, 1e-3, ("mm", "millimetre", "millimetres", "millimeter", "millimeters")),
    (Quantity.LENGTH, 1e-6, ("µm", "um", "micron", "microns", "micrometre", "micrometres", "micrometer", "micrometers")),
    (Quantity.LENGTH, 0.0254, ("in", "inch", "inches")),
    (Quantity.LENGTH, 0.3048, ("ft", "foot", "feet")),
    (Quantity.FORCE, 1.0, ("N", "newton", "newtons")),
    (Quantity.FORCE, 1e-3, ("mN", "millinewton", "millinewtons")),
    (Quantity.FORCE, 1e3, ("kN", "kilonewton", "kilonewtons")),
    (Quantity.FORCE, 9.80665e-3, ("gf", "g", "gram", "grams", "gram-force", "pond")),
    (Quantity.FORCE, 9.80665, ("kgf", "kg", "kilogram", "kilograms", "kp")),
    (Quantity.FORCE, 4.4482216152605, ("lbf", "lb", "lbs", "pound", "pounds")),
    (Quantity.FORCE, 0.27801385095378125, ("ozf", "oz", "ounce", "ounces")),
    (Quantity.PRESSURE, 1.0, ("Pa", "pascal", "pascals", "N/m2")),
    (Quantity.PRESSURE, 1e2, ("hPa", "hectopascal")),
    (Quantity.PRESSURE, 1e2, ("mbar", "millibar", "millibars")),
    (Quantity.PRESSURE, 1e3, ("kPa", "kilopascal", "kilopascals")),
    (Quantity.PRESSURE, 1e6, ("MPa", "megapascal", "megapascals", "N/mm2")),
    (Quantity.PRESSURE, 1e5, ("bar", "bars")),
    (Quantity.PRESSURE, 6894.757293168, ("psi", "lbf/in2", "lb/in2")),
    (Quantity.PRESSURE, 133.322387415, ("mmHg", "torr")),
    (Quantity.PRESSURE, 3386.389, ("inHg",)),
    (Quantity.PRESSURE, 98.0665, ("cmH2O",)),
    (Quantity.PRESSURE, 9.80665, ("mmH2O",)),
    (Quantity.PRESSURE, 249.08891, ("inH2O",)),
    (Quantity.PRESSURE, 98066.5, ("kgf/cm2", "kg/cm2")),
    (Quantity.PRESSURE, ATMOSPHERE_PA, ("atm", "atmosphere", "atmospheres")),
    (Quantity.ANGLE, 1.0, ("rad", "radian", "radians")),
    (Quantity.ANGLE, math.pi / 180.0, ("deg", "°", "degree", "degrees")),
    (Quantity.ANGLE, 2.0 * math.pi, ("rev", "revs", "revolutions", "turns")),
    (Quantity.CURRENT, 1.0, ("A", "amp", "amps", "ampere", "amperes")),
    (Quantity.CURRENT, 1e-3, ("mA", "milliamp", "milliamps", "milliampere", "milliamperes")),
    (Quantity.VOLTAGE, 1.0, ("V", "volt", "volts")),
    (Quantity.VOLTAGE, 1e-3, ("mV", "millivolt", "millivolts")),
    (Quantity.TORQUE, 1.0, ("Nm", "N·m", "N*m")),
    (Quantity.TORQUE, 1e-3, ("mNm", "Nmm")),
    (Quantity.COUNT, 1.0, ("ticks", "tick", "counts", "count", "pulses", "steps", "adc", "raw")),
    (Quantity.COUNT, 1.0, ("%", "percent")),
)
_EXACT = {name: Unit(names[0], quantity, size) for quantity, size, names in _TABLE for name in names}
_FOLDED = {name.casefold(): unit for name, unit in _EXACT.items()}
_AMBIGUOUS = {"mPa": "MPa or Pa", "MN": "mN or N", "Mbar": "mbar or bar"}
"""Spelt with care these are millipascal, meganewton and megabar, which no robot has."""
_REFERENCE = re.compile(r"(.+?)[\s_.(-]*(a|abs|absolute|g|ga|gauge|rel|relative)\)?", re.IGNORECASE)
_CAN_BE_ABSOLUTE = ("Pa", "hPa", "kPa", "MPa", "mbar", "bar", "psi", "mmHg", "inHg", "atm", "kgf/cm2")


def unit_named(text: str) -> Unit | None:
    """Return the unit that a text names; None where it names none.

    Raises:
        InputError: a name of which case decides between units that are a million apart.
    """
    name = " ".join(unicodedata.normalize("NFKC", text).split()).strip("[]().,;: ").replace("μ", "µ").replace("^", "")
    if name in _AMBIGUOUS:
        raise InputError("a unit that can be read in two ways", where="unit", found=name, expected=_AMBIGUOUS[name])
    plain = _EXACT.get(name) or _FOLDED.get(name.casefold())
    if plain is not None:
        return plain
    match = _REFERENCE.fullmatch(name)
    base = _FOLDED.get(match[1].strip().casefold()) if match else None
    if match is None or base is None or base.name not in _CAN_BE_ABSOLUTE:
        return None
    absolute = match[2].lower().startswith("a")
    return Unit(
        f"{base.name} {'absolute' if absolute else 'gauge'}", base.quantity, base.size, -ATMOSPHERE_PA if absolute else 0.0
    )


def length_unit(text: str, *, allowed: Iterable[str] = ()) -> Unit | None:
    """Return the unit of length that a text names in any spelling, one of `allowed` where that is given; None for all else."""
    unit = unit_named(text)
    known = tuple(allowed)
    fits = unit is not None and unit.quantity is Quantity.LENGTH and (not known or unit.name in known)
    return unit if fits else None


def units_of(*quantities: Quantity) -> tuple[str, ...]:
    """Return the usual names of the units of some quantities, for messages."""
    return tuple(names[0] for quantity, _, names in _TABLE if quantity in quantities)


def likely_units(value: float, low: float, high: float, quantity: Quantity) -> list[Unit]:
    """Return the units in which a reading would lie between two SI values, the nearest to their geometric mean first."""
    middle = math.sqrt(low * high)
    common = [_EXACT[name] for name in _COMMON[quantity]]
    fits = [unit for unit in common if low <= abs(value) * unit.size <= high and unit.size != 1.0]
    return sorted(fits, key=lambda unit: abs(math.log(abs(value) * unit.size / middle)))


_COMMON = {
    Quantity.TIME: ("ms", "µs", "ns", "min", "h", "d"),
    Quantity.LENGTH: ("mm", "cm", "in", "µm"),
    Quantity.FORCE: ("mN", "kN", "g", "kg", "lb"),
    Quantity.PRESSURE: ("kPa", "bar", "psi", "MPa", "mbar"),
}
