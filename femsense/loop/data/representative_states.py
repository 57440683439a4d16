"""Representative states of a recording."""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from femsense.core.arrays import FloatArray, IntArray
from femsense.loop.data.sampled_states import drive_table, ranges
from femsense.loop.data.trial import Trial
from femsense.model.recording import Recording
from femsense.model.robot import spread_points

FEWEST = 16
"""Minimum number of representative states."""
SAME = 1e-9
"""States whose inputs and loads differ by less than this, in units of their ranges, are the same."""


def spread_states(trial: Trial, most: int) -> tuple[IntArray, float]:
    """Return the frames of at most `most` (at least FEWEST) states of a trial, chosen as different as possible, ascending; and the share of its
    states that these are."""
    frames = trial.scene.frames
    vectors = state_vectors(trial.scene.recording, frames)
    every = representatives(vectors, len(vectors))
    chosen = vectors[every[: max(FEWEST, most)]]
    return np.asarray(frames[cdist(vectors, chosen).min(axis=1) <= SAME]), len(chosen) / len(every)


def state_vectors(recording: Recording, frames: IntArray) -> FloatArray:
    """Return the drives of each frame, each number in units of its range, shape (f, q)."""
    table = drive_table(recording, frames)
    return np.asarray((table - table[0]) / ranges(table))


def representatives(vectors: FloatArray, most: int) -> IntArray:
    """Return indices of at most `most` distinct states, spread widely."""
    return spread_points(vectors, most, apart=SAME)
