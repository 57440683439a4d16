"""The truth that the virtual rig leaves beside a recording, and how far a run is from it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.io.tables import read_csv

if TYPE_CHECKING:
    from femsense.sensing.types import ContactForce, Run

SAME_PLACE = 0.1
"""A contact is the true one if it is closer than this times the robot's size."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueContact:
    """A contact as it was."""

    frame: int
    position_m: FloatArray
    force_n_xyz: FloatArray


def read_truth(recording: Path) -> tuple[TrueContact, ...]:
    """Return the true contacts of a recording of the virtual rig; none where it has no truth beside it."""
    file = recording / "truth" / "contacts.csv"
    if not file.is_file():
        return ()
    columns_used = ("x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n")
    table = read_csv(
        file, required=("frame", *columns_used), optional=("time_s", "contact", "nx", "ny", "nz", "force_n"), prefixes=("rest_",)
    )
    frames, values = table.integers("frame"), table.numbers(columns_used)
    return tuple(TrueContact(int(frame), row[:3], row[3:]) for frame, row in zip(frames, values))


def true_effects(recording: Path) -> list[dict[str, Any]]:
    """Return the effects that the truth has, a law other than the plain one among them, as entries of `[[effects]]`; none where nothing is known of it."""
    try:
        known = json.loads((recording / "truth" / "truth.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return []
    law = known.get("model", {}).get("law", "corotational")
    return [*known.get("effects", []), *([{"name": "hyperelastic", "law": law}] if law != "corotational" else [])]


def force_errors(run: Run, truth: Sequence[TrueContact]) -> dict[str, Any]:
    """Return how a run compares with the truth: contacts found, median errors of place and force."""
    size = float(np.linalg.norm(np.ptp(run.states.rest_nodes_m, axis=0)))
    pairs = [(true, found) for true in truth if (found := _nearest(run.contacts, true, SAME_PLACE * size)) is not None]
    force = [float(np.linalg.norm(found.force_n_xyz - true.force_n_xyz)) for true, found in pairs]
    share = [error / float(np.linalg.norm(true.force_n_xyz)) for error, (true, _) in zip(force, pairs)]
    place = [float(np.linalg.norm(found.position_m - true.position_m)) for true, found in pairs]
    return {
        "contacts_true": len(truth),
        "contacts_found": len(pairs),
        "contacts_false": len(run.contacts) - len({id(found) for _, found in pairs}),
        "force_error_n": _median(force),
        "force_error_share": _median(share),
        "place_error_m": _median(place),
    }


def _nearest(contacts: Sequence[ContactForce], true: TrueContact, reach: float) -> ContactForce | None:
    near = [contact for contact in contacts if contact.frame == true.frame]
    best = min(near, key=lambda contact: float(np.linalg.norm(contact.position_m - true.position_m)), default=None)
    return best if best is not None and np.linalg.norm(best.position_m - true.position_m) < reach else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None
