"""The plain tables of loop.json: which keys a record has."""

from __future__ import annotations

import pytest

from femsense.loop.result.evidence import ForceImpact
from femsense.loop.result.records import NAMED, PASSES, ConfoundedPair, Detectable, RefitRecord, TriedEffect, Value
from femsense.loop.result.tables import table_of


def test_what_is_not_known_of_a_refit_is_no_key() -> None:
    record = RefitRecord("creep", {"time_s": 2.0}, PASSES, step=1, dbic=12.0, takes_over=("stiffness",))
    expected = {
        "name": "creep",
        "seed": {"time_s": 2.0},
        "verdict": "passes",
        "step": 1,
        "dbic": 12.0,
        "takes_over": ["stiffness"],
    }
    assert table_of(record) == expected


def test_scores_of_what_was_not_screened_are_null() -> None:
    row = TriedEffect("discretisation", {}, None, None, None, None, (RefitRecord("discretisation", {}, NAMED),), NAMED)
    table = table_of(row)
    assert table["dbic"] is None and table["refits"] == [{"name": "discretisation", "seed": {}, "verdict": "named"}]


@pytest.mark.parametrize(
    ("record", "table"),
    [
        (
            ConfoundedPair(("stiffness", "cable_gain"), absorbed_share=0.99),
            {"pair": ["stiffness", "cable_gain"], "absorbed_share": 0.99},
        ),
        (Detectable({}, would_be_seen=False, share_seen=0.4), {"smallest": {}, "would_be_seen": False, "share_seen": 0.4}),
        (ForceImpact(), {}),
        ({"scale": Value(1.2, None, "1")}, {"scale": {"value": 1.2, "std": None, "unit": "1"}}),
    ],
    ids=["pair", "detectable", "no forces", "not fitted"],
)
def test_tables_have_the_keys_of_what_is_known(record: object, table: dict[str, object]) -> None:
    assert table_of(record) == table


def test_refits_answer_the_same_question_on_the_same_model_alone() -> None:
    one = RefitRecord("creep", {}, step=1)
    assert one.answers_as(RefitRecord("gravity", {}, step=1))
    assert not one.answers_as(RefitRecord("gravity", {}, step=2))
    assert not one.answers_as(RefitRecord("gravity", {}, step=1, in_place_of="payload"))
