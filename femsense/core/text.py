"""Texts of messages and names in files: suggestions, shortening, locations in documents, normalised names."""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Sequence

_INVISIBLE = "\0\ufeff\u200b\u200c\u200d\u2060"
"""NUL pads the names of C3D files; the others have no width and come along when text is copied."""


def plain_name(text: str) -> str:
    """Return a name in its composed form (Unicode NFC), one blank for each run of blanks, without padding at its ends.

    macOS and some exports write é as two characters; both spellings are one name.
    """
    if " " not in text and text.isascii() and text.isprintable():
        return text  # as most cells of tables
    return re.sub(r"[^\S\t\r\n]+", " ", unicodedata.normalize("NFC", text)).strip().strip(_INVISIBLE + " \t\r\n")


def look_alike(words: Iterable[str], known: Iterable[str]) -> dict[str, str]:
    """Return the words that differ from a known one in nothing but case, blanks, dashes or compatibility forms → that one."""
    forms = {_folded(name): name for name in known}
    return {word: forms[_folded(word)] for word in words if _folded(word) in forms}


def _folded(name: str) -> str:
    return re.sub(r"[\W_]+", "-", unicodedata.normalize("NFKC", name).casefold()).strip("-")


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


def one_line(text: object, most: int | None = None) -> str:
    """Return a message, or that of an error, in one line, cut to `most` characters."""
    return " ".join(str(text).split())[:most]


def with_type(error: BaseException, most: int = 160) -> str:
    """Return the type of an error and its message in one line."""
    return f"{type(error).__name__}: {one_line(error, most)}".removesuffix(": ")


def key_path(location: Sequence[int | str]) -> str:
    """Return a place in a document as text: ("cables", 1, "path_m") is cables[1].path_m."""
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def numbers_text(numbers: Sequence[int]) -> str:
    """Return increasing numbers as ranges: [0, 1, 2, 5] is "0–2, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
