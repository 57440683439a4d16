"""Effects: those that were found, and all that were tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from femsense.loop.result.records import NAMED, PASSES
from femsense.model.effects import EFFECTS
from femsense.report import words
from femsense.report.loop.document import Candidate, Effect, Parameter
from femsense.report.loop.evidence import Estimate, Ranked
from femsense.report.page import Cell, Html, code, element, paragraph, table, together

OUTCOMES = {
    NAMED: "named: part of the improved model",
    PASSES: "alternative: passes all tests too, with less evidence than the one that was named",
}
LISTED = 6


def lacks(name: str) -> str:
    """Return what the plain model lacks where an effect acts."""
    return next((effect.lacks for effect in EFFECTS if effect.name == name), "")


def soft_line(text: str) -> Html | None:
    """Return a line in small grey type; None for no text."""
    return element("div", text, class_="soft") if text else None


def effect_name(name: str) -> Html:
    """Return the name of an effect with what it means below it."""
    return together(code(name), soft_line(lacks(name)))


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


def along_table(fitted_along: Mapping[str, Mapping[str, Parameter]]) -> Html | None:
    """Return what the improved robot has beside the effects that are named, since these were fitted with it; None where that is nothing."""
    rows = [
        [code(name), code(f"{key} {part}".strip()), words.parameter(value, std, parameter.unit)]
        for name, parameters in fitted_along.items()
        for key, parameter in parameters.items()
        for part, value, std in words.entries(parameter.value, parameter.std)
    ]
    caption = "Fitted along, and part of the improved robot too: what is named was fitted with it, but it is not named itself."
    return table(("Fitted along", "Parameter", "Value ± std"), rows, caption=caption) if rows else None


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
        "Δχ² is what the effect explains of the residual beyond all that calibration can absorb; ΔBIC takes off a price "
        "for each parameter and each effect tried, "
        "and a named effect needs 10. Left-out sweeps: by how much twice the log-likelihood of sweeps that are not "
        "fitted rises, ± its standard error. “Retained” is the share of its trace "
        "that calibration leaves. “First” is how often the effect comes first when whole sweeps are drawn anew. Values: "
        "of the final fit where named, else of the linear screening. The modulus and the input offsets are not among "
        "them: they are always fitted along.",
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
