"""Options of the search for effects, in Python and on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from femsense.core.options import Flag


class Measured(StrEnum):
    """Which measurements are fitted."""

    auto = "auto"
    """The markers of a recording, or its clouds if it has no markers."""
    markers = "markers"
    clouds = "clouds"
    both = "both"


@dataclass(frozen=True, eq=False, slots=True)
class SearchOptions:
    """Options of a search for effects: user-defined effects, and the measurements to use."""

    user_effects: Annotated[Sequence[Path], Flag("--user-effect", "FILE", "Try an effect of your own (femsense docs own).")] = ()
    """Python files with user-defined effects (docs/effects/own.md); "all" includes them."""
    measured: Annotated[Measured, Flag("--from", help="Measurements to use; auto: markers, or clouds without markers.")] = (
        Measured.auto
    )
    correct: Annotated[
        bool, Flag("--correct", help="Also fit an empirical correction of the remaining residual, tested on held-out data.")
    ] = False
    """The correction is neither a cause nor an effect."""
