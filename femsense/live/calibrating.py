"""Coverage of the contact-free frames for a calibration during a session, and the test of its accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray

DEGREE = np.pi / 180.0
TINY = 1e-12


@dataclass(frozen=True, slots=True)
class CoverageLimits:
    """Requirements on the contact-free frames of a session."""

    frames: int = 12
    """The number of frames that calibration uses of clouds; the model error needs at least four of them."""
    more: int = 6
    """Number of further frames after a calibration that was not accurate enough."""
    apart: float = 0.1
    """Each input has to move by this share of its largest value; frames are different if an input differs by this share of its range."""
    wait_s: float = 0.5
    """Time after which a frame with unchanged inputs is kept too: repetitions show the noise."""
    position_m: float = 5e-4
    rotation_rad: float = 0.3 * DEGREE
    """Largest standard deviations of the camera pose."""


@dataclass(frozen=True, slots=True)
class MovingInput:
    """An input that has to move before a calibration."""

    column: str
    largest: float = float("inf")
    """Its largest value [unit]; inf: not declared, any change counts as a movement."""
    unit: str = "N"


class Coverage:
    """Selects contact-free frames by their inputs, and states which are missing.

    Two requirements are independent: the number of frames, and the range of each input in them. While only ranges are missing, a frame is
    kept only if its inputs are new, so that waiting for a movement costs no frames.
    """

    def __init__(self, inputs: Sequence[MovingInput], limits: CoverageLimits | None = None) -> None:
        """Begin without frames; `inputs` are those that have to move."""
        self.limits, self.inputs = limits or CoverageLimits(), tuple(inputs)
        largest = np.array([one.largest for one in self.inputs])
        self._needed = np.where(np.isfinite(largest), self.limits.apart * largest, 0.0)
        self._taken: list[FloatArray] = []
        self._last_s = float("-inf")
        self._are_fixed = False
        self.wanted = self.limits.frames

    def offer(self, time_s: float, values: FloatArray) -> bool:
        """Return whether to keep a contact-free frame with these inputs, shape (inputs,)."""
        if self._taken and not self._is_new(values) and (self.count >= self.wanted or time_s - self._last_s < self.limits.wait_s):
            return False
        self._taken.append(values)
        self._last_s = time_s
        return True

    @property
    def count(self) -> int:
        """Number of frames that were kept."""
        return len(self._taken)

    @property
    def suffices(self) -> bool:
        """Whether to try a calibration: enough frames, in which every input has moved or is accepted as fixed."""
        return self.count >= self.wanted and not self._unmoved()

    def want_more(self) -> None:
        """Require more frames, after a calibration that was not accurate enough."""
        self.wanted = self.count + self.limits.more

    def accept_fixed(self) -> None:
        """Accept the inputs that have not moved as fixed."""
        self._are_fixed = True

    @property
    def missing(self) -> str:
        """What is still missing, in words; empty if nothing is."""
        parts = [f"{self.wanted - self.count} of {self.wanted} frames missing"] if self.count < self.wanted else []
        if unmoved := self._unmoved():
            parts.append(f"still to be moved: {', '.join(unmoved)}")
        return "; ".join(parts)

    def _spans(self, *more: FloatArray) -> FloatArray:
        values = [*self._taken, *more]
        return np.ptp(values, axis=0) if values else np.zeros(len(self.inputs))

    def _is_new(self, values: FloatArray) -> bool:
        apart = self.limits.apart * np.maximum(self._spans(values), np.maximum(self._needed, TINY))
        return all((np.abs(values - one) > apart).any() for one in self._taken)

    def _unmoved(self) -> list[str]:
        """Return the inputs that have not moved enough, with the required range and that so far."""
        found = []
        for one, span, needed in zip(self.inputs, self._spans(), self._needed):
            if not self._are_fixed and span < max(needed, TINY):
                far = f" by {needed:.3g} {one.unit}" if needed else ""
                found.append(f"{one.column}{far}" + (f" (so far {span:.3g})" if span > TINY else ""))
        return found


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
