"""Which frames a calibration on the fly still needs, and whether one suffices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray

DEGREE = np.pi / 180.0


@dataclass(frozen=True, slots=True)
class CoverageLimits:
    """What the contact-free frames of a session have to show."""

    frames: int = 12
    """As many as calibration uses of clouds; four of them at least teach the error of the model."""
    apart: float = 0.1
    """Two frames tell different things if an input differs by this share of its span."""
    wait_s: float = 0.5
    """Where the inputs rest, another frame of the same state is taken after this time: it tells noise."""
    patience: float = 2.0
    """Inputs that never moved in this many times `frames` are taken for such that cannot."""
    position_m: float = 5e-4
    rotation_rad: float = 0.3 * DEGREE
    """The camera's pose has to be known this well, one standard deviation."""


class Coverage:
    """Chooses contact-free frames by their inputs, and says what is missing."""

    def __init__(self, columns: Sequence[str], largest: Sequence[float], limits: CoverageLimits | None = None) -> None:
        """Begin without frames.

        Arguments:
            columns: names of the inputs.
            largest: what each may reach, as the robot declares it; inf: not declared.
            limits: what is needed.
        """
        self.limits = limits or CoverageLimits()
        self.columns, self._largest = tuple(columns), np.asarray(largest, dtype=np.float64)
        self._taken: list[FloatArray] = []
        self._low = np.full(len(self.columns), np.inf)
        self._high = np.full(len(self.columns), -np.inf)
        self._last_s = float("-inf")
        self.wanted = self.limits.frames

    def offer(self, time_s: float, values: FloatArray) -> bool:
        """Return whether a contact-free frame with these inputs is one to keep."""
        self._low, self._high = np.minimum(self._low, values), np.maximum(self._high, values)
        span = np.maximum(self._high - self._low, 1e-12)
        differs = all((np.abs(values - one) > self.limits.apart * span).any() for one in self._taken)
        if self._taken and not differs and time_s - self._last_s < self.limits.wait_s:
            return False
        self._taken.append(values)
        self._last_s = time_s
        return True

    @property
    def count(self) -> int:
        """Frames that were kept."""
        return len(self._taken)

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Inputs that have moved by less than `apart` of what they may reach, or not at all."""
        if not self._taken:
            return self.columns
        span = self._high - self._low
        needed = np.where(np.isfinite(self._largest), self.limits.apart * self._largest, 0.0)
        return tuple(name for name, s, n in zip(self.columns, span, needed) if s <= max(n, 1e-12))

    @property
    def suffices(self) -> bool:
        """Whether a calibration may be tried: enough frames, and every input moved, or was waited for in vain."""
        given_up = self.count >= self.limits.patience * self.wanted
        return self.count >= self.wanted and (not self.unmoved or given_up)

    def want_more(self, frames: int) -> None:
        """Ask for more frames: the calibration did not suffice."""
        self.wanted = self.count + frames

    @property
    def missing(self) -> str:
        """What a person is to do, and how much is missing; empty where nothing is."""
        if self.suffices:
            return ""
        parts = [f"{max(0, self.wanted - self.count)} of {self.wanted} frames missing"] if self.count < self.wanted else []
        if self.unmoved:
            parts.append(f"not moved yet: {', '.join(self.unmoved)}")
        return "; ".join(parts)


def insufficiency(calibration: Calibration, limits: CoverageLimits | None = None) -> str:
    """Return why a calibration does not suffice for sensing, in words; empty where it does."""
    wanted = limits or CoverageLimits()
    if not calibration.settled:
        return calibration.status
    for name, block in zip(calibration.camera_names, _pose_blocks(calibration)):
        rotation, position = (float(np.sqrt(np.trace(b))) for b in (block[:3, :3], block[3:, 3:]))
        if position > wanted.position_m or rotation > wanted.rotation_rad:
            camera = f"camera {name}" if name else "the camera"
            return (
                f"{camera} is known to {1e3 * position:.2f} mm and {rotation / DEGREE:.2f}°, needed are"
                f" {1e3 * wanted.position_m:.2f} mm and {wanted.rotation_rad / DEGREE:.2f}°"
            )
    return ""


def _pose_blocks(calibration: Calibration) -> list[FloatArray]:
    joint = calibration.joint_covariance
    return [joint[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] for v in range(len(calibration.poses))]
