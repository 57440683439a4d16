"""How far the work is, by what was counted and what is expected."""

from __future__ import annotations

import pytest

from femsense.core.work import count
from femsense.loop.search.work_plan import (
    ALL_STATES,
    CALIBRATION,
    COSTS,
    EVERY,
    PASSES,
    QUADRATIC,
    SEARCH,
    VERDICT,
    WorkPlan,
    in_words,
)


class Clock:
    """Seconds as a test wants them."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_share_and_time_left_go_by_equilibria_done_and_planned() -> None:
    clock, told = Clock(), list[str]()
    plan = WorkPlan(told.append, clock)
    with plan.watching():
        plan("reading")
        count(equilibria=20)
        assert plan.share == 0.0 and plan.seconds_left == float("inf")  # nothing is planned yet
        plan.plan([CALIBRATION, SEARCH], 10, quadratic=False)
        whole = 10 * (PASSES[CALIBRATION] + PASSES[SEARCH])
        clock.now = 8.0
        count(equilibria=20)
        assert plan.share == pytest.approx(40 / (20 + whole))
        assert plan.seconds_left == pytest.approx(8.0 * (whole - 20) / 40)
        plan.next_stage()  # it took less than was expected
        assert plan.share == pytest.approx(40 / (40 + 10 * PASSES[SEARCH]))
        count(responses=20)
        assert plan.share == pytest.approx((40 + 20 * COSTS["responses"]) / (40 + 10 * PASSES[SEARCH]))
    assert told[0] == "reading"
    assert told[1].startswith(f"reading ({40 / (20 + whole):.0%}, about ") and told[1].endswith(" s left)")


def test_more_work_than_was_expected_never_takes_the_share_back_nor_ends_it() -> None:
    plan = WorkPlan(lambda text: None, Clock())
    with plan.watching():
        plan.plan([SEARCH, VERDICT], 5, quadratic=True)
        shares = []
        for _ in range(200):
            count(equilibria=5)
            shares.append(plan.share)
        assert shares == sorted(shares) and 0.5 < shares[-1] < 1.0
        before = plan.share
        plan.plan([ALL_STATES, SEARCH, VERDICT], 100, quadratic=True)  # something was found
        assert plan.share == before
        plan.plan([VERDICT], 5, quadratic=True)
        count(equilibria=round(5 * PASSES[VERDICT]))
        assert plan.share > 0.9
    assert QUADRATIC > 1.0


def test_it_is_said_again_only_after_some_time() -> None:
    clock, told = Clock(), list[str]()
    plan = WorkPlan(told.append, clock)
    with plan.watching():
        plan.plan([SEARCH], 10, quadratic=False)
        plan("refitting")
        for clock.now in (0.2 * EVERY, 0.4 * EVERY, 1.1 * EVERY, 1.3 * EVERY, 2.3 * EVERY):
            count(equilibria=1)
    assert len(told) == 3 and told[1].startswith("refitting (")


def test_times_are_said_in_seconds_or_minutes() -> None:
    assert [in_words(s) for s in (0.2, 41.3, 119.0, 200.0)] == ["1 s", "41 s", "119 s", "3 min"]


def test_a_stage_that_takes_longer_is_nearer_to_its_end_the_longer_it_takes() -> None:
    shares = []
    for times in (1, 4, 16):
        plan = WorkPlan(lambda text: None, Clock())
        with plan.watching():
            plan.plan([SEARCH], 5, quadratic=False)
            count(equilibria=round(times * 5 * PASSES[SEARCH]))
            shares.append(plan.share)
    assert shares == pytest.approx([1 / 1.25, 4 / 4.125, 16 / 16.0625])
