"""Readings of sensors with the markers that were seen at the same moments."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.xr.proprioception.memory import with_memory

ROBOT, AS_MEASURED = "robot", "markers"
"""Frames of reference: the robot's, or that in which the markers were measured, a camera's for instance."""
WORDS = {ROBOT: "the robot's frame", AS_MEASURED: "the frame in which markers were measured"}


@dataclass(frozen=True, eq=False, slots=True)
class Labelled:
    """Rows of readings, in order of time, each with all markers."""

    time_s: FloatArray
    """shape (n,)."""
    readings: FloatArray
    """In the units of the sensors, shape (n, c)."""
    markers: FloatArray
    """[m], shape (n, m, 3)."""
    channels: tuple[str, ...]
    marker_names: tuple[str, ...]
    part: IntArray
    """Which recording each row is from, shape (n,)."""
    frame: str = AS_MEASURED
    """Of reference: `ROBOT` or `AS_MEASURED`."""

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def targets(self) -> FloatArray:
        """Coordinates of the markers [m], shape (n, 3 m)."""
        return self.markers.reshape(len(self), -1)

    def select(self, rows: npt.NDArray[np.bool_] | IntArray) -> Labelled:
        """Return some of the rows."""
        t, x, y = freeze(self.time_s[rows]), freeze(self.readings[rows]), freeze(self.markers[rows])
        return Labelled(t, x, y, self.channels, self.marker_names, freeze(self.part[rows], np.int64), self.frame)

    def inputs(self, taus: tuple[float, ...]) -> FloatArray:
        """Return readings with their filters, shape (n, (1 + k) c); filters start anew with each recording."""
        parts = [self.part == number for number in np.unique(self.part)]
        return np.concatenate([with_memory(self.time_s[rows], self.readings[rows], taus) for rows in parts])


def labelled(
    time_s: npt.ArrayLike,
    readings: npt.ArrayLike,
    markers: npt.ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    marker_names: Sequence[str] | None = None,
    frame: str = AS_MEASURED,
) -> Labelled:
    """Return readings with markers from arrays; rows without a finite marker or reading are left out.

    Arguments:
        time_s: when each row was read [s], not decreasing, shape (n,).
        readings: shape (n, c).
        markers: [m], shape (n, m, 3).
        channels, marker_names: names; numbers by default.
        frame: of the markers: "robot", or "markers" for any other that stays fixed to the base.

    Raises:
        InputError: shapes that do not belong together, times that decrease, or an unknown frame.
    """
    t, x, y = (np.asarray(array, dtype=np.float64) for array in (time_s, readings, markers))
    if t.ndim != 1 or x.ndim != 2 or y.ndim != 3 or y.shape[2] != 3 or not len(t) == len(x) == len(y):
        expected = "(n,), (n, channels), (n, markers, 3)"
        raise InputError(
            "arrays that do not belong together",
            where="time_s, readings, markers",
            found=(t.shape, x.shape, y.shape),
            expected=expected,
        )
    if not (np.diff(t) >= 0).all():
        row = int(np.argmin(np.diff(t))) + 1
        raise InputError(
            "time runs backwards", where=f"time_s[{row}]", found=float(t[row]), expected=f"at least {t[row - 1]:.6g}"
        )
    if frame not in (ROBOT, AS_MEASURED):
        raise InputError("unknown frame of reference", where="frame", found=frame, expected=f"{ROBOT} | {AS_MEASURED}")
    good = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=(1, 2)) & np.isfinite(t)
    names = tuple(channels) if channels is not None else tuple(f"channel_{i}" for i in range(x.shape[1]))
    points = tuple(marker_names) if marker_names is not None else tuple(f"marker_{i}" for i in range(y.shape[1]))
    if len(names) != x.shape[1] or len(points) != y.shape[1]:
        raise InputError(
            "one name a column",
            where="channels, marker_names",
            found=(len(names), len(points)),
            expected=x.shape[1:] + y.shape[1:2],
        )
    _say_what_is_left_out(good, x, names)
    part = freeze(np.zeros(good.sum()), np.int64)
    return Labelled(freeze(t[good]), freeze(x[good]), freeze(y[good]), names, points, part, frame)


def _say_what_is_left_out(good: npt.NDArray[np.bool_], x: FloatArray, channels: Sequence[str]) -> None:
    """Warn of rows that are left out, with the channels that have no number there; the others lack a marker."""
    if good.all():
        return
    empty = {name: int(count) for name, count in zip(channels, (~np.isfinite(x)).sum(axis=0)) if count}
    by = "; ".join(f"{name} has no number in {count}" for name, count in empty.items()) or "a marker is hidden there"
    warnings.warn(f"{int((~good).sum())} of {len(good)} rows are left out: {by}", stacklevel=3)


def joined(parts: Sequence[Labelled]) -> Labelled:
    """Return several recordings as one. Raises InputError where channels, markers or frames differ."""
    first = parts[0]
    for other in parts[1:]:
        if (other.channels, other.marker_names) != (first.channels, first.marker_names):
            found, expected = (*other.channels, *other.marker_names), (*first.channels, *first.marker_names)
            raise InputError("recordings of other channels or markers", where="parts", found=found, expected=expected)
        check_frame(first.frame, other.frame)
    t, x, y = (freeze(np.concatenate([getattr(part, name) for part in parts])) for name in ("time_s", "readings", "markers"))
    number = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return Labelled(t, x, y, first.channels, first.marker_names, freeze(number, np.int64), first.frame)


def check_frame(known: str, found: str) -> None:
    """Raise InputError unless markers are in the frame of reference that is known: a motion of the base would be told for it."""
    if known != found:
        raise InputError(
            "markers in another frame of reference",
            where="markers",
            found=WORDS[found],
            expected=WORDS[known],
            hint="-c CALIBRATION takes a camera's markers into the robot's frame, --robot-frame says that they are in it",
        )
