"""What calibration had taken up: its values before, with all that it may move, and with the effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from femsense.report import words
from femsense.report.documents import Triple
from femsense.report.loop.evidence import CalibrationShift
from femsense.report.page import Html, code, element, table

MODELS = ("before", "nuisance", "after")


def calibration_table(shift: CalibrationShift) -> Html | None:
    """Return where calibration stood before, with all that it may move, and with the effects."""
    several = len({p.recording for p in shift.poses}) > 1 or len({p.camera for p in shift.poses}) > 1
    rows: list[list[object]] = []
    for pose in shift.poses:
        where = f", recording {pose.recording + 1}" + (f", camera {pose.camera + 1}" if pose.camera else "") if several else ""
        for title, moved, spread, unit in (
            ("Camera turned", pose.turn_rad, pose.turn_std_rad, "rad"),
            ("Camera shifted", pose.shift_m, pose.shift_std_m, "m"),
        ):
            cells = [_vector(moved.get(name), spread.get(name), unit) for name in MODELS[1:]]
            rows.append([f"{title}{where}", words.NOTHING, "0", *cells])
    for given in shift.initial_inputs:
        where = f", recording {given.recording + 1}" if len({g.recording for g in shift.initial_inputs}) > 1 else ""
        rows.append([f"Initial input of {given.cable}{where}", words.NOTHING, *_three(given.values, given.unit)])
    for term in shift.parameters:
        rows.append(
            [element("span", code(term.label)), words.quantity(term.declared, term.unit), *_three(term.values, term.unit)]
        )
    return table(
        ("Quantity", "Declared", "Calibrated (before)", "With all that calibration may move", "With the effects"),
        rows,
        caption=(
            "Camera: against where the calibration of the declared model put it (± one standard deviation). What moves back "
            "when effects are added is where they had been hiding. In the last two columns everything is free, so that "
            "values may differ from those that are returned."
        ),
    )


def _vector(value: Triple | None, std: Triple | None, unit: str) -> str:
    return words.NOTHING if value is None else words.parameter(list(value), list(std) if std else None, unit)


def _three(values: Mapping[str, Sequence[Any]], unit: str) -> list[str]:
    found = [values.get(name) for name in MODELS]
    return [words.with_std(v[0], v[1] if len(v) > 1 else None, unit) if v else words.NOTHING for v in found]
