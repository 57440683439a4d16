"""Quantities computed in some states and interpolated in others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator

from femsense.core.arrays import FloatArray, IntArray
from femsense.model.recording import Recording


def drive_table(recording: Recording, frames: IntArray) -> FloatArray:
    """Return inputs, pressures, gravity and total load of each frame, shape (f, q)."""
    load = np.zeros((len(recording.time_s), 3))
    np.add.at(load, recording.load_frame, recording.load_forces)
    gravity = np.zeros((len(load), 0)) if recording.gravity is None else recording.gravity
    return np.asarray(np.hstack([recording.inputs, recording.pressures, gravity, load])[frames])


def ranges(table: FloatArray) -> FloatArray:
    """Return the range of each column of a table of drives (f, q), shape (q,)."""
    return np.asarray(np.maximum(np.ptp(table, axis=0), 1e-12))


@dataclass(frozen=True, eq=False, slots=True)
class Sampled:
    """A quantity computed in n states and interpolated between them."""

    drives: FloatArray
    """Drives of these states, shape (n, q): rows of `drive_table`."""
    values: FloatArray
    """Shape (n, …)."""
    ranges: FloatArray
    """Range of each drive over all states, shape (q,)."""

    def at(self, drives: FloatArray) -> FloatArray:
        """Return the interpolated values at drives of shape (f, q), shape (f, …)."""
        count = len(self.values)
        known = RBFInterpolator(self.drives / self.ranges, self.values.reshape(count, -1), kernel="linear", degree=0)
        return np.asarray(known(drives / self.ranges)).reshape(len(drives), *self.values.shape[1:])
