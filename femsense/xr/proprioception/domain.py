"""The domain of a model: the range of each channel, and the dependence between channels.

A channel is compared with its training range, and with its prediction from the other channels: by linear regression,

    z_i = (P x)_i / √P_ii,   P the inverse covariance of the normalised readings,

the deviation of channel i from its regression on all others, in standard deviations of that regression; and by a curve if that
is more accurate (`curves`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.xr.proprioception.bayes import inverse_spread
from femsense.xr.proprioception.curves import Curve, learn_curves

MARGIN = 0.05
"""Share of its range by which a channel may leave it before it is reported. With both limits, 1 in 2000 rows that repeat the training motion is reported
outside (a pneumatic arm, `benchmarks/xr.py`), and all rows with a chamber that was not trained."""
FLOOR = 0.01
"""Smallest standard deviation of a regression, relative to the channel's own."""
JOINT_MARGIN = 1.5
"""Limit of the joint deviation, relative to the largest one in training; new rows of the same motion reach 1.06 times that."""
SAME = 1e-12
"""A channel that moves by less, relative to its reading, does not move."""


class Why(StrEnum):
    """Why a row is outside of the training domain."""

    RANGE = "range"
    STILL = "still"
    """The channel never moved while it was learnt."""
    JOINT = "joint"
    """Each channel is in its range, but not together."""
    MISSING = "missing"
    """No finite number."""
    GAP = "gap"
    """The row came too long after the one before for a model with a memory, `value` seconds."""


@dataclass(frozen=True, slots=True)
class Outside:
    """A channel outside of the training domain."""

    channel: str
    kind: Why
    value: float
    low: float
    high: float
    """Its training range; for `Why.JOINT`, the interval predicted from the other channels."""
    far: float
    """Distance from the interval in units of its width; infinite without a finite reading."""

    @property
    def text(self) -> str:
        """The message to the user, one line."""
        if self.kind is Why.MISSING:
            return f"{self.channel}: no number"
        if self.kind is Why.GAP:
            return f"{self.value:.2g} s after the row before: the model remembers what came before, and needs a row every {self.high:.2g} s"
        if self.kind is Why.STILL:
            return f"{self.channel} = {self.value:.4g}, but it never moved while it was learnt: it stood at {self.low:.4g}"
        seen = "learnt" if self.kind is Why.RANGE else "expected from the other channels"
        return (
            f"{self.channel} = {self.value:.4g} is outside {self.low:.4g} … {self.high:.4g} ({seen}), by {self.far:.2g} "
            f"times that width"
        )


@dataclass(frozen=True, eq=False, slots=True)
class Domain:
    """The training domain of a model."""

    low: FloatArray
    high: FloatArray
    """Range of each channel, in its unit, shape (c,)."""
    centre: FloatArray
    scale: FloatArray
    """To normalise the readings, shape (c,)."""
    precision: FloatArray
    """Inverse covariance of the normalised readings, shape (c, c)."""
    limit: FloatArray
    """Largest joint deviation of each channel in training, shape (c,)."""
    curves: tuple[Curve, ...] = ()
    """Of the normalised readings, for channels that depend on the others by a curve."""

    def check(self, row: FloatArray, channels: tuple[str, ...], needed: BoolArray | None = None) -> tuple[Outside, ...]:
        """Return the channels of a row, shape (c,), that are outside, the farthest first.

        Channels that are not `needed`, shape (c,), and have no finite reading are ignored, and the others are judged without them.
        """
        lost = ~np.isfinite(row) & (True if needed is None else needed)
        if lost.any():
            return tuple(Outside(channels[i], Why.MISSING, float(row[i]), 0.0, 0.0, np.inf) for i in np.flatnonzero(lost))
        found = [
            Outside(name, Why.RANGE if np.isfinite(far) else Why.STILL, value, low, high, far)
            for name, value, low, high, far in zip(channels, *(x.tolist() for x in (row, self.low, self.high, self._beyond(row))))
            if far > MARGIN
        ]
        return tuple(sorted(found or self._off_together(row, channels), key=lambda item: -item.far))

    def filled(self, row: FloatArray) -> FloatArray:
        """Return a row, shape (c,), with the linear prediction from the other channels in place of values that are not finite.

        z_m = −P_mm⁻¹ P_mk z_k: with it the deviations of the others are those of a regression without the missing ones.
        """
        m = ~np.isfinite(row)
        if not m.any():
            return row
        z = np.where(m, 0.0, self._normalised(row))
        P = self.precision
        z[m] = -np.linalg.solve(P[np.ix_(m, m)], P[np.ix_(m, ~m)] @ z[~m])
        return np.asarray(np.where(m, self.centre + z / self.scale, row))

    def inside(self, rows: FloatArray) -> BoolArray:
        """Return which rows, shape (n, c), are inside, shape (n,)."""
        inside = np.asarray(np.isfinite(rows).all(axis=1))
        inside[inside] = (self._beyond(rows[inside]) <= MARGIN).all(axis=1)
        z = self._normalised(rows[inside])
        together = [np.abs(off) <= half for _, off, half in self._relations(z, np.ones(z.shape[1], dtype=bool))]
        inside[inside] = np.all(together, axis=0)
        return inside

    def _beyond(self, rows: FloatArray) -> FloatArray:
        """Return how far the channels of rows, shape (…, c), are beyond their range, in its widths; of a channel that never moved
        infinitely far."""
        beyond, width = np.maximum(self.low - rows, rows - self.high), self.high - self.low
        least = SAME * (1.0 + np.abs(self.high))
        still = np.where(beyond > least, np.inf, 0.0)
        return np.asarray(np.divide(beyond, width, out=still, where=width > least))

    def _normalised(self, rows: FloatArray) -> FloatArray:
        return np.asarray((rows - self.centre) * self.scale)

    def _relations(self, z: FloatArray, known: BoolArray) -> Iterator[tuple[int, FloatArray, float]]:
        """Yield a channel, how far rows are off the line or curve on which it depends on others, and how far they may be.

        Arguments:
            z: normalised readings, shape (n, c).
            known: which channels were read, shape (c,): the others are judged by no line, and curves over them are left out.
        """
        P_ii = np.diag(self.precision)
        for i in np.flatnonzero(known).tolist():
            yield i, z @ self.precision[i] / P_ii[i], float(JOINT_MARGIN * self.limit[i] / np.sqrt(P_ii[i]))
        for curve in self.curves:
            if known[curve.channel] and known[curve.network.uses].all():
                yield curve.channel, curve.deviation(z), curve.half

    def _off_together(self, row: FloatArray, channels: tuple[str, ...]) -> list[Outside]:
        """Return the channels of a row that are off their line or their curve; of both, the farther."""
        found: dict[int, Outside] = {}
        for i, off, half in self._relations(self._normalised(self.filled(row)[None]), np.isfinite(row)):
            far = 0.5 * (abs(float(off[0])) / half - 1.0)
            if far > (found[i].far if i in found else 0.0):
                expected, width = float(row[i] - off[0] / self.scale[i]), float(half / self.scale[i])
                found[i] = Outside(channels[i], Why.JOINT, float(row[i]), expected - width, expected + width, far)
        return list(found.values())


def learn_domain(values: FloatArray) -> Domain:
    """Return the domain of readings in the order of time, shape (n, c)."""
    low, high = values.min(axis=0), values.max(axis=0)
    centre, scale = values.mean(axis=0), inverse_spread(values)
    scale = np.where(scale > 0, scale, 1.0)
    z = (values - centre) * scale
    precision = np.linalg.inv(z.T @ z / len(z) + FLOOR**2 * np.eye(z.shape[1]))
    std = 1.0 / np.sqrt(np.diag(precision))
    limit = np.maximum(np.abs(z @ precision * std).max(axis=0), 1.0)
    return Domain(low, high, centre, scale, precision, limit, learn_curves(z, JOINT_MARGIN * limit * std))
