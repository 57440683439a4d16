"""The smallest effects that would have been seen."""

from __future__ import annotations

from collections.abc import Sequence

from femsense.report import words
from femsense.report.loop.document import Detectable, Loop
from femsense.report.loop.effects import LISTED, effect_name
from femsense.report.loop.evidence import Evidence, Ranked, Size
from femsense.report.page import Html, code, element, escape, table, together

CHANGE = "a change of "
UNSEEN = "too small to be seen here"


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
        caption=(
            "For each effect that was not found: the change from what is declared at which the data would have named it "
            "(expected ΔBIC of 10)."
        ),
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
