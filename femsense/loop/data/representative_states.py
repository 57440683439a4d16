"""Which states of a recording speak for all, and what the others have in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from femsense.core.arrays import FloatArray, IntArray
from femsense.loop.data.trial import Trial
from femsense.model.recording import Recording

FEWEST = 12
"""They are as many at least."""
SAME = 1e-9
"""States whose inputs and loads differ by less, in units of their ranges, are one."""


def spread_states(trial: Trial, most: int) -> tuple[IntArray, float]:
    """Return the frames of a trial in so many of its states at most, FEWEST at least, which differ as much as they can, ascending; and the share of
    its states that these are."""
    frames = trial.scene.frames
    vectors = state_vectors(trial.scene.recording, frames)
    every = representatives(vectors, len(vectors))
    chosen = vectors[every[: max(FEWEST, most)]]
    return np.asarray(frames[cdist(vectors, chosen).min(axis=1) <= SAME]), len(chosen) / len(every)


def state_vectors(recording: Recording, frames: IntArray) -> FloatArray:
    """Return what drives each frame, each number in units of its range, shape (f, q)."""
    table = drive_table(recording, frames)
    return np.asarray((table - table[0]) / ranges(table))


def ranges(table: FloatArray) -> FloatArray:
    """Return by how much each column of a table of drives (f, q) varies, shape (q,)."""
    return np.asarray(np.maximum(np.ptp(table, axis=0), 1e-12))


def drive_table(recording: Recording, frames: IntArray) -> FloatArray:
    """Return inputs, pressures, gravity and total load of each frame, shape (f, q)."""
    load = np.zeros((len(recording.time_s), 3))
    np.add.at(load, recording.load_frame, recording.load_forces)
    gravity = np.zeros((len(load), 0)) if recording.gravity is None else recording.gravity
    return np.asarray(np.hstack([recording.inputs, recording.pressures, gravity, load])[frames])


def representatives(vectors: FloatArray, most: int) -> list[int]:
    """Return indices of distinct states, at most so many, spread widely (farthest-point sampling)."""
    chosen = [0]
    distance = np.linalg.norm(vectors - vectors[0], axis=1)
    while len(chosen) < most and distance.max() > SAME:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(vectors - vectors[chosen[-1]], axis=1))
    return chosen


def between(vectors: FloatArray, known: Sequence[int] | IntArray, values: FloatArray) -> FloatArray:
    """Return values of all states, shape (f, …), from those of some of them (indices `known`), shape (k, …), by how near their vectors (f, q) are."""
    flat = RBFInterpolator(vectors[known], values.reshape(len(known), -1), kernel="linear", degree=0)(vectors)
    return np.asarray(flat).reshape(len(vectors), *values.shape[1:])


@dataclass(frozen=True, eq=False, slots=True)
class Sampled:
    """What was computed in some states, and lies in between in others."""

    drives: FloatArray
    """What drives these states, shape (n, q): rows of `drive_table`."""
    values: FloatArray
    """Shape (n, …)."""
    ranges: FloatArray
    """By how much each of the drives varies in all states, shape (q,)."""

    def at(self, drives: FloatArray) -> FloatArray:
        """Return the values of states that are driven so, shape (f, …), drives of shape (f, q)."""
        vectors = np.vstack([self.drives, drives]) / self.ranges
        return between(vectors, np.arange(len(self.drives)), self.values)[len(self.drives) :]
