"""Tables of a closed loop: ranking, calibration before and after, tests, forces, the data card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from femsense.loop.result.records import NAMED, PASSES
from femsense.model.effects import EFFECTS
from femsense.report import words
from femsense.report.documents import (
    CalibrationShift,
    Candidate,
    Card,
    Compliance,
    Detectable,
    Effect,
    Estimate,
    Evidence,
    Forces,
    LackOfFit,
    LoadRow,
    Loop,
    LoopInputs,
    Outlier,
    Ranked,
    Score,
    Size,
    Structure,
    Tested,
    Tests,
    Triple,
)
from femsense.report.page import Cell, Html, code, element, escape, paragraph, table, together

OUTCOMES = {
    NAMED: "named: part of the improved model",
    PASSES: "alternative: passes all tests too, with less evidence than the one that was named",
}
LISTED = 6
COMPONENTS = {
    "white": "each measurement by itself",
    "state": "a marker in a repeated state",
    "marker": "a marker on the body, in all frames",
    "frame": "all markers of a frame",
    "sweep": "all frames of a sweep",
}
TESTS = {
    "neighbours": "neighbouring states are alike",
    "pattern": "one pattern in many states",
    "sweep": "one sweep stands apart",
    "marker": "one marker stands apart",
    "cloud neighbours": "neighbouring states of the clouds are alike",
    "cloud sweep": "one sweep of the clouds stands apart",
}
MODELS = ("before", "nuisance", "after")
CHANGE = "a change of "
UNSEEN = "too small to be seen here"


def lacks(name: str) -> str:
    """Return what the plain model lacks where an effect acts."""
    return next((effect.lacks for effect in EFFECTS if effect.name == name), "")


def soft_line(text: str) -> Html | None:
    """Return a line in small grey type; None for no text."""
    return element("div", text, class_="soft") if text else None


def effect_name(name: str) -> Html:
    """Return the name of an effect with what it means below it."""
    return together(code(name), soft_line(lacks(name)))


# Effects and candidates


def effects_table(effects: Sequence[Effect]) -> Html | None:
    """Return the effects that were found, with their parameters and the held-out error around each."""
    rows: list[list[object]] = []
    for effect in effects:
        parts = [
            (f"{key} {name}".strip(), words.parameter(value, std, parameter.unit))
            for key, parameter in effect.parameters.items()
            for name, value, std in words.entries(parameter.value, parameter.std)
        ] or [("", words.NOTHING)]
        errors = [Cell(words.length(e), len(parts)) for e in (effect.validation_rms_before_m, effect.validation_rms_after_m)]
        first, *more = parts
        rows.append([Cell(effect_name(effect.name), len(parts)), code(first[0]) if first[0] else "", first[1], *errors])
        rows += [[None, code(name), value, None, None] for name, value in more]
    headers = ("Effect", "Parameter", "Value ± std", "Held-out error before", "after")
    return table(
        headers,
        rows,
        caption="Effects in the order in which they were added, with the parameters of the final fit.",
        numeric=(3, 4),
    )


def ranking_table(candidates: Sequence[Candidate], ranked: Mapping[str, Ranked], effects: Sequence[Effect]) -> Html | None:
    """Return all effects that were tried, the best first."""
    final = {effect.name: effect for effect in effects}
    rows = [
        [
            effect_name(c.name),
            together(*_values(final.get(c.name), ranked.get(c.name, Ranked()))),
            words.statistic(c.dchi2),
            words.statistic(c.dbic),
            _left_out(c),
            words.percent(c.retained_share),
            words.percent(ranked.get(c.name, Ranked()).first_share),
            _verdict(c),
        ]
        for c in candidates
    ]
    ranking = table(
        ("Effect", "Value, plausible range", "Δχ²", "ΔBIC", "Left-out sweeps", "Retained", "First", "Verdict"),
        rows,
        caption="Every effect that was tried, by what the first screening says of it.",
        numeric=(2, 3, 4, 5, 6),
        strong=[i for i, c in enumerate(candidates) if c.verdict == NAMED],
        dense=True,
    )
    text = paragraph(
        "Δχ² is what the effect explains of the residual beyond all that calibration can absorb; ΔBIC takes off a price for each parameter and each effect tried, "
        "and a named effect needs 10. Left-out sweeps: by how much twice the log-likelihood of sweeps that are not fitted rises, ± its standard error. “Retained” is the share of its trace "
        "that calibration leaves. “First” is how often the effect comes first when whole sweeps are drawn anew. Values: of the final fit where named, else of the linear screening. The modulus and the input offsets are not among them: they are always fitted along.",
        class_="soft",
    )
    return together(text, ranking) if ranking else None


def _left_out(c: Candidate) -> str:
    known = [r for r in c.refits if words.known(r.cv_gain)]
    if not known:
        return words.NOTHING
    return words.with_std(known[-1].cv_gain, known[-1].cv_std)


def _verdict(c: Candidate) -> str:
    text = c.verdict.replace("dBIC ", "ΔBIC\u00a0").replace("\u00a0-", "\u00a0−")
    if text in OUTCOMES or not text or text.startswith("not testable"):
        return OUTCOMES.get(text, text) or words.NOTHING
    return f"excluded: {text}"


def _values(effect: Effect | None, ranked: Ranked) -> list[Html]:
    """Return the values of an effect with their plausible range, a line each; a span where there are many."""
    if effect is not None and effect.parameters:
        ranges = {p.label.partition("[")[0]: p for p in ranked.parameters}
        parts = [
            (key, words.parameter(v, s, p.unit), ranges.get(key))
            for key, p in effect.parameters.items()
            for _, v, s in words.entries(p.value, p.std)
        ]
        return [_value_line(label, text, estimate) for label, text, estimate in parts[:LISTED]]
    shown = [p for p in ranked.parameters if words.known(p.value) or p.ends]
    if len(shown) > LISTED:
        seen = [p.value for p in shown if words.known(p.value) and p.value is not None]
        text = f"{words.quantity(min(seen), shown[0].unit, 2)} … {words.quantity(max(seen), shown[0].unit, 2)}" if seen else ""
        return [_value_line(f"{len(shown)} parameters", text, shown[0])]
    return [_value_line(p.label, words.with_std(p.value, p.std, p.unit) if words.known(p.value) else "", p) for p in shown]


def _value_line(label: str, text: str, estimate: Estimate | None) -> Html:
    ends = estimate.ends if estimate else []
    factor, unit = words.UNITS.get(estimate.unit, (1.0, estimate.unit)) if estimate else (1.0, "")
    span = ""
    if len(ends) == 2 and words.known(ends[0]):
        top = words.number(factor * (ends[1] or 0.0), 2) if words.known(ends[1]) else "∞"
        span = " " + words.joined(f"in\u00a0[{words.number(factor * (ends[0] or 0.0), 2)},\u00a0{top}]", unit)
    return element("div", code(label), f" {text}", element("span", span, class_="soft") if span else "", class_="value")


def refits_table(candidates: Sequence[Candidate]) -> Html | None:
    """Return what became of the candidates that were fitted together with calibration."""
    rows = [
        [
            code(c.name),
            words.statistic(r.dchi2),
            words.statistic(r.dbic),
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


# What would have been seen


def power_table(loop: Loop, evidence: Evidence) -> Html | None:
    """Return the smallest change of every effect that was not found."""
    hidden = {u.name for u in loop.not_testable}
    rows = [
        [
            effect_name(name),
            "not testable"
            if name in hidden
            else _sizes(entry, evidence.power.get(name, ()), evidence.ranking.get(name, Ranked())),
        ]
        for name, entry in loop.detectable.items()
        if entry.smallest or evidence.power.get(name)
    ]
    return table(
        ("Effect", "Smallest change that would have been seen"),
        rows,
        caption="For each effect that was not found: the change from what is declared at which the data would have named it (expected ΔBIC of 10).",
    )


def _sizes(entry: Detectable, own: Sequence[Size], ranked: Ranked) -> Html:
    """Return the smallest change of each parameter of an effect, a line each; a span where there are many."""
    sizes = own or [Size(label=n, kind=entry.kind, size=v, unit=entry.unit) for n, v in entry.smallest.items()]
    if len(sizes) > LISTED:
        return Html(escape(_size_span(entry, sizes)))
    ends = {p.label: p.ends for p in ranked.parameters}
    lines = [(s.label, _seen_words(entry, s, ends.get(s.label, []))) for s in sizes]
    return together(*(element("div", code(label) if label else "", f" {text}" if label else text) for label, text in lines))


def _size_span(entry: Detectable, sizes: Sequence[Size]) -> str:
    count = f"({len(sizes)} parameters)"
    known = sorted((s for s in sizes if words.known(s.size)), key=lambda s: s.size or 0.0)
    if not known:
        return f"cannot be seen {count}"
    least, most = (smallest_words(s.size, s.kind, s.unit) for s in (known[0], known[-1]))
    span = f"{least} … {most.removeprefix(CHANGE)} {count}"
    return f"{UNSEEN} ({span})" if entry.would_be_seen is False else span


def _seen_words(entry: Detectable, size: Size, ends: Sequence[float | None]) -> str:
    """Return the smallest visible size of a parameter, or that no plausible one would be seen."""
    text = smallest_words(size.size, size.kind, size.unit)
    if size.kind == "whole" or not words.known(size.size):
        return text
    beyond = entry.would_be_seen is False or is_beyond(size.size or 0.0, size.kind, ends)
    return f"{UNSEEN}: it would take {text}" if beyond else text


def is_beyond(size: float, kind: str, ends: Sequence[float | None]) -> bool:
    """Return whether a change leads out of the plausible range from wherever in it one starts."""
    low, high = ends if len(ends) == 2 else (None, None)
    if low is None or not words.known(low):
        return False
    if kind == "softer_than":
        return size < low
    if high is None or not words.known(high):
        return False
    return size * low > high > 0 if kind == "factor" else size > high - low


def smallest_words(size: float | None, kind: str, unit: str) -> str:
    """Return the smallest visible size of a parameter in its own unit, in words."""
    if size is None or not words.known(size) or size <= 0:
        return "cannot be seen"
    if kind == "whole":
        return (
            "would have been seen"
            if size < 1.0
            else f"{UNSEEN}: its whole change would have to be {words.number(size)} times as large"
        )
    if kind == "factor":
        return f"{CHANGE}{words.number(100.0 * (size - 1.0), 2)} %" if size < 2.0 else f"a factor of {words.number(size, 2)}"
    if kind == "softer_than":
        return f"softer than {words.quantity(size, unit, 2)}"
    return f"{CHANGE}{words.quantity(size, unit, 2)}"


# Covariates, calibration, tests


def covariate_table(score: Score) -> Html | None:
    """Return what the leading pattern of the residual goes with, before and after."""
    after = {c.covariate: c for c in score.goes_with_after}
    rows = [
        [
            c.covariate,
            words.number(c.rank_correlation, 2),
            words.number(c.p_holm, 2),
            words.number(after[c.covariate].rank_correlation, 2) if c.covariate in after else words.NOTHING,
        ]
        for c in score.goes_with_before
    ]
    return table(
        ("Goes with", "Rank correlation before", "p (Holm)", "after"),
        rows,
        caption="The leading pattern of the residual and what it goes with (Spearman; neighbouring frames are not independent, so p is optimistic).",
        numeric=(1, 2, 3),
    )


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
        caption="Camera: against where the calibration of the declared model put it (± one standard deviation). What moves back when effects are added is where they had been hiding. In the last two columns everything is free, so that values may differ from those that are returned.",
    )


def _vector(value: Triple | None, std: Triple | None, unit: str) -> str:
    return words.NOTHING if value is None else words.parameter(list(value), list(std) if std else None, unit)


def _three(values: Mapping[str, Sequence[Any]], unit: str) -> list[str]:
    found = [values.get(name) for name in MODELS]
    return [words.with_std(v[0], v[1] if len(v) > 1 else None, unit) if v else words.NOTHING for v in found]


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
    return f"F = {words.number(fit.f, 2)}, {_p(fit.p_value)} ({fit.df_lack}, {fit.df_pure} degrees of freedom; repeats differ by {words.length(fit.pure_error_m)})"


# Forces


def forces_part(forces: Forces) -> Html | None:
    """Return what the effects mean for sensed forces."""
    return _loads(forces.loads) if forces.loads else _softer(forces.compliance)


def _loads(loads: Sequence[LoadRow]) -> Html | None:
    several = len({row.recording for row in loads}) > 1
    rows = [
        [
            f"{row.recording + 1}: {row.frame}" if several else str(row.frame),
            words.quantity(row.declared_n, "N"),
            *_sensed(row.before_n, row.before_std_n, row.declared_n),
            *_sensed(row.after_n, row.after_std_n, row.declared_n),
        ]
        for row in loads
    ]
    held = all(row.held_out for row in loads)
    medians = [_median_error(loads, name) for name in ("before_n", "after_n")]
    text = paragraph(
        f"Sensed along the declared load, from the markers, to first order about the declared load, in {'held-out' if held else 'fitted'} frames. "
        f"Median size of the error: {medians[0]} with the declared robot, calibrated; {medians[1]} with the improved one."
    )
    numbers = table(
        ("Recording: frame" if several else "Frame", "Declared load", "Declared robot", "error", "Improved robot", "error"),
        rows,
        caption="Forces at declared loads, ± one standard deviation from the noise of the markers, taken as independent.",
        numeric=(1, 2, 3, 4, 5),
    )
    return together(text, numbers)


def _sensed(value: float | None, std: float | None, declared: float | None) -> list[str]:
    if not words.known(value) or not words.known(declared) or not declared:
        return [words.with_std(value, std, "N"), words.NOTHING]
    assert value is not None
    return [words.with_std(value, std, "N"), words.joined(words.signed(100 * (value - declared) / declared), "%")]


def _median_error(loads: Sequence[LoadRow], name: str) -> str:
    import statistics

    gaps = [
        (abs(value - row.declared_n), abs(value - row.declared_n) / row.declared_n)
        for row in loads
        if words.known(value := getattr(row, name)) and words.known(row.declared_n) and row.declared_n
    ]
    if not gaps:
        return words.NOTHING
    size, share = (statistics.median(g[i] for g in gaps) for i in (0, 1))
    return f"{words.quantity(size, 'N', 2)} ({words.percent(share, 1)})"


def _softer(compliance: Compliance) -> Html | None:
    ratios = [r for frame in compliance.frames for r in frame.ratio if words.known(r) and r is not None]
    if not ratios:
        return None
    import statistics

    middle = statistics.median(ratios)
    text = paragraph(
        f"No load is declared in these frames. The same dent of the surface is sensed as {words.number(middle)} times the force that the declared robot senses "
        f"(median over places and frames; {words.number(min(ratios))} to {words.number(max(ratios))}): compliance before over compliance after."
    )
    rows = [
        [
            f"{frame.title} ({frame.frame})",
            _span(frame.ratio),
            words.quantity(frame.phantom_before_n, "N", 2),
            words.quantity(frame.phantom_after_n, "N", 2),
        ]
        for frame in compliance.frames
    ]
    numbers = table(
        ("Frame", "Force, improved over declared", "False force before", "after"),
        rows,
        caption="False force: what would have been sensed at the free end, where nothing touches, from the residual alone.",
        numeric=(1, 2, 3),
    )
    return together(text, numbers)


def _span(ratio: Sequence[float | None]) -> str:
    seen = sorted(r for r in ratio if words.known(r) and r is not None)
    return f"{words.number(seen[0])} … {words.number(seen[-1])}" if seen else words.NOTHING


# The data


def _outlier_list(outliers: Sequence[Outlier]) -> str:
    said = ", ".join(f"{s.marker} in frame {s.frame}" for s in outliers[:LISTED])
    return f"{said} … ({len(outliers)})" if len(outliers) > LISTED else said


def data_card(loop: Loop) -> Html | None:
    """Return what the result rests on."""
    card, evidence = loop.data, loop.evidence or Evidence()
    rows: list[list[object]] = []
    for i, how in enumerate(card.split):
        name = Path(card.recordings[i] or "").name if i < len(card.recordings) else ""
        rows.append([f"Split, recording {i + 1}" + (f" ({name})" if name and name != "None" else ""), how])
    for title, groups in (("Frames fitted", card.frames_fitted), ("Frames held out", card.frames_held_out)):
        rows += [
            [f"{title}{f', {i + 1}' if len(groups) > 1 else ''}", f"{words.frame_list(g)} ({len(g)})"]
            for i, g in enumerate(groups)
        ]
    for i, reasons in enumerate(evidence.excluded):
        lines = [element("div", f"{why}: {words.frame_list(g)} ({len(g)})") for why, g in reasons.items() if g]
        rows.append(
            [f"Frames left out{f', {i + 1}' if len(evidence.excluded) > 1 else ''}", together(*lines) if lines else "none"]
        )
    rows += [["Outliers left out", _outlier_list(card.outliers)]] if card.outliers else []
    rows += [["Repeats (a state reached again the same way)", str(evidence.repeats)]] if evidence.repeats is not None else []
    rows += _noise_rows(card, loop.model_error.discretisation_note)
    for name, parameters in card.nuisance_after.items():
        rows.append([element("span", "Fitted along: ", code(name)), together(*_nuisance_lines(parameters))])
    rows += [["Seed", str(card.seed)]] if card.seed is not None else []
    rows += [["Versions", ", ".join(f"{name} {version}" for name, version in loop.versions.items())]] if loop.versions else []
    rows += _hash_rows(loop.inputs)
    return table(("Item", "Value"), rows, caption="What the result rests on; loop.json beside this file holds all of it.")


def _noise_rows(card: Card, no_mesh: str) -> list[list[object]]:
    """Return rows on noise and weights; `no_mesh` says why the discretisation error is not known."""
    noise = [f"{COMPONENTS.get(name, name)} {words.length(std)}" for name, std in card.noise_components_m.items()]
    rows: list[list[object]] = [["Weights of the fit, each axis", "; ".join(noise)]] if noise else []
    rows += [["Source of the noise level", card.noise_source]] if card.noise_source else []
    rows += (
        [["Independent observations", words.number(card.effective_observations)]]
        if words.known(card.effective_observations)
        else []
    )
    mesh = words.length(card.mesh_error_m, 2) if words.known(card.mesh_error_m) else no_mesh
    rows += [["Error of the mesh, at the markers", mesh]] if mesh else []
    if card.clouds is not None:
        clouds = card.clouds
        rows.append(["Clouds", f"{sum(clouds.rows)} rows along normals in {sum(clouds.frames)} fitted frames"])
        if "markers" in card.measured:
            own = [f"{COMPONENTS.get(name, name)} {words.length(std)}" for name, std in clouds.noise_components_m.items()]
            rows.append(["Noise of clouds, along the normal", "; ".join(own)])
    if "markers" not in card.measured:
        return [
            [str(a).replace("each axis", "along the normal").replace("at the markers", "along the normals"), b] for a, b in rows
        ]
    rows += (
        [["Uncertainty of marker placement", words.length(card.placement_std_m, 2)]] if words.known(card.placement_std_m) else []
    )
    return rows


def _nuisance_lines(parameters: Mapping[str, Any]) -> list[Html]:
    return [
        element("div", code(f"{key} {name}".strip()), f" {words.parameter(value, std, p.unit)}")
        for key, p in parameters.items()
        for name, value, std in words.entries(p.value, p.std)
    ]


def _hash_rows(inputs: LoopInputs) -> list[list[object]]:
    named = [
        ("Robot", inputs.robot),
        *((f"Recording {i + 1}", r) for i, r in enumerate(inputs.recordings)),
        *((f"Validation {i + 1}", r) for i, r in enumerate(inputs.validation)),
    ]
    lines = [
        element("div", f"{title} {Path(item.path).name if item.path else ''} ", code(item.sha256[:16]))
        for title, item in named
        if item.sha256
    ]
    return [["SHA-256 of the inputs (first digits)", together(*lines)]] if lines else []
