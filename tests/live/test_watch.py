"""Numbers and times of frames on the session's clock, and what their stamps reveal."""

from __future__ import annotations

import pytest
from live_block import raw

from femsense.live.clock import ClockMap
from femsense.live.watch import FrameWatch, Notice


def test_a_delayed_message_does_not_move_the_clock() -> None:
    clock = ClockMap()
    times = [
        clock.host_time(stamp, stamp + 100.0 + delay) for stamp, delay in ((0.0, 0.02), (1.0, 0.01), (2.0, 0.5), (3.0, 0.01))
    ]
    assert times == pytest.approx([100.02, 101.01, 102.01, 103.01], abs=1e-3)


def test_a_slower_clock_is_followed() -> None:
    clock = ClockMap()
    times = [clock.host_time(t * (1.0 - 5e-5), t) for t in range(2000)]
    assert times[-1] == pytest.approx(1999.0, abs=0.01)


def test_gaps_in_the_counter_are_counted_and_numbered() -> None:
    watch = FrameWatch(10.0)
    frames = [watch.stamp(raw(number, 0.1 * number, 10.0 + 0.1 * number)) for number in (5, 6, 9)]
    assert [frame.number for frame in frames] == [0, 1, 4] and watch.dropped == 2
    assert "2 frames" in watch.notices[Notice.DROPPED]
    assert [frame.time_s for frame in frames] == pytest.approx([0.5, 0.6, 0.9])


@pytest.mark.parametrize(("step", "notice"), [(-5.0, Notice.STAMPS_BACK), (100.0, Notice.STAMPS_JUMP)])
def test_a_clock_that_is_set_is_said_and_times_go_on(step: float, notice: Notice) -> None:
    watch = FrameWatch(0.0)
    stamps = [0.0, 0.1, 0.2, 0.3 + step, 0.4 + step]
    frames = [watch.stamp(raw(k, stamp, 0.1 * k)) for k, stamp in enumerate(stamps)]
    assert notice in watch.notices
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-3)


def test_times_increase_even_where_stamps_repeat() -> None:
    watch = FrameWatch(0.0)
    times = [watch.stamp(raw(k, 0.1, 0.1)).time_s for k in range(3)]
    assert times[0] < times[1] < times[2]


def test_cameras_out_of_step_are_said_with_their_offset_until_they_are_not() -> None:
    watch = FrameWatch(0.0)
    for k in range(3):
        watch.stamp(raw(k, 0.1 * k, 0.1 * k, view_stamps_s=(0.1 * k, 0.1 * k + 0.08)))
    assert "80 ms of a period of 100 ms" in watch.notices[Notice.OUT_OF_STEP]
    watch.stamp(raw(3, 0.3, 0.3, view_stamps_s=(0.3, 0.301)))
    assert Notice.OUT_OF_STEP not in watch.notices


def test_exposure_that_hunts_is_said_and_a_steady_one_is_not() -> None:
    steady, hunting = FrameWatch(0.0), FrameWatch(0.0)
    for k in range(40):
        steady.stamp(raw(k, 0.1 * k, 0.1 * k, exposure_s=8e-3))
        hunting.stamp(raw(k, 0.1 * k, 0.1 * k, exposure_s=(4e-3, 12e-3)[k % 2]))
    assert not steady.notices and "between 4.0 and 12.0 ms" in hunting.notices[Notice.FLICKER]


def test_a_recording_that_is_not_replayed_at_its_speed_keeps_its_times() -> None:
    watch = FrameWatch(50.0, by_stamps=True)
    frames = [watch.stamp(raw(k, 3.0 + k, 50.0 + 0.01 * k)) for k in range(3)]
    assert [frame.time_s for frame in frames] == [3.0, 4.0, 5.0] and not watch.notices
