"""Times as devices and spreadsheets count them, made seconds that go on: units, days, counters that wrap."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.units import Unit

SINCE_1970 = ((1e17, 1e-9, "nanoseconds"), (1e14, 1e-6, "microseconds"), (1e11, 1e-3, "milliseconds"))
"""A time without a unit that is as large as this cannot be seconds (10¹¹ s is the year 5138): seconds in one unit of it."""
DAY_S = 86_400.0
NO_CAMERA_S = 2e-5
"""Nothing that femsense reads comes in shorter steps [s]: times without a unit that do are days of a spreadsheet."""
COUNTERS = {2.0**k: f"a counter of {k} bits" for k in (16, 24, 31, 32)}
"""Where counters of devices begin again, in their own unit."""
CLOCKS = {60.0: "a minute", 3600.0: "an hour", 0.5 * DAY_S: "twelve hours", DAY_S: "midnight"}
"""Where times of day begin again [s]."""
AFTER_WRAP = 8.0
"""After an overflow is undone, the step is at most this multiple of the usual one."""


def seconds_of(values: FloatArray, unit: Unit | None) -> tuple[FloatArray, list[str]]:
    """Return times in seconds, and the assumptions made.

    Arguments:
        values: as the file has them, in order of its rows, NaN where one is missing, shape (n,).
        unit: declared in the file; None without one.
    """
    scale, notes = (unit.size, []) if unit is not None else _scale(values)
    wrapped, said = _unwrapped(values, scale)
    return scale * wrapped, notes + said


def _scale(values: FloatArray) -> tuple[float, list[str]]:
    """Return the seconds per unit of times without a declared unit."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 1.0, []
    for least, size, name in SINCE_1970:
        if known[0] > least:
            return size, [f"times of this size are {name} since 1970"]
    steps = np.diff(known)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if 0.0 < step < NO_CAMERA_S and DAY_S * step > NO_CAMERA_S and known.max() < 1e5:
        text = f"times that go on by {step:.3g} are days of a spreadsheet: a row every {DAY_S * step:.4g} s"
        return DAY_S, [f"{text}; --map NAME=time*1 where they are seconds"]
    return 1.0, []


def _unwrapped(values: FloatArray, scale: float) -> tuple[FloatArray, list[str]]:
    """Return the times with overflows of a counter or clock undone, and notes about it."""
    known = np.flatnonzero(np.isfinite(values))
    steps = np.diff(values[known])
    if not (steps > 0).any():
        return values, []
    usual = float(np.median(steps[steps > 0]))
    periods = {**COUNTERS, **{period / scale: name for period, name in CLOCKS.items()}}
    added, notes = np.zeros(len(values)), []
    for k in np.flatnonzero(steps < -AFTER_WRAP * usual):
        period = min(periods, key=lambda p: abs(steps[k] + p - usual))
        if 0.0 < steps[k] + period <= AFTER_WRAP * usual:
            added[known[k + 1] :] += period
            notes.append(f"the time begins again at row {known[k + 1] + 1}: {periods[period]} overflowed, which is undone")
    return values + added, notes
