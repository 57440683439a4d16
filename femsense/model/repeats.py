"""States that a recording visits repeatedly: their differences are noise, independent of the model."""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.model.recording import Recording, state_key

LEAST_REPEATS = 6
"""Degrees of freedom from which on repeats tell the noise: its size is then known to 30 %."""
State = tuple[bytes, bytes]
"""A state and the one before it: with friction, how it is reached matters."""


def stays_of(recording: Recording) -> dict[int, tuple[int, State]]:
    """Return the number of the visit of each frame, and the key of its state: the inputs and those before."""
    keys = [state_key(recording, k) for k in range(len(recording.time_s))]
    result, stay, past = {}, 0, b""
    for k, key in enumerate(keys):
        if k > 0 and key != keys[k - 1]:
            stay, past = stay + 1, keys[k - 1]
        result[k] = (stay, (key, past))
    return result


def squares_about_mean(values: FloatArray) -> FloatArray:
    """Return the sum of squares of values (n, c) about their mean, and its degrees of freedom, shape (2,)."""
    return np.array([((values - values.mean(axis=0)) ** 2).sum(), values.shape[1] * (len(values) - 1)])


def marker_repeatability(recording: Recording) -> float:
    """Return the repeatability of markers along each axis, camera frame, one standard deviation [m]: as declared, else estimated from
    repeated states; nan if there are none."""
    if recording.marker_noise_m is not None:
        return recording.marker_noise_m
    stays, groups = stays_of(recording), dict[tuple[State, int, int], list[FloatArray]]()
    for k, m, v, x in zip(recording.marker_frame, recording.marker_index, recording.marker_view, recording.marker_xyz):
        groups.setdefault((stays[int(k)][1], int(m), int(v)), []).append(x)
    square, count = sum((squares_about_mean(np.array(own)) for own in groups.values()), np.zeros(2))
    return float(np.sqrt(square / count)) if count >= LEAST_REPEATS else float("nan")
