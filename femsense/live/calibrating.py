"""Coverage of the contact-free frames for a calibration during a session, and the test of its accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray

DEGREE = np.pi / 180.0


@dataclass(frozen=True, slots=True)
class CoverageLimits:
    """Requirements on the contact-free frames of a session."""

    frames: int = 12
    """The number of frames that calibration uses of clouds; the model error needs at least four of them."""
    apart: float = 0.1
    """Two frames are different if an input differs by this share of its range so far."""
    wait_s: float = 0.5
    """Time after which a frame with unchanged inputs is kept too: repetitions show the noise."""
    patience: float = 2.0
    """After this multiple of `frames`, inputs that never moved are accepted as fixed."""
    position_m: float = 5e-4
    rotation_rad: float = 0.3 * DEGREE
    """Largest standard deviations of the camera pose."""


class Coverage:
    """Selects contact-free frames by their inputs, and states which are missing."""

    def __init__(self, columns: Sequence[str], largest: Sequence[float], limits: CoverageLimits | None = None) -> None:
        """Begin without frames.

        Arguments:
            columns: names of the inputs.
            largest: the largest value of each input that the robot declares; inf: not declared.
            limits: the requirements.
        """
        self.limits = limits or CoverageLimits()
        self.columns, self._largest = tuple(columns), np.asarray(largest, dtype=np.float64)
        self._taken: list[FloatArray] = []
        self._low = np.full(len(self.columns), np.inf)
        self._high = np.full(len(self.columns), -np.inf)
        self._last_s = float("-inf")
        self.wanted = self.limits.frames

    def offer(self, time_s: float, values: FloatArray) -> bool:
        """Return whether to keep a contact-free frame with these inputs."""
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
        """Number of frames that were kept."""
        return len(self._taken)

    @property
    def unmoved(self) -> tuple[str, ...]:
        """Inputs that have moved by less than `apart` of their largest value, or not at all."""
        if not self._taken:
            return self.columns
        span = self._high - self._low
        needed = np.where(np.isfinite(self._largest), self.limits.apart * self._largest, 0.0)
        return tuple(name for name, s, n in zip(self.columns, span, needed) if s <= max(n, 1e-12))

    @property
    def suffices(self) -> bool:
        """Whether to try a calibration: enough frames, and every input has moved or is accepted as fixed."""
        given_up = self.count >= self.limits.patience * self.wanted
        return self.count >= self.wanted and (not self.unmoved or given_up)

    def want_more(self, frames: int) -> None:
        """Require more frames, after a calibration that was not accurate enough."""
        self.wanted = self.count + frames

    @property
    def missing(self) -> str:
        """What is still missing, in words; empty if nothing is."""
        if self.suffices:
            return ""
        parts = [f"{max(0, self.wanted - self.count)} of {self.wanted} frames missing"] if self.count < self.wanted else []
        if self.unmoved:
            parts.append(f"not moved yet: {', '.join(self.unmoved)}")
        return "; ".join(parts)


def insufficiency(calibration: Calibration, limits: CoverageLimits | None = None) -> str:
    """Return why a calibration is not accurate enough for sensing, in words; empty if it is."""
    wanted = limits or CoverageLimits()
    if not calibration.settled:
        return calibration.status
    for name, block in zip(calibration.camera_names, _pose_blocks(calibration)):
        rotation, position = (float(np.sqrt(np.trace(b))) for b in (block[:3, :3], block[3:, 3:]))
        if position > wanted.position_m or rotation > wanted.rotation_rad:
            camera = f"camera {name}" if name else "the camera"
            return (
                f"{camera} pose: standard deviations of {1e3 * position:.2f} mm and {rotation / DEGREE:.2f}°, required are"
                f" {1e3 * wanted.position_m:.2f} mm and {wanted.rotation_rad / DEGREE:.2f}°"
            )
    return ""


def _pose_blocks(calibration: Calibration) -> list[FloatArray]:
    joint = calibration.joint_covariance
    return [joint[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] for v in range(len(calibration.poses))]
