"""What happened in a session: each event once, with its time, its duration and how often it recurred."""

from __future__ import annotations

from femsense.live.events import MERGE_S, SHOWN_S, EventLog, Milestone, Notice, SessionEvent
from femsense.live.link import LinkState

INF = float("inf")


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def log_of() -> tuple[EventLog, Clock]:
    clock = Clock()
    return EventLog(clock.now, clock=clock), clock


def finals(rows: list[SessionEvent]) -> list[tuple]:
    """Return the last row of each event, as a reader of the file takes it."""
    last = {(row.kind, row.begun_s): row for row in rows}
    return [(row.kind, row.text, row.begun_s, row.ended_s, row.count) for row in last.values()]


def test_every_event_is_written_and_those_that_recur_at_once_are_one_with_a_count() -> None:
    log, clock = log_of()
    rows: list[SessionEvent] = []
    log.write_to(rows.append)
    for at in (101.0, 102.0, 103.0, 120.0):
        clock.now = at
        log.happened(Notice.STAMPS_JUMP, f"at {at:.0f}")
    log.end()
    assert finals(rows) == [
        (Notice.STAMPS_JUMP, "at 103", 101.0, 103.0, 3),
        (Notice.STAMPS_JUMP, "at 120", 120.0, 120.0, 1),
    ]
    assert len(rows) == 3  # the first when it begins, and again with its count


def test_a_condition_has_a_duration_and_one_that_flaps_is_one_event() -> None:
    log, clock = log_of()
    rows: list[SessionEvent] = []
    log.write_to(rows.append)
    log.lasts(LinkState.UNPLUGGED, "gone")
    assert rows[0].ended_s == INF
    clock.now = 105.0
    log.lasts(LinkState.UNPLUGGED, "gone for good")
    log.lasts(LinkState.UNPLUGGED, "")
    clock.now = 106.0
    log.lasts(LinkState.UNPLUGGED, "again")
    clock.now = 107.0
    log.lasts(LinkState.UNPLUGGED, "")
    clock.now += MERGE_S + 0.1
    log.tick()
    assert finals(rows) == [(LinkState.UNPLUGGED, "again", 100.0, 107.0, 2)]


def test_an_event_that_goes_on_is_written_now_and_then_as_the_session_may_be_killed() -> None:
    log, clock = log_of()
    rows: list[SessionEvent] = []
    log.write_to(rows.append)
    for _ in range(25):
        clock.now += 1.0
        log.happened(Notice.MISSED, "more", 3)
        log.tick()
    assert [row.count for row in rows] == [3, 30, 60]


def test_what_happens_before_something_is_recorded_is_written_then() -> None:
    log, clock = log_of()
    log.happened(Notice.STAMPS_BACK, "early")
    log.lasts(Notice.SLOW_LINK, "USB 2")
    clock.now = 110.0
    rows: list[SessionEvent] = []
    log.write_to(rows.append)
    assert [(row.kind, row.begun_s) for row in rows] == [(Notice.STAMPS_BACK, 100.0), (Notice.SLOW_LINK, 100.0)]


def test_a_condition_that_lasts_over_a_zero_is_in_both_parts() -> None:
    log, clock = log_of()
    first: list[SessionEvent] = []
    second: list[SessionEvent] = []
    log.write_to(first.append)
    log.lasts(Notice.SLOW_LINK, "USB 2")
    clock.now = 104.0
    log.happened(Milestone.ZERO, "reference 1")
    log.leave()
    clock.now = 105.0
    log.happened(Notice.DROPPED, "between")
    log.write_to(second.append)
    clock.now = 109.0
    log.end()
    assert finals(first) == [(Notice.SLOW_LINK, "USB 2", 100.0, 104.0, 1), (Milestone.ZERO, "reference 1", 104.0, 104.0, 1)]
    assert finals(second) == [(Notice.SLOW_LINK, "USB 2", 104.0, 109.0, 1), (Notice.DROPPED, "between", 105.0, 105.0, 1)]


def test_what_is_shown_expires_and_the_totals_stay() -> None:
    log, clock = log_of()
    log.happened(Notice.DROPPED, "3 so far", 3)
    log.lasts(Notice.SLOW_LINK, "USB 2")
    clock.now += SHOWN_S + 0.1
    assert [event.kind for event in log.recent()] == [Notice.SLOW_LINK]
    log.happened(Notice.DROPPED, "5 so far", 2)
    assert [(event.kind, event.text) for event in log.recent()] == [(Notice.SLOW_LINK, "USB 2"), (Notice.DROPPED, "5 so far")]
    assert [(event.kind, event.count) for event in log.totals()] == [(Notice.DROPPED, 5), (Notice.SLOW_LINK, 1)]
