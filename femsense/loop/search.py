"""What the search for effects went through, as the conclusion needs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from femsense.loop.noise import Noise
from femsense.loop.screen import Candidate
from femsense.loop.stages import Stage
from femsense.loop.zeros import InPlace


@dataclass(frozen=True, eq=False, slots=True)
class Search:
    """What the search went through."""

    before: Stage
    """The declared model, calibrated."""
    history: list[tuple[str, Stage]]
    """("", the model with what calibration may move on the declared mesh), then each effect with the stage that added it."""
    base: Stage
    """The model of the first screening: with what calibration may move, on quadratic elements if effects were sought with these."""
    final: Stage
    noise: Noise
    n_effective: float
    first: list[Candidate]
    """The first screening."""
    last: list[Candidate]
    """The last one."""
    refits: list[dict[str, Any]]
    in_place: InPlace | None
    """What might be in the place of the cable zeros."""


__all__ = ["Search"]
