"""The report on a closed loop: what the model lacked, how well the data say so, and what they cannot say."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from femsense.arrays import FloatArray
from femsense.effects import EFFECTS
from femsense.report import words
from femsense.report.documents import (
    Candidate,
    Card,
    Detectable,
    Effect,
    Left,
    Loop,
    Residuals,
    Rivals,
    Untestable,
    read_document,
)
from femsense.report.drawing import (
    AFTER,
    BEFORE,
    INK,
    MANY,
    PALE,
    SIZE,
    SOFT,
    Surface,
    View,
    add_legend,
    as_image,
    best_view,
    draw_bars,
    draw_body,
    frame_body,
    name_axes,
    new_axes,
    nice,
    skin,
)
from femsense.report.page import Cell, Chapter, Html, bullets, code, element, panels, paragraph, section, table, tiles, together
from femsense.results import LOOP_FORMAT
from femsense.robot import load_robot

VERDICTS = {
    "effects": "The data name what the model lacks.",
    "none": "The model explains the data to their noise.",
    "unexplained": "A residual is left that no effect explains.",
}
OUTCOMES = {
    "named": "named: part of the improved model",
    "passes": "passes all tests too, with less evidence than the one that was named",
}
ARROW_SHARE = 0.2
"""The longest arrow, in sizes of the body."""
SPOTS = 600
LISTED = 6
MARKERS = 30
COMPONENTS = {
    "white": "each measurement by itself",
    "state": "a marker in a repeated state",
    "marker": "a marker in all frames",
    "frame": "all markers of a frame",
    "sweep": "all frames of a sweep",
}


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
    body = together(
        _summary(loop),
        section("Residual on the robot", _residual_on_robot(residuals, file.parent)),
        section("Error on held-out data", _held_out(residuals, loop.noise_m)),
        section("Effects found", _effects(loop.effects)),
        section("All effects that were tried", _candidates(loop.candidates)),
        section("What these data cannot say", _open_questions(loop.confounded, loop.not_testable, loop.next_experiment)),
        section("Smallest effects that would have been seen", _detectable(loop.detectable)),
        section("What is left", _left(loop.left)),
        section("Data", _card(loop.data, loop.versions)),
    )
    return Chapter(title, body, loop.sentence or VERDICTS.get(loop.verdict, ""), loop.inputs.robot.name or "")


# On top


def _summary(loop: Loop) -> Html | None:
    before, after = loop.before, loop.after
    items = [
        (title, words.length(errors.validation_rms_m), note)
        for title, errors in (("Held-out error, before", before), ("Held-out error, after", after))
        for note in [f"95 % interval {words.interval(errors.validation_ci_m)}" if errors.validation_ci_m else "rms, 3-D"]
        if errors != type(errors)()
    ]
    if words.known(loop.noise_m):
        items.append(("Noise of a marker", words.length(loop.noise_m), "rms, 3-D, from the data"))
    share = recovered(before.validation_rms_m, after.validation_rms_m, loop.noise_m)
    if share is not None:
        items.append(("Recovered", words.percent(share), "of the excess over the noise (squares)"))
    train = paragraph(
        f"On the data that were fitted: {words.length(before.train_rms_m)} before, {words.length(after.train_rms_m)} after (rms).",
        class_="soft",
    )
    known = words.known(before.train_rms_m) or words.known(after.train_rms_m)
    return together(tiles(items) if items else None, train if known else None)


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


def _residual_on_robot(residuals: Residuals, folder: Path) -> Html | None:
    """Draw the mean residual of each marker before and after on the robot of the loop."""
    if not residuals.marker or not (folder / "robot.toml").is_file():
        return None
    robot = load_robot(folder, effects=False)
    seat = {name: point for name, point in zip(robot.marker_names, robot.marker_points)}
    rows = np.array([i for i, name in enumerate(residuals.marker) if name in seat], dtype=np.int64)
    if not len(rows):
        return None
    names = [residuals.marker[i] for i in rows]
    points = np.array([seat[name] for name in names])
    before, after = np.asarray(residuals.before_m, float)[rows], np.asarray(residuals.after_m, float)[rows]
    surface = skin(robot.body.mesh.nodes, robot.body.mesh.tets)
    mean = [_per_marker(names, values) for values in (before, after)]
    seats = _per_marker(names, points)
    view = best_view(np.vstack([surface.nodes, seats]), mean[0])
    factor = _exaggeration(surface, [m for m in mean if len(m)])
    key = _key_length(mean[0], mean[1])
    reach = _reach(surface, view, points, factor, (before, after))
    figures = [
        as_image(
            _quiver(surface, view, (seats, m), (points, values), factor, key, reach, color, title),
            alt=f"Mean residual of {words.counted(len(seats), 'marker')} {title}: {_sizes(m)}.",
            caption=f"{title.capitalize()}: mean over the held-out frames {_sizes(m)}.",
        )
        for m, values, color, title in ((mean[0], before, BEFORE, "before"), (mean[1], after, AFTER, "after"))
    ]
    shown = float((view.flat(mean[0]) ** 2).sum() / max((mean[0] ** 2).sum(), 1e-300))
    text = paragraph(
        f"Arrows point from the model to the measurement: the mean of each marker over the held-out frames, {'at true length' if factor == 1 else f'drawn {factor:g} times as long'}, "
        f"with the same scale in both pictures. Small dots are single frames. The body is at rest, seen so that its {view.axes[0]}–{view.axes[1]} plane "
        f"lies in the page, which shows {words.percent(shown)} of the squared mean residual before."
    )
    return together(text, panels(*figures))


def _per_marker(names: Sequence[str], values: FloatArray) -> FloatArray:
    """Return the mean of the rows of each marker, in the order of their names."""
    labels = np.array(names)
    return np.array([np.mean(values[labels == name], axis=0) for name in sorted(set(names))])


def _exaggeration(surface: Surface, means: Sequence[FloatArray]) -> float:
    largest = max(float(np.linalg.norm(m, axis=1).max(initial=0.0)) for m in means)
    size = float(np.linalg.norm(np.ptp(surface.nodes, axis=0)))
    return max(1.0, nice(ARROW_SHARE * size / largest)) if largest > 0 else 1.0


def _key_length(before: FloatArray, after: FloatArray) -> float:
    """Return a round length [m] for the arrow of the legend."""
    largest = max(float(np.linalg.norm(m, axis=1).max(initial=0.0)) for m in (before, after))
    return nice(largest) if largest > 0 else 1e-3


def _reach(
    surface: Surface, view: View, points: FloatArray, factor: float, fields: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the corners [mm] of what both pictures show: the body and all arrows (of single frames all but the farthest)."""
    tips = [points + factor * field for field in fields]
    arrows = [np.quantile(view.flat(tip), q, axis=0) for tip in tips for q in (0.01, 0.99)]
    corners = 1e3 * np.vstack([view.flat(surface.nodes), view.flat(points), *arrows])
    return corners.min(axis=0), corners.max(axis=0)


def _quiver(
    surface: Surface, view: View, mean: tuple[FloatArray, FloatArray], single: tuple[FloatArray, FloatArray], factor: float, key: float,
    reach: tuple[FloatArray, FloatArray], color: str, title: str,
) -> Any:  # fmt: skip
    low, high = reach
    height = float(np.clip(4.2 * (high[1] - low[1]) / (high[0] - low[0]) + 0.9, 1.9, 4.4))
    figure, axes = new_axes(height=height)
    draw_body(axes, surface, view)
    step = max(1, len(single[0]) // SPOTS)
    tips = 1e3 * view.flat(single[0] + factor * single[1])[::step]
    axes.plot(*tips.T, ".", color=color, alpha=0.35, markersize=3, markeredgewidth=0, rasterized=len(tips) > MANY)
    seats = 1e3 * view.flat(mean[0])
    axes.plot(*seats.T, "o", color="white", markeredgecolor=INK, markeredgewidth=0.8, markersize=3.5)
    axes.quiver(*seats.T, *(1e3 * factor * view.flat(mean[1])).T, color=color, **_arrows())
    frame_body(axes, view, low, high)
    bottom, margin = low[1], 0.04 * float((high - low).max())
    start = low[0] + 0.42 * (high[0] - low[0])
    axes.quiver([start], [bottom - 1.4 * margin], [1e3 * factor * key], [0.0], color=color, **_arrows())
    axes.text(start, bottom - 2.0 * margin, f"{1e3 * key:g} mm residual", ha="left", va="top", fontsize=SIZE - 0.5, color=INK)
    axes.set_title(title, fontsize=SIZE + 1, color=color, loc="left", fontweight="bold")
    return figure


def _arrows() -> dict[str, Any]:
    return {
        "angles": "xy",
        "scale_units": "xy",
        "scale": 1.0,
        "width": 0.0075,
        "headwidth": 3.6,
        "headlength": 4.2,
        "headaxislength": 3.8,
        "minlength": 0.2,
        "zorder": 5,
    }


def _sizes(mean: FloatArray) -> str:
    sizes = np.linalg.norm(mean, axis=1)
    return f"{words.length(float(np.sqrt((sizes**2).mean())))} rms, {words.length(float(sizes.max()))} at most"


def _held_out(residuals: Residuals, noise_m: float | None) -> Html | None:
    if not residuals.frame:
        return None
    before, after = (np.linalg.norm(np.asarray(values, float), axis=1) for values in (residuals.before_m, residuals.after_m))
    median = [words.length(float(np.median(values))) for values in (before, after)]
    shares = as_image(
        _distribution(before, after, noise_m),
        alt=f"Share of held-out measurements with an error below a size, before and after; medians {median[0]} and {median[1]}.",
        caption=f"{words.counted(len(before), 'measurement')} of {words.counted(len(set(residuals.marker)), 'marker')}; median {median[0]} before, {median[1]} after.",
    )
    frames = _per_frame(residuals, before, after)
    fell = int(sum(b > a for _, _, b, a in frames))
    dots = as_image(
        _frame_dots(frames, noise_m),
        alt=f"Root mean square error of each held-out frame before and after; it fell in {fell} of {len(frames)} frames.",
        caption=f"The error fell in {fell} of {words.counted(len(frames), 'held-out frame')}.",
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


# Effects


def _lacks(name: str) -> str:
    return next((effect.lacks for effect in EFFECTS if effect.name == name), "")


def _effects(effects: Sequence[Effect]) -> Html | None:
    rows: list[list[object]] = []
    for effect in effects:
        parts = [
            (f"{key} {name}".strip(), words.parameter(value, std, parameter.unit))
            for key, parameter in effect.parameters.items()
            for name, value, std in words.entries(parameter.value, parameter.std)
        ] or [("", words.NOTHING)]
        label = together(code(effect.name), _soft_line(_lacks(effect.name)))
        errors = [Cell(words.length(e), len(parts)) for e in (effect.validation_rms_before_m, effect.validation_rms_after_m)]
        first, *more = parts
        rows.append([Cell(label, len(parts)), code(first[0]) if first[0] else "", first[1], *errors])
        rows += [[None, code(name), value, None, None] for name, value in more]
    headers = ("Effect", "Parameter", "Value ± std", "Held-out error before", "after")
    return table(
        headers,
        rows,
        caption="Effects in the order in which they were added, with the parameters of the final fit.",
        numeric=(3, 4),
    )


def _soft_line(text: str) -> Html | None:
    return element("div", text, class_="soft") if text else None


def _candidates(candidates: Sequence[Candidate]) -> Html | None:
    rows = [
        [
            together(code(c.name), _soft_line(_lacks(c.name))), words.number(c.dchi2), words.number(c.dbic), words.percent(c.retained_share),
            words.number(c.dbic_at_end), OUTCOMES.get(c.verdict, c.verdict) or words.NOTHING,
        ]
        for c in candidates
    ]  # fmt: skip
    headers = ("Effect", "Δχ²", "ΔBIC", "Retained", "ΔBIC at the end", "Verdict")
    ranking = table(
        headers, rows, caption="Screening with the model before any effect was added, the best first.", numeric=(1, 2, 3, 4),
        strong=[i for i, c in enumerate(candidates) if c.verdict == "named"],
    )  # fmt: skip
    text = paragraph(
        "Δχ² is what the effect explains of the residual beyond all that calibration can imitate; ΔBIC takes off a price for each parameter and each effect tried, "
        "and a named effect needs 10. “Retained” is the share of its trace that calibration leaves.",
        class_="soft",
    )
    return together(text, ranking, _refits(candidates)) if ranking else None


def _refits(candidates: Sequence[Candidate]) -> Html | None:
    rows = [
        [
            code(c.name),
            words.number(r.dchi2),
            words.number(r.dbic),
            words.length(r.validation_rms_m),
            OUTCOMES.get(r.verdict, r.verdict) or words.NOTHING,
        ]
        for c in candidates
        for r in c.refits
    ]
    return table(
        ("Effect", "Δχ²", "ΔBIC", "Held-out error", "Outcome"),
        rows,
        caption="The best of them, fitted together with calibration in full.",
        numeric=(1, 2, 3),
    )


def _open_questions(rivals: Sequence[Rivals], untestable: Sequence[Untestable], experiment: str) -> Html | None:
    pairs = [element("span", code(r.pair[0]), " and ", code(r.pair[1]), f": {_why_alike(r)}") for r in rivals]
    hidden = [
        element("span", code(u.name), f": calibration imitates {words.percent(u.absorbed_share)} of it") for u in untestable
    ]
    advice = paragraph(element("strong", "Next experiment: "), experiment, class_="next") if experiment else None
    return together(
        section("Cannot be told apart", bullets(pairs), level=4), section("Not testable with these data", bullets(hidden), level=4), advice
    ) or None  # fmt: skip


def _why_alike(rivals: Rivals) -> str:
    if words.known(rivals.dbic_gap):
        return f"their evidence differs by a ΔBIC of {words.number(rivals.dbic_gap, 2)} only"
    if words.known(rivals.cosine):
        return f"they leave the same trace (agreement {words.percent(rivals.cosine, 1)})"
    return "these data do not tell which it is"


def _detectable(detectable: Mapping[str, Detectable]) -> Html | None:
    rows = [
        [together(code(name), _soft_line(_lacks(name))), _smallest(entry)] for name, entry in detectable.items() if entry.smallest
    ]
    caption = "For each effect that was not found: the size at which the data would have named it (expected ΔBIC of 10)."
    return table(("Effect", "Smallest size"), rows, caption=caption)


def _smallest(entry: Detectable) -> Html:
    sizes = [(label, value) for label, value in entry.smallest.items()]
    if len(sizes) > LISTED:
        seen = [value for _, value in sizes if value is not None and words.known(value)]
        if not seen:
            return Html("cannot be seen")
        span = " … ".join(size_words(v, entry.coordinate, entry.unit) for v in (min(seen), max(seen)))
        return Html(f"{span} ({len(sizes)} parameters)")
    return together(
        *(element("div", code(label), f" {size_words(value, entry.coordinate, entry.unit)}") for label, value in sizes)
    )


def size_words(size: float | None, coordinate: str, unit: str) -> str:
    """Return the smallest visible size of a parameter, given in the coordinate of the fit, in words."""
    if size is None or not words.known(size) or size <= 0:
        return "cannot be seen"
    if coordinate == "log":
        return (
            f"a change of {words.number(100 * math.expm1(size), 2)} %"
            if size < math.log(2.0)
            else f"a factor of {words.number(math.exp(min(size, 50.0)), 2)}"
        )
    if coordinate == "reciprocal":
        return f"softer than {words.quantity(1.0 / size, unit, 2)}"
    return words.quantity(size, unit, 2)


# What is left, and the data


def _left(left: Left) -> Html | None:
    facts = []
    if words.known(left.rms_m):
        facts.append(f"Size: {words.length(left.rms_m)} rms on the fitted data.")
    if left.where.marker:
        mean = left.where.mean_residual_m or []
        facts.append(
            f"Where: most at marker {left.where.marker}" + (f", mean {words.parameter(list(mean), None, 'm')}." if mean else ".")
        )
    if left.worst_frame.frame is not None:
        facts.append(f"When: most in frame {left.worst_frame.frame}, {words.length(left.worst_frame.rms_m)} rms.")
    if words.known(left.structure.p_value):
        facts.append(f"Structure: {_structure_words(left.structure.lag_one, left.structure.p_value)}.")
    rows = [[c.covariate, words.number(c.rank_correlation, 2), words.number(c.p_value, 2)] for c in left.goes_with]
    goes = table(("Goes with", "Rank correlation", "p"), rows, caption="What the residual of a frame goes with.", numeric=(1, 2))
    return together(bullets(facts), panels(goes, _marker_bars(left.marker_rms_m))) or None


def _structure_words(lag: float | None, p_value: float | None) -> str:
    state = "neighbouring states resemble each other" if (p_value or 0.0) <= 0.01 else "none seen between neighbouring states"
    return f"{state} (correlation {words.number(lag, 2)}, p = {words.number(p_value, 2)})"


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


def _card(card: Card, versions: Mapping[str, str]) -> Html | None:
    rows: list[list[object]] = []
    for i, how in enumerate(card.split):
        name = Path(card.recordings[i] or "").name if i < len(card.recordings) else ""
        rows.append([f"Split, recording {i + 1}" + (f" ({name})" if name else ""), how])
    for title, groups in (("Frames fitted", card.frames_fitted), ("Frames held out", card.frames_held_out)):
        rows += [
            [f"{title}{f', {i + 1}' if len(groups) > 1 else ''}", f"{words.frame_list(g)} ({len(g)})"]
            for i, g in enumerate(groups)
        ]
    noise = [f"{COMPONENTS.get(name, name)} {words.length(std)}" for name, std in card.noise_components_m.items()]
    rows += [["Noise, each axis", "; ".join(noise)]] if noise else []
    rows += [["Source of the noise level", card.noise_source]] if card.noise_source else []
    rows += (
        [["Independent observations", words.number(card.effective_observations)]]
        if words.known(card.effective_observations)
        else []
    )
    rows += [["Uncertainty of marker seats", words.length(card.seat_std_m, 2)]] if words.known(card.seat_std_m) else []
    for name, parameters in card.nuisance_after.items():
        rows.append([element("span", "Fitted along: ", code(name)), together(*_nuisance_lines(parameters))])
    rows += [["Seed", str(card.seed)]] if card.seed is not None else []
    rows += [["Versions", ", ".join(f"{name} {version}" for name, version in versions.items())]] if versions else []
    return table(("Item", "Value"), rows, caption="What the result rests on; loop.json beside this file holds all of it.")


def _nuisance_lines(parameters: Mapping[str, Any]) -> list[Html]:
    return [
        element("div", code(f"{key} {name}".strip()), f" {words.parameter(value, std, p.unit)}")
        for key, p in parameters.items()
        for name, value, std in words.entries(p.value, p.std)
    ]
