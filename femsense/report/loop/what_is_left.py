"""Tests of the residual, and what is left of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from femsense.loop.result.loop_result import UNEXPLAINED
from femsense.report import words
from femsense.report.drawing import (
    SERIES,
    DrawnSurface,
    Key,
    arrow_options,
    as_image,
    best_view,
    body_height,
    draw_bars,
    draw_body,
    frame_body,
    new_axes,
    nice,
)
from femsense.report.loop.document import Left, Loop
from femsense.report.loop.evidence import Evidence, ForceField, LackOfFit, Structure, Tested, Tests
from femsense.report.page import Html, bullets, panels, table, together

TESTS = {
    "neighbours": "neighbouring states are alike",
    "pattern": "one pattern in many states",
    "sweep": "one sweep stands apart",
    "marker": "one marker stands apart",
    "cloud neighbours": "neighbouring states of the clouds are alike",
    "cloud sweep": "one sweep of the clouds stands apart",
}


def tests_table(tests: Tests) -> Html | None:
    """Return the tests of structure and of lack of fit, before and after."""
    pair = (tests.before, tests.after)
    names = [
        n
        for n in (*TESTS, *tests.before.structure.tests)
        if n in tests.before.structure.tests or n in tests.after.structure.tests
    ]
    rows: list[list[object]] = [["Size of the residual, fitted data", *(words.length(t.train_rms_m) for t in pair)]]
    rows += [[f"Structure: {TESTS.get(n, n)}", *(_p(t.structure.tests.get(n)) for t in pair)] for n in dict.fromkeys(names)]
    rows.append(["Correlation of neighbouring states", *(words.number(t.structure.lag_one, 2) for t in pair)])
    rows.append(["Any structure (1 %, Holm)", *(_yes(t.structure) for t in pair)])
    rows.append(["Lack of fit against repeats (F)", *(_lack(t.lack_of_fit) for t in pair)])
    if pair == (Tested(), Tested()):
        return None
    return table(
        ("Test", "Before", "After"), rows, caption="Tests of the residual of the fitted data, the mesh's own error taken off."
    )


def _p(value: float | None) -> str:
    return f"p = {words.number(value, 2)}" if words.known(value) else words.NOTHING


def _yes(structure: Structure) -> str:
    return words.NOTHING if structure.significant is None else "yes" if structure.significant else "no"


def _lack(fit: LackOfFit | None) -> str:
    if fit is None:
        return "not testable: too little is repeated"
    return (
        f"F = {words.number(fit.f, 2)}, {_p(fit.p_value)} ({fit.df_lack}, {fit.df_pure} degrees of freedom; repeats differ "
        f"by {words.length(fit.pure_error_m)})"
    )


MARKERS = 30


def what_is_left(loop: Loop, evidence: Evidence, surface: DrawnSurface | None) -> Html | None:
    """Return how large the residual is after the effects, where, when, and what it goes with."""
    left = loop.left
    rows = [
        [c.covariate, words.number(c.rank_correlation, 2), words.number(c.p_value, 2), words.number(c.p_holm, 2)]
        for c in left.goes_with
    ]
    headers = ("Goes with", "Rank correlation", "p", "p (Holm)")
    goes = table(headers, rows, caption="What the size of the residual of a frame goes with.", numeric=(1, 2, 3))
    structured = left.structure.significant or (loop.verdict == UNEXPLAINED and not left.held_out)
    field = force_field(evidence.equivalent_forces, surface) if structured else None
    return (
        together(bullets(_left_facts(left, effects=bool(loop.effects))), panels(goes, _marker_bars(left.marker_rms_m), field))
        or None
    )


def _left_facts(left: Left, *, effects: bool) -> list[str]:
    facts = []
    if words.known(left.rms_m):
        facts.append(f"Size: {words.length(left.rms_m)} rms on the {'held-out' if left.held_out else 'fitted'} data.")
    where = left.where
    if where.marker:
        mean = f", mean {words.parameter(list(where.mean_residual_m), None, 'm')}" if where.mean_residual_m else ""
        place = f"marker {where.marker}"
        if where.marker.startswith("surface "):
            place = where.marker + (f" ({words.parameter(list(where.position_m), None, 'm')})" if where.position_m else "")
        facts.append(f"Where: most at {place}{mean}.")
    if where.direction and all(map(words.known, where.direction)):
        along = ", ".join(words.number(v, 2) for v in where.direction)
        facts.append(f"Which way: {words.percent(where.direction_share)} of it there lies along ({along}).")
    if left.worst_frame.frame is not None:
        others = [f"{w.frame}" for w in left.worst_frames[1:] if w.frame is not None]
        more = f", then in {', '.join(others)}" if others else ""
        facts.append(f"When: most in frame {left.worst_frame.frame}, {words.length(left.worst_frame.rms_m)} rms{more}.")
    if words.known(left.half_in_frames):
        facts.append(f"How spread: {words.percent(left.half_in_frames)} of the frames hold half of the squared residual.")
    if effects and words.known(left.explained_share):
        facts.append(f"The effects took away {words.percent(left.explained_share)} of the squared residual beyond the noise.")
    if words.known(left.structure.p_value):
        facts.append(f"Structure: {_structure_words(left.structure)}.")
    return facts


def _structure_words(structure: Structure) -> str:
    found = structure.significant if structure.significant is not None else (structure.p_value or 0.0) <= 0.01
    state = "the residual is not mere noise" if found else "none seen beyond noise"
    return (
        f"{state} (correlation of neighbouring states {words.number(structure.lag_one, 2)}, smallest p = "
        f"{words.number(structure.p_value, 2)})"
    )


def _marker_bars(per_marker: Mapping[str, float | None]) -> Html | None:
    sizes = sorted(((1e3 * v, name) for name, v in per_marker.items() if v is not None and words.known(v)), reverse=True)
    if not sizes:
        return None
    shown = sizes[:MARKERS]
    figure = draw_bars([name for _, name in shown], [size for size, _ in shown], "rms residual after [mm]")
    more = f" The {len(shown)} largest of {len(sizes)}." if len(sizes) > len(shown) else ""
    return as_image(
        figure,
        alt=f"Residual of each marker after: the largest {shown[0][0]:.2f} mm at {shown[0][1]}.",
        caption=f"Residual of each marker after.{more}",
    )


FIELD_SHARE = 0.25


def force_field(field: ForceField, surface: DrawnSurface | None) -> Html | None:
    """Return the field of equivalent forces as a picture."""
    if not field.points_m or surface is None:
        return None
    points, forces = np.asarray(field.points_m, float), np.asarray(field.forces_n, float)
    largest = float(np.linalg.norm(forces, axis=1).max(initial=0.0))
    if largest <= 0:
        return None
    size = float(np.linalg.norm(np.ptp(surface.nodes, axis=0)))
    scale = FIELD_SHARE * size / largest
    view = best_view(surface.nodes, forces)
    tips = points + scale * forces
    corners = 1e3 * np.vstack([view.flat(surface.nodes), view.flat(tips)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    figure, axes = new_axes(height=body_height(low, high))
    draw_body(axes, surface, view)
    front = points @ view.towards >= np.median(points @ view.towards)
    for rows, alpha in ((~front, 0.35), (front, 1.0)):
        axes.quiver(
            *(1e3 * view.flat(points[rows])).T,
            *(1e3 * scale * view.flat(forces[rows])).T,
            color=SERIES[6],
            alpha=alpha,
            **arrow_options(),
        )
    factor, unit = words.force_unit(largest)
    key = nice(largest)
    frame_body(axes, view, low, high, key=Key(1e3 * scale * key, f"{factor * key:g} {unit}", SERIES[6]))
    total = [words.number(factor * (v or 0.0), 2) for v in field.total_n]
    sum_words = f" Together they make ({', '.join(total)}) {unit}." if len(total) == 3 else ""
    return as_image(
        figure,
        alt=f"Equivalent forces in frame {field.frame}, the largest {words.quantity(largest, 'N', 2)}.",
        caption=f"Not evidence: the smallest forces on the surface that would bend the model to the measurement in frame "
        f"{field.frame}, the one with the largest residual "
        f"(they explain {words.percent(field.explained_share)} of it). Any residual is some field of forces; pale arrows "
        f"are behind.{sum_words}",
    )
