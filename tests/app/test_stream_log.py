"""What a stream says while it runs, and when it ends."""

from __future__ import annotations

import pytest

from femsense.app.stream_log import Streamed, StreamLog, connection, readings_from


def test_each_connection_and_source_is_said_for_itself_when_it_goes_and_when_it_is_back() -> None:
    why = {"broker": "", "sensors": ""}
    log = StreamLog([connection("box:1883", lambda: why["broker"]), readings_from("a.csv", lambda: why["sensors"])])
    assert log.news() == []
    why["sensors"] = "they stopped"
    assert log.news() == ["no readings of a.csv (they stopped), waiting"]
    why["broker"] = "no answer"
    assert log.news() == ["no connection to box:1883 (no answer), trying again"]
    assert log.news() == []  # once
    why["broker"] = ""
    assert log.news() == ["connected to box:1883"]  # though readings are missing still
    why["sensors"] = ""
    assert log.news() == ["readings of a.csv come"]


def test_what_is_passed_over_among_readings_is_said_once() -> None:
    why, refused = [""], [""]
    log = StreamLog([readings_from("a.csv", lambda: why[0], lambda: refused[0])])
    assert log.news() == []
    why[0], refused[0] = "no reading, first 'x'", "no reading, first 'x'"
    assert log.news() == ["no readings of a.csv (no reading, first 'x'), waiting"]
    why[0] = ""
    assert log.news() == ["readings of a.csv come", "some of a.csv is passed over: no reading, first 'x'"]
    assert log.news() == []


@pytest.mark.parametrize(
    ("streamed", "text"),
    [
        (Streamed({"arm": 1}, 2.04, 0), "streamed 1 pose of arm in 2.0 s, to no viewers"),
        (
            Streamed({"a": 120, "b": 60}, 3.0, 1, 2, {"box:1883": True}),
            "streamed 120 poses of a and 60 poses of b in 3.0 s, to 1 viewer, 2 clients of the broker and the broker box:1883",
        ),
        (
            Streamed({"a": 3}, 1.0, 0, None, {"box:1": False}),
            "streamed 3 poses of a in 1.0 s, to no viewers; the broker box:1 was never reached",
        ),
        (
            Streamed({"a": 2}, 1.0, 0, passed=3),
            "streamed 2 poses of a in 1.0 s, to no viewers; 3 lines passed over: no readings",
        ),
        (Streamed({"a": 0}, 3.0, 2, 0), "streamed no poses of a in 3.0 s, to 2 viewers and no clients of the broker"),
    ],
)
def test_the_end_says_what_was_streamed_how_much_and_to_how_many(streamed: Streamed, text: str) -> None:
    assert streamed.text == text
