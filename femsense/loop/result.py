"""What closing the loop returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from femsense.model.robot import Robot

FORMAT = "femsense-loop-1"


@dataclass(frozen=True, eq=False, slots=True)
class LoopResult:
    """The verdict, the effects with their errors before and after, and what the data cannot say."""

    verdict: str
    """"effects", "none" or "unexplained"."""
    sentence: str
    """The verdict in words."""
    noise_m: float
    before: dict[str, Any]
    """{train_rms_m, validation_rms_m, validation_ci_m} of the declared model, calibrated."""
    after: dict[str, Any]
    effects: tuple[dict[str, Any], ...]
    """{name, parameters: {key: {value, std, unit}}, validation_rms_before_m, validation_rms_after_m}, in the order added."""
    entries: tuple[dict[str, Any], ...]
    """The effects as tables of `[[effects]]`."""
    candidates: tuple[dict[str, Any], ...]
    confounded: tuple[dict[str, Any], ...]
    next_experiment: str
    not_testable: tuple[dict[str, Any], ...]
    detectable: dict[str, Any]
    left: dict[str, Any]
    robot: Robot
    """The improved robot."""
    declared: Robot
    """The robot that came in."""
    data: dict[str, Any] = field(default_factory=dict)
    """Data card: split, noise components, frames, nuisance before and after, seed."""
    residuals: dict[str, Any] = field(default_factory=dict)
    """Held-out residuals before and after, for figures: {frame, marker, before_m, after_m, position_m}."""

    evidence: dict[str, Any] = field(default_factory=dict)
    """What the report draws and tabulates besides; see `femsense.loop.verdict.report_data`."""

    def document(self) -> dict[str, Any]:
        """Return the content of loop.json."""
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "noise_m": self.noise_m,
            "before": self.before,
            "after": self.after,
            "effects": list(self.effects),
            "candidates": list(self.candidates),
            "confounded": list(self.confounded),
            "next_experiment": self.next_experiment,
            "not_testable": list(self.not_testable),
            "detectable": self.detectable,
            "left": self.left,
            "data": self.data,
            "residuals": self.residuals,
            "evidence": self.evidence,
        }
