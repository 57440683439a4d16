"""The link to a camera: states, retries, words."""

from __future__ import annotations

import pytest

from femsense.live.link import FINAL, Link, LinkEvent, LinkLimits, LinkState

LIMITS = LinkLimits(warm_up_s=10.0, time_out_s=1.0, restart_s=2.0, first_retry_s=0.5, longest_retry_s=2.0, retries=3)


def streaming() -> Link:
    link = Link(0.0, LIMITS)
    link.feed(LinkEvent.OPENED, 0.5)
    link.feed(LinkEvent.FRAME, 1.0)
    return link


def test_a_camera_warms_up_and_streams() -> None:
    link = Link(0.0, LIMITS)
    assert link.status.state is LinkState.WARMING_UP and not link.tick(9.0)
    link.feed(LinkEvent.OPENED, 1.0)
    link.feed(LinkEvent.FRAME, 2.0)
    assert link.status.state is LinkState.STREAMING and link.status.text(3.0) == "streaming" and link.losses == 0


def test_no_frame_in_warm_up_restarts_the_camera_and_says_so() -> None:
    link = Link(0.0, LIMITS)
    link.feed(LinkEvent.OPENED, 1.0)
    assert not link.tick(10.9) and link.tick(11.1)
    assert link.status.state is LinkState.RECONNECTING
    assert link.status.text(12.1) == (
        "reconnecting for 1 s; no frame in 10 s of warm-up; the camera is being reset and opened again (retry 1)"
    )


def test_a_camera_that_says_nothing_more_times_out_and_is_restarted() -> None:
    link = streaming()
    assert not link.tick(1.9) and link.status.state is LinkState.STREAMING
    assert not link.tick(2.1) and link.status.state is LinkState.TIMED_OUT and link.losses == 1
    assert "check cable and hub" in link.status.text(2.2)
    assert not link.tick(4.0) and link.tick(4.2) and link.status.state is LinkState.RECONNECTING


def test_a_frame_after_a_time_out_is_a_stream_again() -> None:
    link = streaming()
    link.tick(2.1)
    link.feed(LinkEvent.FRAME, 2.5)
    assert link.status.state is LinkState.STREAMING and link.status.attempts == 0


@pytest.mark.parametrize(
    ("event", "words"), [(LinkEvent.UNPLUGGED, "reconnect the camera"), (LinkEvent.REFUSED, "other programs")]
)
def test_a_lost_camera_is_tried_again_at_longer_and_longer_intervals(event: LinkEvent, words: str) -> None:
    link = streaming()
    link.feed(event, 5.0, "gone")
    assert words in link.status.text(6.0) and "gone" in link.status.text(6.0)
    assert not link.tick(5.4) and link.tick(5.6)
    link.feed(event, 6.0)
    assert not link.tick(6.9) and link.tick(7.1)
    link.feed(event, 7.5)
    assert not link.tick(9.4) and link.tick(9.6)
    assert link.status.since_s == 5.0 and link.status.attempts == 3 and link.losses == 1


def test_retries_have_an_end() -> None:
    link = streaming()
    for k in range(LIMITS.retries):
        link.feed(LinkEvent.UNPLUGGED, 10.0 * k + 5.0)
        assert link.tick(10.0 * k + 8.0)
    link.feed(LinkEvent.UNPLUGGED, 95.0)
    assert not link.tick(98.0) and link.status.state is LinkState.GAVE_UP
    assert "femsense doctor" in link.status.text(99.0)
    link.feed(LinkEvent.FRAME, 100.0)
    assert link.status.state is LinkState.GAVE_UP and link.status.state in FINAL


def test_a_crash_waits_for_its_retry_and_keeps_its_reason() -> None:
    link = streaming()
    link.feed(LinkEvent.FRAME, 60.0)
    link.feed(LinkEvent.DIED, 60.1, "the driver crashed")
    assert not link.tick(60.2) and link.tick(60.7) and link.status.reason == "the driver crashed"


def test_time_in_which_nobody_wants_a_frame_counts_for_nothing() -> None:
    link = streaming()
    link.rest(50.0)
    assert not link.tick(50.5) and link.status.state is LinkState.STREAMING
    assert not link.tick(51.1) and link.status.state is LinkState.TIMED_OUT


def test_a_planned_pause_is_no_loss() -> None:
    link = streaming()
    link.longest_wait_s = 5.0
    assert not link.tick(6.9) and link.status.state is LinkState.STREAMING
    assert not link.tick(7.1) and link.status.text(7.2).startswith("time-out for 0 s; no frame for 6 s")


def test_a_recording_that_is_over_is_no_loss() -> None:
    link = streaming()
    link.feed(LinkEvent.ENDED, 2.0, "over")
    assert link.status.state is LinkState.ENDED and not link.tick(100.0) and link.losses == 0
