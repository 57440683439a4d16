"""Integral action on the measured position of a dragged point: the model error is subtracted from the target.

    b ← clip(m − p* + (1 − exp(−Δt / τ)) (p* − y)),   target of the model: p* + b

with p* the target of the point, y its measured position, and m the position that the model's inputs give. m − p* is the previous b without the
part that the model cannot reach because of too few inputs or a limit: neither winds b up (back-calculation: Åström and Hägglund 1995,
section 3.5). b changes only while the inputs stand still at their targets, so that the rate limit does not wind it up either. At rest
y = p*, or as close as the inputs allow, for any error of mesh, law or contact, as long as the model's gradient has the right sign and at least
half the true size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class FeedbackOptions:
    """Rate and range of the correction."""

    time_s: float = 0.3
    """τ: time constant of the integral action [s]."""
    fresh_s: float = 0.5
    """Maximum age of a measurement [s]."""
    most_share: float = 0.25
    """The correction is at most this share of the body's size."""


class TipFeedback:
    """Keeps the correction of one point that is dragged."""

    def __init__(self, size_m: float, options: FeedbackOptions | None = None) -> None:
        """size_m: of the body."""
        self.options = options or FeedbackOptions()
        self.correction_m: FloatArray = np.zeros(3)
        """The offset added to the target [m], shape (3,)."""
        self.missed_m = float("nan")
        """Distance between the measured position and the target [m]; nan without a recent measurement."""
        self.offset_m: FloatArray = np.zeros(3)
        """Measured position minus that of the model at the same inputs [m], shape (3,)."""
        self._most = self.options.most_share * size_m
        self._seen: tuple[float, FloatArray] | None = None
        self._used = float("-inf")
        self._wanted: FloatArray | None = None

    def measured(self, now: float, place_m: FloatArray) -> None:
        """Store the measured position of the point [m], robot frame, shape (3,), at a time [s]."""
        self._seen = (now, np.asarray(place_m, dtype=np.float64))

    def forget(self) -> None:
        """Restart, for another point or after a release."""
        self.correction_m, self.offset_m, self.missed_m = np.zeros(3), np.zeros(3), float("nan")
        self._seen, self._used, self._wanted = None, float("-inf"), None

    def expected(self, reached_m: FloatArray) -> FloatArray:
        """Return the expected measured position of the point when its model position is given [m], shape (3,)."""
        return np.asarray(reached_m + self.offset_m)

    def target(
        self,
        now: float,
        wanted_m: FloatArray,
        *,
        settled_since: float | None,
        reached_m: FloatArray | None = None,
        arrived: bool = False,
    ) -> FloatArray:
        """Return the target for the model [m], shape (3,).

        Arguments:
            now: the time [s].
            wanted_m: target of the point [m], shape (3,).
            settled_since: time since which the inputs stand still at their targets [s]; None: they do not.
            reached_m: position that the model's inputs for the previous target give [m], shape (3,); None: that target.
            arrived: whether that position equals the target within the search tolerance, which must not wind the correction up.
        """
        wanted = np.asarray(wanted_m, dtype=np.float64)
        at, place = self._seen or (float("-inf"), wanted)
        if now - at > self.options.fresh_s:
            self.missed_m = float("nan")
            return self._aimed(wanted)
        error = wanted - place
        self.missed_m = float(np.linalg.norm(error))
        if settled_since is None or at < settled_since or at <= self._used:
            return self._aimed(wanted)
        elapsed = min(at - (self._used if np.isfinite(self._used) else settled_since), self.options.time_s)
        self._used = at
        aimed = (wanted if self._wanted is None else self._wanted) + self.correction_m
        self.offset_m = place - (aimed if reached_m is None else reached_m)
        done = self.correction_m if reached_m is None or arrived or self._wanted is None else reached_m - self._wanted
        grown = done + (1.0 - np.exp(-elapsed / self.options.time_s)) * error
        self.correction_m = grown * min(1.0, self._most / max(float(np.linalg.norm(grown)), 1e-12))
        return self._aimed(wanted)

    def _aimed(self, wanted: FloatArray) -> FloatArray:
        self._wanted = wanted
        return np.asarray(wanted + self.correction_m)
