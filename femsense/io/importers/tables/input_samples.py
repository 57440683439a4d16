"""Inputs and loads sampled at other times than the frames: interpolation, and the limits of validity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray

NEAR_S = 0.05
"""A sample belongs to a frame at most this far from it [s]."""
STEPS = 3.0
"""Two samples farther apart than this times the usual step enclose a hole: two lost in a row are bridged."""


def nearest_in_time(times: FloatArray, other: FloatArray, within: float) -> IntArray:
    """Return for each time the index of the nearest other one, shape (times,); −1 where none is within [s]. `other` increases."""
    if not len(other):
        return np.full(len(times), -1, dtype=np.int64)
    right = np.clip(np.searchsorted(other, times), 0, len(other) - 1)
    left = np.maximum(right - 1, 0)
    near = np.where(np.abs(times - other[left]) <= np.abs(times - other[right]), left, right)
    return np.where(np.abs(times - other[near]) <= within, near, -1)


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Values at times of their own; made by `samples_of`."""

    columns: tuple[_Column, ...]

    def at(self, time_s: npt.ArrayLike) -> FloatArray:
        """Return the values at times [s], shape (times, columns): linearly between their neighbours, NaN where they are not known.

        They are known within NEAR_S of a sample, and between two that are at most STEPS of the column's median step apart.
        """
        wanted = np.asarray(time_s, dtype=np.float64).reshape(-1)
        return np.array([column.at(wanted) for column in self.columns], dtype=np.float64).reshape(-1, len(wanted)).T


def samples_of(time_s: FloatArray, values: FloatArray) -> Samples:
    """Return what was sampled.

    Arguments:
        time_s: [s], in any order, shape (n,).
        values: in the units of frames.csv, NaN where one is missing, shape (n, columns).
    """
    return Samples(tuple(_column(time_s, column) for column in values.T))


@dataclass(frozen=True, eq=False, slots=True)
class _Column:
    time_s: FloatArray
    """Increasing, shape (n,)."""
    values: FloatArray
    """Shape (n,)."""
    bridged_s: float
    """The longest step that is no hole [s]."""

    def at(self, wanted: FloatArray) -> FloatArray:
        times = self.time_s
        if not len(times):
            return np.full(len(wanted), np.nan)
        right = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
        left = np.where(wanted > times[-1], right, np.maximum(right - 1, 0))
        near = np.minimum(np.abs(wanted - times[left]), np.abs(times[right] - wanted)) <= NEAR_S
        inside = (wanted >= times[0]) & (wanted <= times[-1])
        bridged = inside & (times[right] - times[left] <= self.bridged_s)
        return np.where(near | bridged, np.interp(wanted, times, self.values), np.nan)


def _column(time_s: FloatArray, values: FloatArray) -> _Column:
    finite = np.isfinite(values)
    times, first = np.unique(time_s[finite], return_index=True)
    usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return _Column(times, values[finite][first], STEPS * usual * (1.0 + 1e-9))


def spans(left_out: Sequence[int], time_s: FloatArray) -> str:
    """Return runs of frames with their times [s] as text, the first five of them.

    Arguments:
        left_out: numbers of frames, increasing.
        time_s: of all frames after the first [s], shape (F,).
    """
    runs = np.split(np.asarray(left_out), np.flatnonzero(np.diff(left_out) > 1) + 1)
    told = [
        f"frame {run[0]} at {time_s[run[0]]:.3f} s"
        if len(run) == 1
        else f"frames {run[0]}–{run[-1]} at {time_s[run[0]]:.3f} … {time_s[run[-1]]:.3f} s"
        for run in runs
    ]
    return ", ".join(told[:5]) + (f" and {len(told) - 5} more spans" if len(told) > 5 else "")
