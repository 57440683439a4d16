"""Of what predicts best beside an error of the model: in which cases of the tuning set it is asked, and what it changes.

It is the last step of a search but one, so that a case in which it changes nothing needs no search without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from femsense.loop.result.records import RefitRecord
from femsense.loop.search.screening import Candidate
from femsense.loop.search.swaps import History, alternatives_to, predicting_best

SEEN = list[dict[str, Any]]()
"""What `predicting_best` was asked in the case that is under way, and what it changed."""


def predicting_best_watched(
    data: Any, history: History, refits: list[RefitRecord], table: Sequence[Candidate], *given: Any
) -> Any:
    """Return what `predicting_best` returns, and note it."""
    own = {name: next((r for r in reversed(refits) if r.name == name and r.is_named), None) for name, _ in history[1:]}
    others = {name: alternatives_to(r, refits, table) for name, r in own.items() if r is not None}
    found = predicting_best(data, history, refits, table, *given)
    SEEN.append(
        {
            "others": {name: [[r.name, r.validation_rms_m] for r in rs] for name, rs in others.items() if rs},
            "named": {name: r.validation_rms_m for name, r in own.items() if r is not None},
            "changed": found[0] is not history,
        }
    )
    return found


def table_of_best(records: Sequence[dict[str, Any]]) -> None:
    """Print how often it was asked, how often something could stand for what was named, and how often it changed that."""
    asked = [one for r in records for one in r.get("best", ())]
    others, changed = sum(bool(one["others"]) for one in asked), sum(one["changed"] for one in asked)
    print(
        f"  what predicts best: asked in {len(asked)} cases; something may stand for what is named in {others}; changed {changed}"
    )
