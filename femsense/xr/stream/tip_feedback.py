"""Integral action on the measured place of a dragged point: what the model gets wrong is taken off the target.

    b ← clip(m − p* + (1 − exp(−Δt / τ)) (p* − y)),   target of the model: p* + b

with p* where the point is wanted, y where it is measured, and m where the model's inputs bring it.
m − p* is the b before without what the model cannot do, be it too few inputs or a limit: neither winds b up (back-calculation:
Åström and Hägglund 1995, section 3.5). b changes only while the inputs stand still where the model wants them, so that the
limited rate does not either. At rest y = p*, or as near as the inputs allow, whatever mesh, law or contact the model lacks, as
long as its slopes have the right sign and half their size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class FeedbackOptions:
    """How fast and how far what is measured corrects what is wanted."""

    time_s: float = 0.3
    """τ: how fast an error is taken off."""
    fresh_s: float = 0.5
    """A measurement that is older corrects nothing."""
    most_share: float = 0.25
    """The correction is at most this share of the body's size."""


class TipFeedback:
    """Keeps the correction of one point that is dragged."""

    def __init__(self, size_m: float, options: FeedbackOptions | None = None) -> None:
        """size_m: of the body."""
        self.options = options or FeedbackOptions()
        self.correction_m: FloatArray = np.zeros(3)
        """What is added to the target [m], shape (3,)."""
        self.missed_m = float("nan")
        """How far the point was measured from where it is wanted [m]; nan where nothing fresh is known."""
        self.offset_m: FloatArray = np.zeros(3)
        """Where the point was measured, from where the model had it at the same inputs [m], shape (3,)."""
        self._most = self.options.most_share * size_m
        self._seen: tuple[float, FloatArray] | None = None
        self._used = float("-inf")
        self._wanted: FloatArray | None = None

    def measured(self, now: float, place_m: FloatArray) -> None:
        """Take note of where the point is [m], robot frame, shape (3,), at a time [s]."""
        self._seen = (now, np.asarray(place_m, dtype=np.float64))

    def forget(self) -> None:
        """Begin anew: another point, or nobody holds on."""
        self.correction_m, self.offset_m, self.missed_m = np.zeros(3), np.zeros(3), float("nan")
        self._seen, self._used, self._wanted = None, float("-inf"), None

    def expected(self, reached_m: FloatArray) -> FloatArray:
        """Return where the point will be measured whose inputs bring it to a place by the model [m], shape (3,)."""
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
            wanted_m: where the point is to be [m], shape (3,).
            settled_since: since when the inputs stand still where the model wants them [s]; None: they do not.
            reached_m: where the model's inputs for the target before bring the point [m], shape (3,); None: to that target.
            arrived: they bring it to that target, but for the search's tolerance, which is not to wind the correction up.
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
