"""Memory of a model: readings through first-order low-pass filters, as additional inputs.

    m ← m + a (x⁻ − m) + (1 − a τ / Δt) (x − x⁻),   a = 1 − exp(−Δt / τ)

with x⁻ the previous row: readings are interpolated linearly, so that filters depend little on the sampling rate.
A creeping body, or a filling tube, follows its inputs with a delay. The filters need no constant rate, and little state in a stream.
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray

SPARSE = 2.0
"""Largest spacing of rows, relative to the shortest time constant: errors of an arm were 1.2 times as large at two,
1.9 times at four (a trial)."""


def longest_gap(taus: tuple[float, ...]) -> float:
    """Return how far apart rows may be for their filters [s]; infinite without filters."""
    return SPARSE * min(taus, default=float("inf"))


def step_memory(memory: FloatArray, before: FloatArray, row: FloatArray, dt: float, taus: FloatArray) -> FloatArray:
    """Return the filters, shape (k, c), after a row of readings, shape (c,), that came `dt` [s] after the one before."""
    if dt <= 0.0:
        return memory
    passed = (1.0 - np.exp(-dt / taus))[:, None]
    return np.asarray(memory + passed * (before - memory) + (1.0 - passed * taus[:, None] / dt) * (row - before))


def with_memory(time_s: FloatArray, values: FloatArray, taus: tuple[float, ...]) -> FloatArray:
    """Append low-pass filtered copies of readings, one first-order filter per time constant.

    They give a model without states access to the past, so that it can represent creep and slowly filling tubes.

    Arguments:
        time_s: time of each row [s], shape (n,). The filters start in equilibrium with the first row.
        values: readings, shape (n, c).
        taus: k time constants [s].

    Returns:
        shape (n, (1 + k) c): the readings, then the filtered readings of each time constant.
    """
    if not taus:
        return values
    past = np.empty((len(values), len(taus), values.shape[1]))
    past[0] = values[0]
    dt = np.diff(time_s)
    for i in range(1, len(values)):
        past[i] = step_memory(past[i - 1], values[i - 1], values[i], dt[i - 1], np.asarray(taus))
    return np.concatenate([values, past.reshape(len(values), -1)], axis=1)
