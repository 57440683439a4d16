"""The discretisation error of a robot as plain tables, with advice, and as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from femsense.app.accuracy.errors import Answer, Errors, errors_of, reference_of, space_name
from femsense.app.accuracy.loads import Load, Patches


@dataclass(frozen=True, slots=True)
class AccuracyOptions:
    """How far finer spaces are looked at, and what is fine enough."""

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
    """Return which space would serve, in words; the spaces of the report get a mark where they do."""
    best = _best(report["spaces"], options)
    declared = next(space for space in report["spaces"] if space["declared"])
    plain = next((space for space in report["spaces"] if space["element"] == "tet10" and not space["refinements"]), None)
    if declared["force_percent"] is None and declared["motion_percent"] is None:
        return (
            "the declared space is the finest that is affordable here: nothing to compare it with; a coarser mesh of the "
            "same body would show its error"
        )
    if declared["good_enough"]:
        return "the declared mesh is fine enough"
    if best is not None and not best["refinements"]:
        return f"better: {_change(best, declared)}"
    if plain is None or _lack(plain, options) == 0.0:
        return f"no space that was tried is known to be fine enough; the nearest is {_change(plain or declared, declared)}"
    factor = 1.1 * _lack(plain, options) ** 1.5
    wanted, unknowns = (int(float(f"{factor * plain[key]:.2g}")) for key in ("tetrahedra", "unknowns"))
    changes = ['element = "tet10"'] * (declared["element"] != "tet10") + [
        f"a mesh of about {wanted} tetrahedra (femsense mesh --max-tets {wanted})"
    ]
    return (
        f"better: {' and '.join(changes)}: about {unknowns} unknowns instead of {declared['unknowns']}, judged by errors "
        f"that fall with the square of the edges"
    )


def _lack(space: Mapping[str, Any], options: AccuracyOptions) -> float:
    """Return the error of a space over what is fine enough; 0 where it is not known."""
    motion, force = space["motion_percent"] or 0.0, space["force_percent"] or 0.0
    return max(motion / (100 * options.good_motion), force / (100 * options.good_force))


def _change(space: Mapping[str, Any], declared: Mapping[str, Any]) -> str:
    element = f'element = "{space["element"]}"'
    return (
        f"{element}: {space['unknowns']} unknowns instead of {declared['unknowns']}, {space['step_ms']:.0f} ms a Newton step "
        f"instead of {declared['step_ms']:.0f} ms"
    )


def accuracy_text(report: Mapping[str, Any]) -> str:
    """Return a report of `assess_accuracy` as tables."""
    d, good = report["declared"], report["good_enough"]
    lines = [
        f"the declared mesh: {d['element']}, {d['tetrahedra']} tetrahedra, {d['unknowns']} unknowns",
        f"compared with: {report['reference']['text']}",
    ]
    lines += ["", f"  {'load':<28}{'motion':>10}{'error':>12}{'of the motion':>15}{'doubt':>11}"]
    if not report["loads"]:
        lines.append("  none: the robot has neither weight nor cables nor chambers; forces alone are looked at")
    for row in report["loads"]:
        load = f"{row['name']} {_size(row)}".strip()
        lines.append(
            f"  "
            f"{load:<28}{_mm(row['motion_mm']):>10}{_mm(row['error_mm']):>12}{_percent(row['error_percent']):>15}{_mm(row['doubt_mm']):>13}"
        )
    lines += _force_lines(report["forces"])
    lines += ["", f"  {'space':<24}{'tetrahedra':>10}{'unknowns':>10}{'ms a step':>11}{'motion':>9}{'force':>9}"]
    for space in report["spaces"]:
        name = f"{space_name(space['element'], space['refinements'])}{' *' if space['declared'] else ''}"
        lines.append(
            f"  {name:<24}{space['tetrahedra']:>10}{space['unknowns']:>10}{space['step_ms']:>11.0f}"
            f"{_percent(space['motion_percent']):>9}{_percent(space['force_percent']):>9}"
        )
    lines += [
        (
            f"  * declared; errors are the worst of all loads and places; fine enough: {good['motion_percent']:.0f} % of "
            f"motion, {good['force_percent']:.0f} % of force"
        )
    ]
    if report["reference"]["left_out"]:
        lines.append(f"  left out: {'; '.join(report['reference']['left_out'])}")
    lines += ["", report["advice"]]
    return "\n".join(lines)


def _force_lines(forces: Mapping[str, Any]) -> list[str]:
    """Return the table of contact forces."""
    lines = ["", f"  {'force at [mm]':<28}{'moves it':>14}{'sensed force':>18}"]
    for i, place in enumerate(forces["places_mm"]):
        at = f"[{', '.join(f'{value:.0f}' for value in place)}]"
        off = "?" if forces["error_percent"] is None else f"{forces['error_percent'][i]:+.1f} %"
        lines.append(f"  {at:<28}{forces['motion_mm_per_n'][i]:>9.3g} mm/N{off:>18}")
    return [*lines, "  (+: sensed too large, the mesh is too stiff)"] if len(lines) > 2 else []


def _size(row: Mapping[str, Any]) -> str:
    if not row["unit"]:
        return ""
    return f"{row['size'] / 1e3:.3g} kPa" if row["unit"] == "Pa" else f"{row['size']:.3g} {row['unit']}"


def _mm(value: float | None) -> str:
    return "?" if value is None or not np.isfinite(value) else f"{value:.3g} mm"


def _percent(value: float | None) -> str:
    return "?" if value is None or not np.isfinite(value) else f"{value:.1f} %"
