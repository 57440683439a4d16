"""The truth that the virtual rig writes next to a recording, and the errors of a run against it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.sensing.comparison import TrueContact, compare

if TYPE_CHECKING:
    from femsense.sensing.types import Run


def true_effects(recording: Path) -> list[dict[str, Any]]:
    """Return the effects that the truth has, a law other than the plain one among them, as entries of `[[effects]]`;
    none where nothing is known of it."""
    try:
        known = json.loads((recording / "truth" / "truth.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    law = known.get("model", {}).get("law", "corotational")
    return [*known.get("effects", []), *([{"name": "hyperelastic", "law": law}] if law != "corotational" else [])]


def force_errors(run: Run, truth: Sequence[TrueContact]) -> dict[str, Any]:
    """Return how a run compares with the truth: contacts found, median errors of place and force."""
    found = compare(run, truth)
    return {
        "contacts_true": found.contacts_true,
        "contacts_found": found.contacts_found,
        "contacts_false": found.contacts_false,
        "force_error_n": _median(found.force_errors_n),
        "force_error_share": _median(found.force_shares),
        "place_error_m": _median(found.place_errors_m),
    }


def _median(values: FloatArray) -> float | None:
    return float(np.median(values)) if len(values) else None
