"""One name for one thing: words that the field has better ones for stay out of the package and its pages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import femsense

PACKAGE = Path(femsense.__file__).parent
ROOT = PACKAGE.parent
RETIRED = {
    r"\b(strays?|stray points?)\b": "outliers",
    r"\bkinks?\b": "slack nonsmoothness",
    r"\brivals?\b": "confounded or competing effects",
    r"\b(menu|outlook)\b": "candidate experiments, identifiability",
    r"\bimitat\w+\b": "absorbed by calibration",
    r"\bcom(es?|ing) to rest\b": "converges, is at equilibrium",
    r"\bmesh costs?\b": "discretisation error",
    r"\b(tells?|told|telling) (\w+ ){0,3}apart\b": "distinguishable, distinguished",
    r"\bgiv(es?|en|ing) up\b": "stopped early",
    r"\bpromises? (too|less|more|as) (little|much)\b": "predicted gain",
    r"\b(march(es|ed|ing)?|walk along)\b": "quasi-static path",
}
"""Pattern → the field's word."""
PAGES = sorted(
    [
        *(file for file in PACKAGE.rglob("*.py") if "viewer" not in file.parts),
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "README.md",
    ]
)


def retired_words(text: str) -> list[str]:
    """Return the retired words of a text with what to write in their place."""
    return [
        f"{found.group(0)!r}: {better}"
        for pattern, better in RETIRED.items()
        for found in re.finditer(pattern, text, re.IGNORECASE)
    ]


@pytest.mark.parametrize("file", PAGES, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_words_are_those_of_the_field(file: Path) -> None:
    assert not retired_words(file.read_text(encoding="utf-8"))


def test_a_retired_word_is_seen() -> None:
    assert retired_words("Two strays, which these data cannot tell apart.") == [
        "'strays': outliers",
        "'tell apart': distinguishable, distinguished",
    ]
    assert not retired_words("Outliers are set aside, and the fit converges.")
