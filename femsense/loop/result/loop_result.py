"""What closing the loop returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from femsense.loop.result.evidence import Evidence
from femsense.loop.result.records import (
    AllRecordings,
    ConfoundedPair,
    CorrectionRecord,
    DataCard,
    Detectable,
    Errors,
    Left,
    LoopInputs,
    ModelError,
    NamedEffect,
    Residuals,
    TriedEffect,
    Untestable,
    Value,
)
from femsense.loop.result.tables import AS_EMPTY, LEFT_OUT, NAN, Number, table_of
from femsense.model.effects import Entry
from femsense.model.robot import Robot

FORMAT = "femsense-loop-1"
FOUND, NONE, UNEXPLAINED = "effects", "none", "unexplained"
"""Verdicts: the model lacks effects; it explains the data to their noise; a residual is left that no effect explains."""


@dataclass(frozen=True, eq=False, slots=True)
class Loop:
    """What loop.json holds: the verdict, the effects with their errors before and after, and what the data cannot say."""

    verdict: str = ""
    """FOUND, NONE or UNEXPLAINED."""
    sentence: str = ""
    """The verdict in words."""
    noise_m: Number = NAN
    """Noise of the data [m]: what repeats of a state differ by."""
    before: Errors = field(default_factory=Errors)
    """Of the declared model, calibrated."""
    after: Errors = field(default_factory=Errors)
    """Of the model that is handed back."""
    effects: tuple[NamedEffect, ...] = ()
    """In the order in which they were added."""
    candidates: tuple[TriedEffect, ...] = ()
    """Every effect that was tried."""
    confounded: tuple[ConfoundedPair, ...] = ()
    """Pairs that the data cannot distinguish."""
    next_experiment: str = ""
    """What to record to distinguish them, in words."""
    not_testable: tuple[Untestable, ...] = ()
    """Effects that the data cannot show."""
    detectable: Mapping[str, Detectable] = field(default_factory=dict)
    """Effect that was not found → the smallest size that would have been seen."""
    left: Left = field(default_factory=Left)
    """What the remaining residual looks like."""
    data: DataCard = field(default_factory=DataCard)
    model_error: ModelError | None = field(default=None, metadata=AS_EMPTY)
    """What is left that is no noise."""
    fitted_along: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    """What the improved robot has beside `effects`, since these were fitted with it (the modulus, input offsets) → its values. It is not named: no value
    of it is surely away from what is declared, or held-out data do not need it."""
    correction: CorrectionRecord | None = field(default=None, metadata=LEFT_OUT)
    """An empirical correction of what is left, where one was asked for."""
    everywhere: AllRecordings | None = field(default=None, metadata=LEFT_OUT)
    """What all recordings say, where effects were sought in some of them."""
    residuals: Residuals | None = field(default=None, metadata=AS_EMPTY)
    """Held-out residuals before and after, for figures."""
    evidence: Evidence | None = field(default=None, metadata=AS_EMPTY)
    """What the report draws and tabulates besides."""


@dataclass(frozen=True, eq=False, slots=True)
class SavedLoop(Loop):
    """loop.json as it is read back: what the loop says, and what it was made from."""

    inputs: LoopInputs = field(default_factory=LoopInputs)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class LoopResult(Loop):
    """What closing the loop returns: what loop.json holds, with the robots."""

    entries: tuple[Entry, ...]
    """The effects as tables of `[[effects]]`."""
    robot: Robot
    """The improved robot."""
    declared: Robot
    """The robot that came in."""

    def __repr__(self) -> str:
        named = ", ".join(effect.name for effect in self.effects) or "no effect"
        errors = [1e3 * error.validation_rms_m for error in (self.before, self.after)]
        return f"LoopResult({self.verdict}: {named}; held-out error {errors[0]:.3g} → {errors[1]:.3g} mm)"

    def document(self) -> dict[str, Any]:
        """Return the content of loop.json."""
        tables = table_of(self, without=("entries", "robot", "declared"))
        return {"format": FORMAT, **tables, "evidence": rounded(tables["evidence"])}


def rounded(value: Any, digits: int = 7) -> Any:
    """Return plain tables with so many digits, NaN and infinity as null."""
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item, digits) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
