"""The discretisation error of a robot as plain tables, with advice, and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from femsense.app.accuracy.errors import Answer, Errors, errors_of, reference_of, space_name
from femsense.app.accuracy.loads import Load, Patches
from femsense.report.text import columns


@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """Limits on the finer spaces that are solved, and the errors below which a space is fine enough."""

    most_unknowns: int = 400_000
    """A finer space with more unknowns is not solved …"""
    most_seconds: float = 400.0
    """… nor one that would take all spaces together beyond this processor time, judged by the steps of the space before [s]."""
    good_motion: float = 0.03
    """A space is fine enough where motions are off by less than this share …"""
    good_force: float = 0.05
    """… and forces by less than this one."""


def accuracy_report(
    patches: Patches,
    coarse: str,
    loads: Sequence[Load],
    answers: Sequence[Answer],
    left_out: Sequence[str],
    options: AccuracyOptions,
) -> dict[str, Any]:
    """Return the report on discretisation error as it is printed and written: errors a space, loads, forces, advice."""
    declared = next(answer for answer in answers if answer.is_space(coarse, 0))
    reference = reference_of(answers)
    errors = [errors_of(answer, reference) for answer in answers]
    spaces = [_space(answer, error, answer is declared) for answer, error in zip(answers, errors)]
    own = errors[[answer is declared for answer in answers].index(True)]
    report = {
        "declared": {"element": coarse, "tetrahedra": declared.tetrahedra, "unknowns": declared.unknowns},
        "reference": reference.description | {"spaces_left_out": len(left_out), "left_out": list(left_out)},
        "loads": [_load_row(load, own, i) for i, load in enumerate(loads)],
        "forces": _force_table(own, patches, declared),
        "spaces": spaces,
    }
    report["good_enough"] = {"motion_percent": 100.0 * options.good_motion, "force_percent": 100.0 * options.good_force}
    report["advice"] = advice_on(report, options)
    return report


def _space(answer: Answer, error: Errors, is_declared: bool) -> dict[str, Any]:
    known = error.known
    return {
        "element": answer.element,
        "refinements": answer.refinements,
        "tetrahedra": answer.tetrahedra,
        "unknowns": answer.unknowns,
        "step_ms": answer.step_ms,
        "motion_percent": 100.0 * float(error.share.max()) if known and len(error.share) else None,
        "motion_mm": 1e3 * float(error.largest.max()) if known and len(error.share) else None,
        "force_percent": 100.0 * float(np.abs(error.force).max()) if known and len(error.force) else None,
        "declared": is_declared,
    }


def _best(spaces: list[dict[str, Any]], options: AccuracyOptions) -> dict[str, Any] | None:
    """Return the cheapest space that is good enough, None where none is known to be; the spaces get a mark."""
    for space in spaces:
        known = space["motion_percent"] is not None or space["force_percent"] is not None
        space["good_enough"] = known and _lack(space, options) <= 1.0
    good = [space for space in spaces if space["good_enough"]]
    return min(good, key=lambda space: space["unknowns"]) if good else None


def _load_row(load: Load, error: Errors, i: int) -> dict[str, Any]:
    return {
        "kind": load.kind,
        "name": load.name,
        "size": load.size,
        "unit": load.unit,
        "motion_mm": 1e3 * float(error.motion[i]),
        "error_mm": 1e3 * float(error.largest[i]) if error.known else None,
        "error_rms_mm": 1e3 * float(error.rms[i]) if error.known else None,
        "error_percent": 100.0 * float(error.share[i]) if error.known else None,
        "doubt_mm": 1e3 * float(error.doubt[i]),
    }


def _force_table(error: Errors, patches: Patches, declared: Answer) -> dict[str, Any]:
    known = error.known and len(error.force) > 0
    return {
        "places_mm": 1e3 * patches.centres,
        "motion_mm_per_n": 1e3 * np.linalg.norm(declared.per_newton, axis=2).max(axis=1),
        "error_percent": [100.0 * float(value) for value in error.force] if known else None,
        "worst_percent": 100.0 * float(error.force[np.argmax(np.abs(error.force))]) if known else None,
    }


def advice_on(report: Mapping[str, Any], options: AccuracyOptions) -> str:
    """Return the recommended space in words; the spaces of the report that are fine enough get a mark."""
    best = _best(report["spaces"], options)
    declared = next(space for space in report["spaces"] if space["declared"])
    plain = next((space for space in report["spaces"] if space["element"] == "tet10" and not space["refinements"]), None)
    if declared["force_percent"] is None and declared["motion_percent"] is None:
        hint = "a coarser mesh of the same body would show its error"
        return f"the declared space is the finest that is affordable here: nothing to compare it with; {hint}"
    if declared["good_enough"]:
        return "the declared mesh is fine enough"
    if best is not None and not best["refinements"]:
        return f"better: {_change(best, declared)}"
    if plain is None or _lack(plain, options) == 0.0:
        return f"no space that was tried is known to be fine enough; the nearest is {_change(plain or declared, declared)}"
    factor = 1.1 * _lack(plain, options) ** 1.5
    wanted, unknowns = (int(float(f"{factor * plain[key]:.2g}")) for key in ("tetrahedra", "unknowns"))
    mesh = f"a mesh of about {wanted} tetrahedra (femsense mesh --max-tets {wanted})"
    changes = mesh if declared["element"] == "tet10" else f'element = "tet10" and {mesh}'
    cost = f"about {unknowns} unknowns instead of {declared['unknowns']}"
    return f"better: {changes}: {cost}, judged by errors that fall with the square of the edges"


def _lack(space: Mapping[str, Any], options: AccuracyOptions) -> float:
    """Return the error of a space over the error that is fine enough; 0 where it is not known."""
    motion, force = space["motion_percent"] or 0.0, space["force_percent"] or 0.0
    return max(motion / (100 * options.good_motion), force / (100 * options.good_force))


def _change(space: Mapping[str, Any], declared: Mapping[str, Any]) -> str:
    unknowns = f"{space['unknowns']} unknowns instead of {declared['unknowns']}"
    time = f"{space['step_ms']:.0f} ms a Newton step instead of {declared['step_ms']:.0f} ms"
    return f'element = "{space["element"]}": {unknowns}, {time}'


def accuracy_text(report: Mapping[str, Any]) -> str:
    """Return a report of `assess_accuracy` as tables."""
    d, good, left_out = report["declared"], report["good_enough"], report["reference"]["left_out"]
    lines = [
        f"the declared mesh: {d['element']}, {d['tetrahedra']} tetrahedra, {d['unknowns']} unknowns",
        f"compared with: {report['reference']['text']}",
        "",
        columns([("load", "motion", "error", "of the motion", "doubt"), *map(_load_cells, report["loads"])], right=True),
    ]
    if not report["loads"]:
        lines.append("  none: the robot has neither weight nor cables nor chambers; forces alone are looked at")
    if len(report["forces"]["places_mm"]):
        lines += ["", columns([("force at [mm]", "moves it", "sensed force"), *_force_cells(report["forces"])], right=True)]
        lines.append("  (+: sensed too large, the mesh is too stiff)")
    head = ("space", "tetrahedra", "unknowns", "ms a step", "motion", "force")
    lines += ["", columns([head, *map(_space_cells, report["spaces"])], right=True)]
    enough = f"{good['motion_percent']:.0f} % of motion, {good['force_percent']:.0f} % of force"
    lines.append(f"  * declared; errors are the worst of all loads and places; fine enough: {enough}")
    lines += [f"  left out: {'; '.join(left_out)}"] if left_out else []
    return "\n".join([*lines, "", report["advice"]])


def _load_cells(row: Mapping[str, Any]) -> list[str]:
    sizes = [_mm(row["motion_mm"]), _mm(row["error_mm"]), _percent(row["error_percent"]), _mm(row["doubt_mm"])]
    return [f"{row['name']} {_size(row)}".strip(), *sizes]


def _force_cells(forces: Mapping[str, Any]) -> list[list[str]]:
    errors = forces["error_percent"] or [None] * len(forces["places_mm"])
    return [
        [f"[{', '.join(f'{x:.0f}' for x in place)}]", f"{motion:.3g} mm/N", "?" if error is None else f"{error:+.1f} %"]
        for place, motion, error in zip(forces["places_mm"], forces["motion_mm_per_n"], errors)
    ]


def _space_cells(space: Mapping[str, Any]) -> list[str]:
    name = space_name(space["element"], space["refinements"]) + (" *" if space["declared"] else "")
    counts = [str(space["tetrahedra"]), str(space["unknowns"]), f"{space['step_ms']:.0f}"]
    return [name, *counts, _percent(space["motion_percent"]), _percent(space["force_percent"])]


def _size(row: Mapping[str, Any]) -> str:
    if not row["unit"]:
        return ""
    return f"{row['size'] / 1e3:.3g} kPa" if row["unit"] == "Pa" else f"{row['size']:.3g} {row['unit']}"


def _mm(value: float | None) -> str:
    return "?" if value is None or not np.isfinite(value) else f"{value:.3g} mm"


def _percent(value: float | None) -> str:
    return "?" if value is None or not np.isfinite(value) else f"{value:.1f} %"
