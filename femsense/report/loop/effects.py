"""Effects in words: their meaning, values with the plausible range, and the smallest size that would have been detected."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from femsense.loop.result.evidence import Estimate, Evidence, Ranked, Size
from femsense.loop.result.loop_result import Loop
from femsense.loop.result.records import NAMED, PASSES, Detectable, NamedEffect, TriedEffect
from femsense.model.effects import EFFECTS
from femsense.report import words

OUTCOMES = {
    NAMED: "named: part of the improved model",
    PASSES: "alternative: passes all tests too, with less evidence than the one that was named",
}
LISTED = 6
CHANGE = "a change of "
UNSEEN = "too small to be seen here"


def lacks(name: str) -> str:
    """Return what the plain model lacks where an effect acts."""
    return next((effect.lacks for effect in EFFECTS if effect.name == name), "")


def value_rows(effect: NamedEffect) -> list[tuple[str, str]]:
    """Return the parameters of an effect, each with its label and its value ± standard deviation."""
    rows = [
        (f"{key} {name}".strip(), words.parameter(value, std, parameter.unit))
        for key, parameter in effect.parameters.items()
        for name, value, std in words.entries(parameter.value, parameter.std)
    ]
    return rows or [("", words.NOTHING)]


def outcome(tried: TriedEffect) -> str:
    """Return the outcome of an effect that was tried."""
    text = tried.verdict.replace("dBIC ", "ΔBIC\u00a0").replace("\u00a0-", "\u00a0−")
    if text in OUTCOMES or not text or text.startswith("not testable"):
        return OUTCOMES.get(text, text) or words.NOTHING
    return f"excluded: {text}"


def ranked_values(
    tried: TriedEffect, effects: Sequence[NamedEffect], ranking: Mapping[str, Ranked]
) -> list[tuple[str, str, str]]:
    """Return label, value and plausible range of each parameter: of the final fit where named, else of the linear screening.
    Many parameters are drawn together."""
    ranked = ranking.get(tried.name, Ranked())
    effect = next((effect for effect in effects if effect.name == tried.name), None)
    if effect is not None and effect.parameters:
        ranges = {p.label.partition("[")[0]: p for p in ranked.parameters}
        parts = [
            (key, words.parameter(value, std, p.unit), _range(ranges.get(key)))
            for key, p in effect.parameters.items()
            for _, value, std in words.entries(p.value, p.std)
        ]
        return parts[:LISTED]
    shown = [p for p in ranked.parameters if words.known(p.value) or p.ends]
    if len(shown) > LISTED:
        seen = [p.value for p in shown if p.value is not None and words.known(p.value)]
        text = f"{words.quantity(min(seen), shown[0].unit, 2)} … {words.quantity(max(seen), shown[0].unit, 2)}" if seen else ""
        return [(f"{len(shown)} parameters", text, _range(shown[0]))]
    return [(p.label, words.with_std(p.value, p.std, p.unit) if words.known(p.value) else "", _range(p)) for p in shown]


def _range(estimate: Estimate | None) -> str:
    if estimate is None or len(estimate.ends) != 2 or not words.known(estimate.ends[0]):
        return ""
    factor, unit = words.UNITS.get(estimate.unit, (1.0, estimate.unit))
    low, high = (words.number(factor * end, 2) if words.known(end) else "∞" for end in estimate.ends)
    return words.joined(f"in\u00a0[{low},\u00a0{high}]", unit)


def smallest_sizes(loop: Loop, evidence: Evidence) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return, for every effect that was not found, the smallest change of each parameter that would have been seen, in words."""
    hidden = {effect.name for effect in loop.not_testable}
    return [
        (
            name,
            [("", "not testable")] if name in hidden else _sizes(entry, evidence.power.get(name, ()), evidence.ranking.get(name)),
        )
        for name, entry in loop.detectable.items()
        if entry.smallest or evidence.power.get(name)
    ]


def _sizes(entry: Detectable, own: Sequence[Size], ranked: Ranked | None) -> list[tuple[str, str]]:
    kind, unit = entry.kind or "change", entry.unit or "1"
    sizes = own or [Size(label, kind, size, unit) for label, size in entry.smallest.items()]
    if len(sizes) > LISTED:
        return [("", _size_span(entry, sizes))]
    ends = {p.label: p.ends for p in ranked.parameters} if ranked else {}
    return [(s.label, _seen_words(entry, s, ends.get(s.label, ()))) for s in sizes]


def _size_span(entry: Detectable, sizes: Sequence[Size]) -> str:
    count = f"({len(sizes)} parameters)"
    known = sorted((s for s in sizes if words.known(s.size)), key=lambda s: s.size or 0.0)
    if not known:
        return f"cannot be seen {count}"
    least, most = (smallest_words(s.size, s.kind, s.unit) for s in (known[0], known[-1]))
    span = f"{least} … {most.removeprefix(CHANGE)} {count}"
    return span if entry.would_be_seen else f"{UNSEEN} ({span})"


def _seen_words(entry: Detectable, size: Size, ends: Sequence[float | None]) -> str:
    """Return the smallest visible size of a parameter, or that no plausible one would be seen."""
    text = smallest_words(size.size, size.kind, size.unit)
    if size.kind == "whole" or not words.known(size.size):
        return text
    beyond = not entry.would_be_seen or is_beyond(size.size or 0.0, size.kind, ends)
    return f"{UNSEEN}: it would take {text}" if beyond else text


def is_beyond(size: float, kind: str, ends: Sequence[float | None]) -> bool:
    """Return whether a change leads out of the plausible range from wherever in it one starts."""
    low, high = (end if end is not None and words.known(end) else None for end in (ends if len(ends) == 2 else (None, None)))
    if low is None:
        return False
    if kind == "softer_than":
        return size < low
    if high is None:
        return False
    return size * low > high > 0 if kind == "factor" else size > high - low


def smallest_words(size: float | None, kind: str, unit: str) -> str:
    """Return the smallest visible size of a parameter in its own unit, in words."""
    if size is None or not words.known(size) or size <= 0:
        return "cannot be seen"
    if kind == "whole":
        larger = f"its whole change would have to be {words.number(size)} times as large"
        return "would have been seen" if size < 1.0 else f"{UNSEEN}: {larger}"
    if kind == "factor":
        return f"{CHANGE}{words.number(100.0 * (size - 1.0), 2)} %" if size < 2.0 else f"a factor of {words.number(size, 2)}"
    if kind == "softer_than":
        return f"softer than {words.quantity(size, unit, 2)}"
    return f"{CHANGE}{words.quantity(size, unit, 2)}"
