"""The plain tables of loop.json: which keys a record has, and that they are read back as they were written."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import write_block_robot
from results import make_loop

from femsense.core.errors import InputError
from femsense.io.files import plain
from femsense.io.robot_toml import load_robot
from femsense.loop.files import saved_loop
from femsense.loop.result.evidence import Estimate, Evidence, ForceField, ForceImpact, FrameTable, Ranked, Tip
from femsense.loop.result.records import (
    NAMED,
    PASSES,
    ConfoundedPair,
    Detectable,
    ModelError,
    RefitRecord,
    Residuals,
    TriedEffect,
    Value,
)
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


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path))
    tried = TriedEffect(
        "payload", {"point_m": [0.1, 0.0, 0.0]}, 40.0, None, 0.4, None, (RefitRecord("payload", {}, PASSES, dbic=3.0),)
    )
    evidence = Evidence(
        frames=FrameTable(*(((0,),) * 2 + ((1.0,), ("one",), (True,), (2.0,), (False,)) + ((math.nan,),) * 5)),
        ranking={"payload": Ranked((Estimate("force_n", 0.1, None, (0.0, math.inf), "N"),), 0.9)},
    )
    residuals = Residuals((0,), (3,), ("tip",), ((1e-3, 0.0, math.nan),), ((0.0, 0.0, 1e-4),))
    document = plain(replace(make_loop(robot), candidates=(tried,), residuals=residuals, evidence=evidence).document())
    loop = saved_loop(document)
    assert isinstance(loop.candidates[0].refits[0], RefitRecord) and math.isnan(loop.after.validation_rms_m)
    again = plain(table_of(loop, without=("inputs", "versions")))
    filled = {"tip": plain(table_of(Tip())), "equivalent_forces": plain(table_of(ForceField()))}
    assert again == {key: value for key, value in document.items() if key != "format"} | {
        "model_error": plain(table_of(ModelError())),
        "evidence": document["evidence"] | filled,
    }


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(InputError, match="the columns differ in length") as error:
        saved_loop({"residuals": {"recording": [0], "frame": [1, 2]}})
    assert error.value.where == "loop.json: residuals"
