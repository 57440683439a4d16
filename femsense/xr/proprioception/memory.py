"""What a sensor read a while ago: its readings through low-pass filters of first order, as inputs beside the readings.

    m ← m + (1 − exp(−Δt / τ)) (x − m)

A body that creeps, or a tube that fills, follows its inputs late. Filters need no constant rate, and little is kept for a stream.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray


def step_memory(memory: FloatArray, row: FloatArray, dt: float, taus: FloatArray) -> FloatArray:
    """Return the filters, shape (k, c), after a row of readings, shape (c,), that came `dt` [s] after the one before."""
    return np.asarray(memory + (1.0 - np.exp(-max(dt, 0.0) / taus))[:, None] * (row - memory))


def with_memory(time_s: FloatArray, values: FloatArray, taus: tuple[float, ...]) -> FloatArray:
    """Return readings and their filters, shape (n, (1 + k) c).

    Arguments:
        time_s: when each row was read [s], shape (n,); filters start at the first row.
        values: readings, shape (n, c).
        taus: time constants [s], k of them.
    """
    if not taus:
        return values
    past = np.empty((len(values), len(taus), values.shape[1]))
    past[0] = values[0]
    dt = np.diff(time_s)
    for i in range(1, len(values)):
        past[i] = step_memory(past[i - 1], values[i], dt[i - 1], np.asarray(taus))
    return np.concatenate([values, past.reshape(len(values), -1)], axis=1)
