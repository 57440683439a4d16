"""The result of closing the loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
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


class Verdict(StrEnum):
    """The conclusion of a search."""

    FOUND = "effects"
    """The model lacks effects."""
    NONE = "none"
    """It fits the data to their noise."""
    UNEXPLAINED = "unexplained"
    """A residual remains that no effect fits."""


@dataclass(frozen=True, eq=False, slots=True)
class Loop:
    """The content of loop.json: the verdict, the effects with errors before and after, and the limits of the data."""

    verdict: Verdict | str = ""
    """Text: of another version, or empty if it is missing."""
    sentence: str = ""
    """The verdict in words."""
    noise_m: Number = NAN
    """Noise of the data [m]: the repeatability of a state."""
    before: Errors = field(default_factory=Errors)
    """Errors of the declared model, calibrated."""
    after: Errors = field(default_factory=Errors)
    """Errors of the returned model."""
    effects: tuple[NamedEffect, ...] = ()
    """In the order in which they were added."""
    candidates: tuple[TriedEffect, ...] = ()
    """Every effect that was tried."""
    confounded: tuple[ConfoundedPair, ...] = ()
    """Pairs that the data cannot distinguish."""
    next_experiment: str = ""
    """What to record to distinguish them, in words."""
    not_testable: tuple[Untestable, ...] = ()
    """Effects that calibration absorbs in these data."""
    detectable: Mapping[str, Detectable] = field(default_factory=dict)
    """Effect that was not found → its smallest detectable size."""
    left: Left = field(default_factory=Left)
    """The remaining residual."""
    data: DataCard = field(default_factory=DataCard)
    model_error: ModelError | None = field(default=None, metadata=AS_EMPTY)
    """The parts of the held-out error."""
    fitted_along: Mapping[str, Mapping[str, Value]] = field(default_factory=dict)
    """Nuisance effects of the improved robot that are not listed in `effects` (the modulus, input offsets), with their values: they were fitted too, but do
    not differ significantly from the declared values, or held-out data do not need them."""
    correction: CorrectionRecord | None = field(default=None, metadata=LEFT_OUT)
    """An empirical correction of the remaining residual, if requested."""
    everywhere: AllRecordings | None = field(default=None, metadata=LEFT_OUT)
    """Results in all recordings, if only some were searched."""
    residuals: Residuals | None = field(default=None, metadata=AS_EMPTY)
    """Held-out residuals before and after, for the figures."""
    evidence: Evidence | None = field(default=None, metadata=AS_EMPTY)
    """Further data for the figures and tables of the report."""


@dataclass(frozen=True, eq=False, slots=True)
class SavedLoop(Loop):
    """loop.json as read back, with the inputs it was computed from."""

    inputs: LoopInputs = field(default_factory=LoopInputs)
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class LoopResult(Loop):
    """Result of `improve`: the verdict, the effects found, held-out errors (all keys of loop.json), and the improved robot."""

    entries: tuple[Entry, ...]
    """Accepted effects as tables `[[effects]]` of robot.toml."""
    robot: Robot
    """The improved robot."""
    declared: Robot
    """The declared robot."""

    def __repr__(self) -> str:
        named = ", ".join(effect.name for effect in self.effects) or "no effect"
        errors = [1e3 * error.validation_rms_m for error in (self.before, self.after)]
        return f"LoopResult({self.verdict}: {named}; held-out error {errors[0]:.3g} → {errors[1]:.3g} mm)"

    def document(self) -> dict[str, Any]:
        """Return the content of loop.json."""
        tables = table_of(self, without=("entries", "robot", "declared"))
        return {"format": FORMAT, **tables, "evidence": rounded(tables["evidence"])}


def rounded(value: Any, digits: int = 7) -> Any:
    """Round numbers in plain tables to `digits` significant digits; NaN and infinity become null."""
    if isinstance(value, dict):
        return {key: rounded(item, digits) for key, item in value.items()}
    if isinstance(value, list):
        return [rounded(item, digits) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.{digits}g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
