"""Words in messages: what was meant, cut to a width, and where in a document."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence


def did_you_mean(word: str, known: Iterable[str]) -> str | None:
    """Return a hint that names the known words closest to a word; None where none is close."""
    likeness = {name: difflib.SequenceMatcher(None, word.lower(), name.lower()).ratio() for name in known}
    best = max(likeness.values(), default=0.0)
    names = [name for name, value in likeness.items() if value >= max(0.6, best - 0.05)]
    return "did you mean " + " or ".join(repr(name) for name in names[:3]) + "?" if names else None


def short(value: object, width: int = 90) -> str:
    """Return a value as text, cut to a width."""
    text = repr(value)
    return text if len(text) <= width else text[: width - 1] + "…"


def key_path(location: Sequence[int | str]) -> str:
    """Return a place in a document as text: ("cables", 1, "path_m") is cables[1].path_m."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text
