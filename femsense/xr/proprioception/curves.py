"""Nonlinear dependence of channels on each other: smooth maps, tested on blocks of time that were held out.

Channel i is predicted from the other normalised readings by f_i(z), with z_i left out. f_i depends on all of them, or on the most
informative one if that has a smaller error: with many unrelated channels, a function of all needs many readings.
A reading is outside if |z_i − f_i(z)| > h_i, with h_i from the largest error on held-out blocks. If channels depend on each other
linearly, the inverse covariance is more accurate, and there is no curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, spread_evenly
from femsense.xr.proprioception.linear import train_radial
from femsense.xr.proprioception.network import Network
from femsense.xr.proprioception.selection import MOST_ROWS, folds

PENALTY, LENGTH, NOISE = 1e-4, 1.0, 1e-2
"""Of `train_radial`; half or twice the length and a tenth of the noise find as many contradictions."""
HELD_MARGIN = 1.5
"""Times the largest error on held-out blocks that is allowed, as of the straight line."""
NARROWER = 0.7
"""A curve is kept if its interval is at most this share of the linear one. Then no additional row of an arm's own motion is reported
outside; with 1.0 up to six more in ten thousand are (`benchmarks/xr_domain.py --narrower 0.7 1.0`)."""


@dataclass(frozen=True, eq=False, slots=True)
class Curve:
    """Prediction of one channel from all others, or from one of them, in normalised readings."""

    channel: int
    network: Network
    """From all channels, shape (n, c), to this one, shape (n, 1); its own reading does not count."""
    half: float
    """How far off a reading may be."""

    def deviation(self, z: FloatArray) -> FloatArray:
        """Return how far readings, shape (n, c), are off, shape (n,)."""
        return np.asarray(z[:, self.channel] - self.network(z)[:, 0])


def learn_curves(z: FloatArray, lines: FloatArray) -> tuple[Curve, ...]:
    """Return the curves that allow clearly less than the straight line.

    Arguments:
        z: normalised readings in the order of time, shape (n, c).
        lines: how far off the straight line lets each channel be, shape (c,).
    """
    rows = z[spread_evenly(len(z), MOST_ROWS)]
    found = []
    moving = np.flatnonzero(np.ptp(z, axis=0) > 0).tolist()
    for i in moving:
        others = [j for j in moving if j != i]
        if not others:
            break
        alone = max(others, key=lambda j: depends(rows[:, j], rows[:, i]))
        halves = {of: HELD_MARGIN * _largest_error(rows, i, of) for of in (tuple(others), (alone,))}
        best = min(halves, key=lambda of: halves[of])
        if halves[best] < NARROWER * lines[i]:
            found.append(Curve(i, _train(rows, i, best), halves[best]))
    return tuple(found)


def depends(x: FloatArray, y: FloatArray) -> float:
    """Return Chatterjee's coefficient of y on x, both of shape (n,): 1 if y is a function of x, about 0 if they are independent (2021)."""
    ranks = np.argsort(np.argsort(y[np.argsort(x, kind="stable")], kind="stable"), kind="stable")
    n = len(x)
    return float(1.0 - 3.0 * np.abs(np.diff(ranks)).sum() / (n**2 - 1.0))


def _largest_error(z: FloatArray, channel: int, of: tuple[int, ...]) -> float:
    """Return the largest error of a channel's curve over others on blocks that were held out in turn."""
    errors = [_train(z[~held], channel, of)(z[held])[:, 0] - z[held, channel] for held in folds(len(z))]
    return float(np.abs(np.concatenate(errors)).max())


def _train(z: FloatArray, channel: int, of: tuple[int, ...]) -> Network:
    others = np.zeros_like(z)  # an input that never changes has no weight
    others[:, of] = z[:, of]
    return train_radial(others, z[:, [channel]], penalty=PENALTY, length=LENGTH, noise=NOISE)
