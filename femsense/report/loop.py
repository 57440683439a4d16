"""The report on a closed loop: what the model lacked, how well the data say so, and what they cannot say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.io.robot_toml import load_robot
from femsense.loop.files import LOOP_FORMAT
from femsense.loop.result.loop_result import EFFECTS, NONE, UNEXPLAINED
from femsense.model.robot import Robot
from femsense.report import words
from femsense.report.documents import Confounded, Evidence, Frames, Left, Loop, Residuals, Structure, read_document
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    INK,
    MANY,
    PALE,
    SIZE,
    SOFT,
    DrawnSurface,
    Key,
    View,
    add_legend,
    arrow_options,
    as_image,
    best_view,
    body_height,
    draw_bars,
    draw_body,
    frame_body,
    name_axes,
    new_axes,
    nice,
    skin,
)
from femsense.report.loop_figures import confounding_map, force_field, residual_against, residual_in_frames, sweep_dots
from femsense.report.loop_tables import (
    calibration_table,
    covariate_table,
    data_card,
    effects_table,
    forces_part,
    power_table,
    ranking_table,
    refits_table,
    tests_table,
)
from femsense.report.page import Chapter, Html, bullets, code, element, panels, paragraph, section, table, tiles, together

VERDICTS = {
    EFFECTS: "The data name what the model lacks.",
    NONE: "The model explains the data to their noise.",
    UNEXPLAINED: "A residual is left that no effect explains.",
}
OLDER = (
    "This loop.json holds no figures of the residual, of calibration, of confounding and of forces: it was written by an earlier femsense. "
    "Run femsense improve again for the whole report."
)
CLOUDS = (
    "There were no markers: what was fitted are clouds. Each “surface …” is a point of the body's surface; its residual is how far the "
    "measured surface lies from the model's there, along the normal, outwards positive. Errors are root mean squares of these distances."
)
ARROW_SHARE = 0.2
"""The longest arrow, in sizes of the body."""
SPOTS = 600
MARKERS = 30


def loop_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a loop.

    Arguments:
        file: loop.json; the improved robot beside it is drawn if it is there.
        title: of the chapter.

    Raises:
        InputError: either is broken.
    """
    loop = read_document(file, Loop, LOOP_FORMAT)
    residuals = loop.residuals.known()
    evidence = loop.evidence or Evidence()
    robot = load_robot(file.parent, effects=False) if (file.parent / "robot.toml").is_file() else None
    rest = None if robot is None else skin(robot.body.mesh.nodes, robot.body.mesh.tets)
    cameras = [np.asarray(c.axis, float) for c in evidence.pictures.cameras if all(map(words.known, c.axis))]
    body = together(
        _summary(loop),
        None if loop.evidence or not _is_old(loop) else paragraph(OLDER, class_="next"),
        None if has_markers(loop) else paragraph(CLOUDS, class_="soft"),
        section(
            "1. Residual on the robot",
            _mean_residual(residuals, robot, rest, cameras, _points(loop)),
            residual_in_frames(evidence.pictures, rest),
        ),
        section(
            "2. What the residual goes with",
            residual_against(evidence.frames, evidence.score, evidence.tip),
            covariate_table(evidence.score),
        ),
        section("3. Error on held-out data", _held_out(residuals, evidence.frames, loop.noise_m)),
        section(
            "4. Effects",
            effects_table(loop.effects),
            ranking_table(loop.candidates, evidence.ranking, loop.effects),
            refits_table(loop.candidates),
        ),
        section("5. What these data cannot say", _open_questions(loop, evidence)),
        section("6. What calibration had taken up", calibration_table(evidence.calibration)),
        section("7. Tests, and what is left", tests_table(evidence.tests), _left(loop, evidence, rest)),
        section("8. Smallest effects that would have been seen", power_table(loop, evidence)),
        section("9. Data", data_card(loop)),
        section("10. What it means for forces", forces_part(evidence.forces)),
    )
    return Chapter(title, body, loop.sentence or VERDICTS.get(loop.verdict, ""), loop.inputs.robot.name or "")


def _is_old(loop: Loop) -> bool:
    """Return whether more than a verdict is there, so that the figures are missed."""
    return bool(loop.residuals.frame or loop.candidates)


# On top


def _summary(loop: Loop) -> Html | None:
    before, after, marked = loop.before, loop.after, has_markers(loop)
    kind = "rms, 3-D" if marked else "rms along the normals"
    items = [
        (title, words.length(errors.validation_rms_m), note)
        for title, errors in (("Held-out error, before", before), ("Held-out error, after", after))
        for note in [f"95 % interval {words.interval(errors.validation_ci_m)}, {kind}" if errors.validation_ci_m else kind]
        if errors != type(errors)()
    ]
    if marked and words.known(before.validation_normal_rms_m) and words.known(after.validation_normal_rms_m):
        ends = f"{words.length(before.validation_normal_rms_m)} → {words.length(after.validation_normal_rms_m)}"
        items.append(("Held-out error of the clouds", ends, "rms along the normals"))
    own = loop.model_error
    if words.known(loop.noise_m):
        source = own.noise_source or "from the data"
        items.append(("Noise of a marker" if marked else "Noise of a cloud", words.length(loop.noise_m), f"{kind}, {source}"))
    if words.known(own.held_out_m):
        note = f"{kind}, held out, beyond noise and discretisation; {words.length(own.fitted_m)} where fitted"
        items.append(("Error of the model", words.length(own.held_out_m), note))
    share = recovered(before.validation_rms_m, after.validation_rms_m, loop.noise_m)
    if share is not None:
        items.append(("Recovered", words.percent(share), "of the excess over the noise (squares)"))
    train = paragraph(
        f"On the data that were fitted: {words.length(before.train_rms_m)} before, {words.length(after.train_rms_m)} after (rms).",
        class_="soft",
    )
    known = words.known(before.train_rms_m) or words.known(after.train_rms_m)
    return together(tiles(items) if items else None, train if known else None)


def has_markers(loop: Loop) -> bool:
    """Return whether markers were used; else the rows are points of the surface, measured along its normals."""
    return "markers" in loop.data.measured


def recovered(before_m: float | None, after_m: float | None, noise_m: float | None) -> float | None:
    """Return the share of the excess over the noise (in squares) that is gone; None where there is none to speak of."""
    if not (words.known(before_m) and words.known(after_m) and words.known(noise_m)):
        return None
    assert before_m is not None and after_m is not None and noise_m is not None
    excess = before_m**2 - noise_m**2
    if excess <= 0.1 * before_m**2:
        return None
    return min(1.0, max(0.0, (before_m**2 - after_m**2) / excess))


# Residuals


def _mean_residual(
    residuals: Residuals,
    robot: Robot | None,
    surface: DrawnSurface | None,
    cameras: Sequence[FloatArray],
    points_m: Mapping[str, FloatArray],
) -> Html | None:
    """Draw the mean residual of each marker, or point of the surface, before and after on the robot of the loop."""
    if not residuals.marker or robot is None or surface is None:
        return None
    placement = {name: point for name, point in zip(robot.marker_names, robot.marker_points)} | dict(points_m)
    rows = np.array([i for i, name in enumerate(residuals.marker) if name in placement], dtype=np.int64)
    if not len(rows):
        return None
    names = [residuals.marker[i] for i in rows]
    points = np.array([placement[name] for name in names])
    before, after = np.asarray(residuals.before_m, float)[rows], np.asarray(residuals.after_m, float)[rows]
    mean = [_per_marker(names, values) for values in (before, after)]
    placements = _per_marker(names, points)
    view = best_view(np.vstack([surface.nodes, placements]), mean[0])
    factor = _exaggeration(surface, [m for m in mean if len(m)])
    key = _key_length(mean[0], mean[1])
    reach = _reach(surface, view, points, factor, (before, after))
    figures = [
        as_image(
            _quiver(surface, view, (placements, m), (points, values), factor, key, reach, color, title, cameras),
            alt=f"Mean residual of {words.counted(len(placements), 'marker')} {title}: {_sizes(m)}.",
            caption=f"{title.capitalize()}: mean over the held-out frames {_sizes(m)}.",
        )
        for m, values, color, title in ((mean[0], before, BEFORE, "before"), (mean[1], after, AFTER, "after"))
    ]
    shown = float((view.flat(mean[0]) ** 2).sum() / max((mean[0] ** 2).sum(), 1e-300))
    text = paragraph(
        f"Arrows point from the model to the measurement: the mean of each marker over the held-out frames, {'at true length' if factor == 1 else f'drawn {factor:g} times as long'}, "
        f"with the same scale in both pictures{'; the black one says which way the camera looks' if cameras else ''}. Small dots are single frames. The body is at rest, seen so that its {view.axes[0]}–{view.axes[1]} plane "
        f"lies in the page, which shows {words.percent(shown)} of the squared mean residual before."
    )
    return together(text, panels(*figures))


def _points(loop: Loop) -> dict[str, FloatArray]:
    """Return where the points of the surface lie at rest [m]."""
    clouds = loop.data.clouds
    return {} if clouds is None else {name: np.asarray(place, float) for name, place in clouds.points_m.items()}


def _per_marker(names: Sequence[str], values: FloatArray) -> FloatArray:
    """Return the mean of the rows of each marker, in the order of their names."""
    labels = np.array(names)
    return np.array([np.mean(values[labels == name], axis=0) for name in sorted(set(names))])


def _exaggeration(surface: DrawnSurface, means: Sequence[FloatArray]) -> float:
    largest = max(float(np.linalg.norm(m, axis=1).max(initial=0.0)) for m in means)
    size = float(np.linalg.norm(np.ptp(surface.nodes, axis=0)))
    return max(1.0, nice(ARROW_SHARE * size / largest)) if largest > 0 else 1.0


def _key_length(before: FloatArray, after: FloatArray) -> float:
    """Return a round length [m] for the arrow of the legend."""
    largest = max(float(np.linalg.norm(m, axis=1).max(initial=0.0)) for m in (before, after))
    return nice(largest) if largest > 0 else 1e-3


def _reach(
    surface: DrawnSurface, view: View, points: FloatArray, factor: float, fields: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the corners [mm] of what both pictures show: the body and all arrows (of single frames all but the farthest)."""
    tips = [points + factor * field for field in fields]
    arrows = [np.quantile(view.flat(tip), q, axis=0) for tip in tips for q in (0.01, 0.99)]
    corners = 1e3 * np.vstack([view.flat(surface.nodes), view.flat(points), *arrows])
    return corners.min(axis=0), corners.max(axis=0)


def _quiver(
    surface: DrawnSurface,
    view: View,
    mean: tuple[FloatArray, FloatArray],
    single: tuple[FloatArray, FloatArray],
    factor: float,
    key: float,
    reach: tuple[FloatArray, FloatArray],
    color: str,
    title: str,
    cameras: Sequence[FloatArray],
) -> Any:
    low, high = reach
    figure, axes = new_axes(height=body_height(low, high))
    draw_body(axes, surface, view)
    step = max(1, len(single[0]) // SPOTS)
    tips = 1e3 * view.flat(single[0] + factor * single[1])[::step]
    axes.plot(*tips.T, ".", color=color, alpha=0.35, markersize=3, markeredgewidth=0, rasterized=len(tips) > MANY)
    placements = 1e3 * view.flat(mean[0])
    axes.plot(*placements.T, "o", color="white", markeredgecolor=INK, markeredgewidth=0.8, markersize=3.5)
    axes.quiver(*placements.T, *(1e3 * factor * view.flat(mean[1])).T, color=color, **arrow_options())
    explained = Key(1e3 * factor * key, f"{1e3 * key:g} mm residual", color)
    frame_body(axes, view, low, high, key=explained, cameras=cameras if title == "before" else ())
    axes.set_title(title, fontsize=SIZE + 1, color=color, loc="left", fontweight="bold")
    return figure


def _sizes(mean: FloatArray) -> str:
    sizes = np.linalg.norm(mean, axis=1)
    return f"{words.length(float(np.sqrt((sizes**2).mean())))} rms, {words.length(float(sizes.max()))} at most"


def _held_out(residuals: Residuals, table: Frames, noise_m: float | None) -> Html | None:
    if not residuals.frame:
        return sweep_dots(table, noise_m)
    before, after = (np.linalg.norm(np.asarray(values, float), axis=1) for values in (residuals.before_m, residuals.after_m))
    median = [words.length(float(np.median(values))) for values in (before, after)]
    frames = _per_frame(residuals, before, after)
    fell = f"the error fell in {sum(b > a for _, _, b, a in frames)} of {words.counted(len(frames), 'held-out frame')}"
    shares = as_image(
        _distribution(before, after, noise_m),
        alt=f"Share of held-out measurements with an error below a size, before and after; medians {median[0]} and {median[1]}.",
        caption=f"{words.counted(len(before), 'measurement')} of {words.counted(len(set(residuals.marker)), 'marker')}; median {median[0]} before, {median[1]} after; {fell}.",
    )
    dots = sweep_dots(table, noise_m) or as_image(
        _frame_dots(frames, noise_m),
        alt=f"Root mean square error of each held-out frame before and after; {fell}.",
        caption="Error of each held-out frame.",
    )
    return panels(shares, dots)


def _distribution(before: FloatArray, after: FloatArray, noise_m: float | None) -> Any:
    """Draw the shares of errors below a size, with what noise alone would give."""
    figure, axes = new_axes()
    for values, color, name in ((before, BEFORE, "before"), (after, AFTER, "after")):
        sizes = 1e3 * np.sort(values)
        shares = np.arange(1, len(sizes) + 1) / max(len(sizes), 1)
        axes.step(
            np.concatenate([[0.0], sizes]),
            100 * np.concatenate([[0.0], shares]),
            where="post",
            color=color,
            linewidth=1.9,
            label=name,
        )
    top = 1e3 * float(np.quantile(np.concatenate([before, after]), 0.995)) * 1.08
    if noise_m is not None and words.known(noise_m) and noise_m > 0:
        top = max(top, 2.2e3 * noise_m)
        x = np.linspace(0.0, top, 200)
        axes.plot(
            x, 100 * _noise_share(x / (1e3 * noise_m)), color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="noise alone"
        )
    axes.set(xlim=(0.0, max(top, 1e-9)), ylim=(0.0, 102.0))
    name_axes(axes, "error [mm]", "measurements below it [%]")
    add_legend(axes)
    return figure


def _noise_share(ratio: FloatArray) -> FloatArray:
    """Return how often 3-D noise of root mean square 1 is below a size (Maxwell's distribution)."""
    from scipy.special import erf

    u = ratio * math.sqrt(1.5)
    return np.asarray(erf(u) - 2.0 / math.sqrt(math.pi) * u * np.exp(-(u**2)))


def _per_frame(residuals: Residuals, before: FloatArray, after: FloatArray) -> list[tuple[int, int, float, float]]:
    """Return (recording, frame, rms before, rms after) of each held-out frame, in order."""
    recording = residuals.recording or [0] * len(residuals.frame)
    keys = list(zip(recording, residuals.frame))
    rows: dict[tuple[int, int], list[int]] = {}
    for i, key in enumerate(keys):
        rows.setdefault(key, []).append(i)
    return [(r, f, _rms(before[rows[r, f]]), _rms(after[rows[r, f]])) for r, f in sorted(rows)]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _frame_dots(frames: Sequence[tuple[int, int, float, float]], noise_m: float | None) -> Any:
    figure, axes = new_axes()
    places = np.arange(len(frames)) + np.array([0.8 * recording for recording, *_ in frames])
    before, after = 1e3 * np.array([f[2] for f in frames]), 1e3 * np.array([f[3] for f in frames])
    many = len(frames) > MANY
    if len(frames) <= 80:
        axes.vlines(places, np.minimum(before, after), np.maximum(before, after), color=PALE, linewidth=0.9)
    size = 4.5 if len(frames) <= 80 else 2.5
    axes.plot(places, before, "o", color=BEFORE, markersize=size, markeredgewidth=0, label="before", rasterized=many)
    axes.plot(places, after, "o", color=AFTER, markersize=size, markeredgewidth=0, label="after", rasterized=many)
    if words.known(noise_m):
        axes.axhline(1e3 * float(noise_m or 0.0), color=SOFT, linewidth=1.2, linestyle=(0, (4, 3)), label="noise")
    step = max(1, math.ceil(len(frames) / 9))
    several = len({f[0] for f in frames}) > 1
    labels = [f"{f[1]}\nR{f[0] + 1}" if several else str(f[1]) for f in frames]
    axes.set_xticks(places[::step], labels[::step])
    axes.set_ylim(0.0, 1.08 * float(np.max([*before, *after, 1e-9])))
    axes.grid(False, axis="x")
    name_axes(axes, "frame" + (" (R: recording)" if several else ""), "rms error [mm]")
    add_legend(axes)
    return figure


# What these data cannot say


def _open_questions(loop: Loop, evidence: Evidence) -> Html | None:
    names = {effect.name for effect in loop.effects}
    pairs = [
        element("span", code(r.pair[0]), " and ", code(r.pair[1]), f": {_why_alike(r)}")
        for r in loop.confounded
        if names & set(r.pair) or not names
    ]
    others = [" / ".join(r.pair) for r in loop.confounded if names and not names & set(r.pair)]
    hidden = [
        element("span", code(u.name), f": {words.nearly(u.absorbed_share)} of it is absorbed by calibration")
        for u in loop.not_testable
    ]
    experiment = loop.next_experiment
    advice = paragraph(element("strong", "Next experiment: "), experiment, class_="next") if experiment else None
    return (
        together(
            section("Cannot be distinguished", bullets(pairs), level=4),
            paragraph("Nor could these, were one of them there: ", ", ".join(others), ".") if others else None,
            section("Not testable with these data", bullets(hidden), level=4),
            advice,
            confounding_map(evidence.confounding),
        )
        or None
    )


def _why_alike(pair: Confounded) -> str:
    if words.known(pair.dbic_gap):
        return f"their evidence differs by a ΔBIC of {words.number(pair.dbic_gap, 2)} only"
    if words.known(pair.absorbed_share):
        return f"{words.nearly(pair.absorbed_share, 1)} of the second is absorbed by calibration, most of it by the first"
    if words.known(pair.cosine):
        return f"they leave the same trace (agreement {words.percent(pair.cosine, 1)})"
    return "these data do not tell which it is"


# What is left


def _left(loop: Loop, evidence: Evidence, surface: DrawnSurface | None) -> Html | None:
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
    return f"{state} (correlation of neighbouring states {words.number(structure.lag_one, 2)}, smallest p = {words.number(structure.p_value, 2)})"


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
