"""Work is counted by whoever does it, for whoever asks."""

from __future__ import annotations

from femsense.core.work import Work, count, counting


def test_all_who_ask_get_what_is_done_meanwhile_and_nothing_else() -> None:
    told = []
    with counting() as outer:
        count(equilibria=2)
        with counting(lambda: told.append(outer.equilibria)) as inner:
            count(equilibria=1, responses=3)
        count(refined=4)
    count(equilibria=100)
    assert outer == Work(equilibria=3, responses=3, refined=4)
    assert inner == Work(equilibria=1, responses=3)
    assert told == [3]
