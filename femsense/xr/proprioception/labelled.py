"""Sensor readings with the marker positions measured at the same times."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.core.errors import InputError
from femsense.xr.proprioception.memory import with_memory

ROBOT, AS_MEASURED = "robot", "markers"
"""Frames of reference: the robot's, or that in which the markers were measured, a camera's for instance."""
WORDS = {ROBOT: "the robot's frame", AS_MEASURED: "the frame in which markers were measured"}


@dataclass(frozen=True, eq=False, slots=True)
class Course:
    """All readings of one recording, in order of time, with or without markers: filters run over them."""

    time_s: FloatArray
    """shape (n,)."""
    readings: FloatArray
    """In the units of the sensors, shape (n, c)."""


@dataclass(frozen=True, eq=False, slots=True)
class Labelled:
    """Training data of `learn`: sensor readings with marker positions, in order of time."""

    courses: tuple[Course, ...]
    """Readings of each recording, with rows without markers too."""
    part: IntArray
    """Index of the recording of each row, shape (n,)."""
    row: IntArray
    """Row of that recording, shape (n,)."""
    markers: FloatArray
    """Marker positions [m], shape (n, m, 3)."""
    channels: tuple[str, ...]
    marker_names: tuple[str, ...]
    frame: str = AS_MEASURED
    """Coordinate system of the markers: `ROBOT` or `AS_MEASURED`."""

    def __len__(self) -> int:
        return len(self.row)

    @property
    def time_s(self) -> FloatArray:
        """Time of each row [s], shape (n,)."""
        return self._of([course.time_s for course in self.courses])

    @property
    def readings(self) -> FloatArray:
        """Readings of the c channels in the units of the sensors, shape (n, c)."""
        return self.inputs(())

    @property
    def spacing_s(self) -> float:
        """Median time between readings, with or without markers [s]; 0 if there are none."""
        gaps = np.concatenate([np.diff(course.time_s) for course in self.courses])
        return float(np.median(gaps)) if len(gaps) else 0.0

    @property
    def targets(self) -> FloatArray:
        """Coordinates of the markers [m], shape (n, 3 m)."""
        return self.markers.reshape(len(self), -1)

    def select(self, rows: npt.NDArray[np.bool_] | IntArray) -> Labelled:
        """Return some of the rows."""
        part, row = freeze(self.part[rows], np.int64), freeze(self.row[rows], np.int64)
        return replace(self, part=part, row=row, markers=freeze(self.markers[rows]))

    def inputs(self, taus: tuple[float, ...]) -> FloatArray:
        """Return readings with their filters, shape (n, (1 + k) c); filters restart with each recording."""
        return self._of([with_memory(course.time_s, course.readings, taus) for course in self.courses])

    def _of(self, values: Sequence[FloatArray]) -> FloatArray:
        """Return the rows' own of the values of all rows, one array a course."""
        first = np.cumsum([0, *(len(course.time_s) for course in self.courses)])
        return np.asarray(np.concatenate(values)[first[self.part] + self.row])


def labelled(
    time_s: npt.ArrayLike,
    readings: npt.ArrayLike,
    markers: npt.ArrayLike,
    *,
    channels: Sequence[str] | None = None,
    marker_names: Sequence[str] | None = None,
    frame: str = AS_MEASURED,
) -> Labelled:
    """Combine sensor readings and marker positions into training data for `learn`.

    One row holds the readings of all sensors in the body (channels) at one time, and the positions of the markers on it. Rows without a finite reading
    are left out. Rows without a finite marker are not fitted; their readings only enter the low-pass filters.

    Arguments:
        time_s: time of each of n rows [s], not decreasing, shape (n,).
        readings: readings of c sensors in their own units, shape (n, c).
        markers: positions of m markers [m], shape (n, m, 3).
        channels: names of the sensors. Default: their numbers.
        marker_names: names of the markers. Default: their numbers.
        frame: coordinates of the markers: "robot", or "markers" (default) for any others that are fixed to the base.

    Returns:
        the training data, for `learn`, `drift` and `adapt`.

    Raises:
        InputError: shapes that do not match, decreasing times, or an unknown frame.

    Example:
        >>> import numpy as np
        >>> import femsense as fs
        >>> time_s = np.arange(100) / 50.0
        >>> bend = np.sin(2.0 * time_s)[:, None]  # one sensor
        >>> tip = np.stack([0.1 * np.cos(bend), 0.0 * bend, 0.1 * np.sin(bend)], axis=2)  # one marker [m]
        >>> data = fs.labelled(time_s, bend, tip, channels=("flex",), marker_names=("tip",))
        >>> data.markers.shape
        (100, 1, 3)
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
    names = tuple(channels) if channels is not None else tuple(f"channel_{i}" for i in range(x.shape[1]))
    points = tuple(marker_names) if marker_names is not None else tuple(f"marker_{i}" for i in range(y.shape[1]))
    if len(names) != x.shape[1] or len(points) != y.shape[1]:
        raise InputError(
            "one name a column",
            where="channels, marker_names",
            found=(len(names), len(points)),
            expected=x.shape[1:] + y.shape[1:2],
        )
    read = np.isfinite(x).all(axis=1) & np.isfinite(t)
    good = read & np.isfinite(y).all(axis=(1, 2))
    _say_what_is_left_out(good, x, names)
    at = freeze((np.cumsum(read) - 1)[good], np.int64)
    return Labelled(
        (Course(freeze(t[read]), freeze(x[read])),), freeze(0 * at, np.int64), at, freeze(y[good]), names, points, frame
    )


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
    first_course = np.cumsum([0, *(len(part.courses) for part in parts)])
    return replace(
        first,
        courses=tuple(course for part in parts for course in part.courses),
        part=freeze(np.concatenate([part.part + number for part, number in zip(parts, first_course)]), np.int64),
        row=freeze(np.concatenate([part.row for part in parts]), np.int64),
        markers=freeze(np.concatenate([part.markers for part in parts])),
    )


def check_frame(known: str, found: str) -> None:
    """Raise InputError unless markers are in the expected frame of reference; otherwise a motion of the base would be inferred."""
    if known != found:
        raise InputError(
            "markers in another frame of reference",
            where="markers",
            found=WORDS[found],
            expected=WORDS[known],
            hint="-c CALIBRATION transforms a camera's markers into the robot frame, --robot-frame declares that they are in it",
        )
