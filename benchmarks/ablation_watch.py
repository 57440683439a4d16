"""Of what takes the place of an effect beside an error of the model because it is simpler: in which cases of the tuning set it is asked, and what
it changes.

It is the last step of a search but one, so that a case in which it changes nothing needs no search without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from femsense.loop.result.records import RefitRecord
from femsense.loop.search.swaps import History, simplest

SEEN = list[dict[str, Any]]()
"""Calls of `simplest` in the current case, and the changes that it made."""


def simplest_watched(setting: Any, history: History, refits: list[RefitRecord], *given: Any) -> Any:
    """Return what `simplest` returns, and note it."""
    found = simplest(setting, history, refits, *given)
    SEEN.append({"named": [name for name, _ in history[1:]], "changed": found[0] is not history})
    return found


def table_of_best(records: Sequence[dict[str, Any]]) -> None:
    """Print how often it was asked, how often there was an effect, and how often it changed that."""
    asked = [one for r in records for one in r.get("best", ())]
    named, changed = sum(bool(one["named"]) for one in asked), sum(one["changed"] for one in asked)
    print(f"  the simplest: asked in {len(asked)} cases; something was named in {named}; changed {changed}")
