"""Whether a reading lies inside what was learnt: the range of each channel, and how channels go together.

A channel is judged twice: against the range in which it was seen, and against what the other channels make of it,

    z_i = (P x)_i / √P_ii,   P the inverse covariance of the normalised readings,

the deviation of channel i from its regression on all others, in standard deviations of that regression.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray

MARGIN = 0.05
"""Share of its range by which a channel may leave it before that is said. With both limits, of rows that repeat what was learnt
1 in 2000 is called outside (a pneumatic arm, `benchmarks/xr.py`), and of rows with a chamber that was not trained all are."""
FLOOR = 0.01
"""Standard deviation of a regression, as a share of the channel's own, below which it is not believed."""
JOINT_MARGIN = 1.5
"""Times the largest joint deviation seen; new rows of the same motion reach 1.06 times it."""


@dataclass(frozen=True, slots=True)
class Outside:
    """A channel that reads what was never learnt."""

    channel: str
    kind: str
    """"range", "joint" (each channel is in its range, but not together) or "missing" (no finite number)."""
    value: float
    low: float
    high: float
    """Between these it was seen; for "joint", between these the other channels would have it."""
    far: float
    """How far outside, in widths of that interval."""

    @property
    def text(self) -> str:
        """One line for people."""
        if self.kind == "missing":
            return f"{self.channel}: no number"
        seen = "learnt" if self.kind == "range" else "expected from the other channels"
        return (
            f"{self.channel} = {self.value:.4g} is outside {self.low:.4g} … {self.high:.4g} ({seen}), by {self.far:.2g} "
            f"times that width"
        )


@dataclass(frozen=True, eq=False, slots=True)
class Domain:
    """What readings were learnt from."""

    low: FloatArray
    high: FloatArray
    """Range of each channel, in its unit, shape (c,)."""
    centre: FloatArray
    scale: FloatArray
    """To normalise the readings, shape (c,)."""
    precision: FloatArray
    """Inverse covariance of the normalised readings, shape (c, c)."""
    limit: FloatArray
    """Largest joint deviation of each channel that was seen, shape (c,)."""

    def check(self, row: FloatArray, channels: tuple[str, ...]) -> tuple[Outside, ...]:
        """Return the channels of a row, shape (c,), that are outside, the farthest first."""
        missing = [Outside(name, "missing", float(x), 0.0, 0.0, np.inf) for name, x in zip(channels, row) if not np.isfinite(x)]
        if missing:
            return tuple(missing)
        found = self._range(row, channels) or self._joint(row, channels)
        return tuple(sorted(found, key=lambda item: -item.far))

    def inside(self, rows: FloatArray) -> np.ndarray:
        """Return which rows, shape (n, c), are inside, shape (n,)."""
        width = MARGIN * self._width()
        ranged = ((rows >= self.low - width) & (rows <= self.high + width)).all(axis=1)
        joint = np.abs(self._deviation(rows)) <= JOINT_MARGIN * self.limit
        return np.asarray(ranged & joint.all(axis=1))

    def _width(self) -> FloatArray:
        return np.maximum(self.high - self.low, 1e-9 / self.scale)

    def _deviation(self, rows: FloatArray) -> FloatArray:
        z = (rows - self.centre) * self.scale
        return np.asarray(z @ self.precision / np.sqrt(np.diag(self.precision)))

    def _range(self, row: FloatArray, channels: tuple[str, ...]) -> list[Outside]:
        width = self._width()
        far = np.maximum(self.low - row, row - self.high) / width
        return [
            Outside(channels[i], "range", float(row[i]), float(self.low[i]), float(self.high[i]), float(far[i]))
            for i in np.flatnonzero(far > MARGIN)
        ]

    def _joint(self, row: FloatArray, channels: tuple[str, ...]) -> list[Outside]:
        deviation = self._deviation(row[None])[0]
        found = []
        for i in np.flatnonzero(np.abs(deviation) > JOINT_MARGIN * self.limit):
            std = 1.0 / (np.sqrt(self.precision[i, i]) * self.scale[i])
            expected, half = row[i] - deviation[i] * std, JOINT_MARGIN * self.limit[i] * std
            far = (abs(deviation[i]) / (JOINT_MARGIN * self.limit[i]) - 1.0) / 2.0
            found.append(Outside(channels[i], "joint", float(row[i]), float(expected - half), float(expected + half), float(far)))
        return found


def learn_domain(values: FloatArray) -> Domain:
    """Return the domain of readings, shape (n, c)."""
    low, high = values.min(axis=0), values.max(axis=0)
    centre = values.mean(axis=0)
    std = values.std(axis=0)
    scale = 1.0 / np.where(std > 0, std, 1.0)
    z = (values - centre) * scale
    precision = np.linalg.inv(z.T @ z / len(z) + FLOOR**2 * np.eye(z.shape[1]))
    deviation = z @ precision / np.sqrt(np.diag(precision))
    limit = np.maximum(np.abs(deviation).max(axis=0), 1.0)
    return Domain(low, high, centre, scale, precision, limit)
