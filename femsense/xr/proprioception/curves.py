"""Channels that depend on the others by a curve: a smooth map that blocks in time have judged which it was not trained on.

What the other channels make of channel i is f_i(z) of the normalised readings, with z_i left out; a reading is off the curve where
|z_i − f_i(z)| > h_i, h_i from the largest error that was left on held-out blocks. Where the channels go together by a straight line,
the inverse covariance knows that better, and there is no curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.xr.proprioception.linear import train_radial
from femsense.xr.proprioception.network import Network
from femsense.xr.proprioception.selection import MOST_ROWS, folds, thinned_rows

PENALTY, LENGTH, NOISE = 1e-4, 1.0, 1e-2
"""Of `train_radial`; half or twice the length and a tenth of the noise find as many contradictions."""
HELD_MARGIN = 1.5
"""Times the largest error on held-out blocks that is allowed, as of the straight line."""
NARROWER = 0.7
"""A curve is kept where it allows at most so much of what the straight line allows. Then no row more of an arm's own motion is called
outside; with 1.0 up to six more in ten thousand are (`benchmarks/xr_domain.py --narrower 0.7 1.0`)."""


@dataclass(frozen=True, eq=False, slots=True)
class Curve:
    """What the other channels make of one channel, in normalised readings."""

    channel: int
    network: Network
    """From all channels, shape (n, c), to this one, shape (n, 1); its own reading does not count."""
    half: float
    """How far off a reading may be."""

    def deviation(self, z: FloatArray) -> FloatArray:
        """Return how far readings, shape (n, c), are off, shape (n,)."""
        return np.asarray(z[:, self.channel] - self.network(z)[:, 0])

    def inside(self, z: FloatArray) -> BoolArray:
        """Return which readings, shape (n, c), are near enough, shape (n,)."""
        return np.asarray(np.abs(self.deviation(z)) <= self.half)


def learn_curves(z: FloatArray, lines: FloatArray) -> tuple[Curve, ...]:
    """Return the curves that allow clearly less than the straight line.

    Arguments:
        z: normalised readings in the order of time, shape (n, c).
        lines: how far off the straight line lets each channel be, shape (c,).
    """
    rows = z[thinned_rows(len(z), MOST_ROWS)]
    found = []
    for i in np.flatnonzero(np.ptp(z, axis=0) > 0).tolist():
        half = HELD_MARGIN * _largest_error(rows, i)
        if half < NARROWER * lines[i]:
            found.append(Curve(i, _train(rows, i), half))
    return tuple(found)


def _largest_error(z: FloatArray, channel: int) -> float:
    """Return the largest error of a channel's curve on blocks that were held out in turn."""
    errors = [_train(z[~held], channel)(z[held])[:, 0] - z[held, channel] for held in folds(len(z))]
    return float(np.abs(np.concatenate(errors)).max())


def _train(z: FloatArray, channel: int) -> Network:
    others = z.copy()
    others[:, channel] = 0.0  # an input that never changes has no weight
    return train_radial(others, z[:, [channel]], penalty=PENALTY, length=LENGTH, noise=NOISE)
