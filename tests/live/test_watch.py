"""Numbers and times of frames on the session's clock, and what their stamps reveal."""

from __future__ import annotations

import pytest
from live_block import notices, raw

from femsense.live.clock import ClockMap
from femsense.live.events import EventLog, Notice
from femsense.live.watch import FrameWatch


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
    log = EventLog(10.0)
    watch = FrameWatch(log)
    frames = [watch.stamp(raw(number, 0.1 * number, 10.0 + 0.1 * number)) for number in (5, 6, 9)]
    assert [frame.number for frame in frames] == [0, 1, 4] and watch.dropped == 2
    assert "2 so far, not delivered by the device or its link" in notices(log)[Notice.DROPPED]
    assert [frame.time_s for frame in frames] == pytest.approx([0.5, 0.6, 0.9])


@pytest.mark.parametrize(
    ("ready_s", "arrived_s", "missed"),
    [
        (0.21, 0.2, 0),  # the reader was waiting all the time: the frames never came
        (0.65, 0.2, 4),  # the reader was busy until the fifth frame after the last one
        (0.36, 0.2, 1),
        (0.71, 0.7, 5),  # the last frame was taken late, as on a machine that did not run the reader
    ],
)
def test_a_gap_while_the_reader_was_busy_is_not_the_device_s(ready_s: float, arrived_s: float, missed: int) -> None:
    log = EventLog(0.0)
    watch = FrameWatch(log)
    watch.stamp(raw(0, 0.0, 0.0))
    watch.stamp(raw(1, 0.1, 0.1))
    watch.stamp(raw(2, 0.2, arrived_s))
    last = watch.stamp(raw(8, 0.8, 0.8, ready_s=ready_s))
    assert (watch.missed, watch.dropped, last.number) == (missed, 5 - missed, 8)
    assert (Notice.MISSED in notices(log)) == (missed > 0) and (Notice.DROPPED in notices(log)) == (missed < 5)


def test_a_frame_that_was_overwritten_before_it_was_read_is_no_gap_of_the_device() -> None:
    log = EventLog(0.0)
    watch = FrameWatch(log)
    watch.stamp(raw(0, 0.0, 0.0))
    watch.unread()
    watch.stamp(raw(2, 0.2, 0.2))
    assert watch.dropped == watch.missed == 0 and not notices(log)


@pytest.mark.parametrize(("step", "notice"), [(-5.0, Notice.STAMPS_BACK), (100.0, Notice.STAMPS_JUMP)])
def test_a_clock_that_is_set_is_said_and_times_go_on(step: float, notice: Notice) -> None:
    log = EventLog(0.0)
    watch = FrameWatch(log)
    stamps = [0.0, 0.1, 0.2, 0.3 + step, 0.4 + step]
    frames = [watch.stamp(raw(k, stamp, 0.1 * k)) for k, stamp in enumerate(stamps)]
    assert notice in notices(log)
    assert [frame.time_s for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4], abs=1e-3)


def test_times_increase_even_where_stamps_repeat() -> None:
    watch = FrameWatch(EventLog(0.0))
    times = [watch.stamp(raw(k, 0.1, 0.1)).time_s for k in range(3)]
    assert times[0] < times[1] < times[2]


def test_cameras_out_of_step_are_said_with_their_offset_until_they_are_not() -> None:
    log = EventLog(0.0)
    watch = FrameWatch(log)
    for k in range(3):
        watch.stamp(raw(k, 0.1 * k, 0.1 * k, view_stamps_s=(0.1 * k, 0.1 * k + 0.08)))
    assert "80 ms of a period of 100 ms" in notices(log)[Notice.OUT_OF_STEP]
    watch.stamp(raw(3, 0.3, 0.3, view_stamps_s=(0.3, 0.301)))
    assert [event.kind for event in log.recent() if event.ended_s == float("inf")] == []


def test_exposure_that_hunts_is_said_and_a_steady_one_is_not() -> None:
    calm, restless = EventLog(0.0), EventLog(0.0)
    steady, hunting = FrameWatch(calm), FrameWatch(restless)
    for k in range(40):
        steady.stamp(raw(k, 0.1 * k, 0.1 * k, exposure_s=8e-3))
        hunting.stamp(raw(k, 0.1 * k, 0.1 * k, exposure_s=(4e-3, 12e-3)[k % 2]))
    assert not notices(calm) and "between 4.0 and 12.0 ms" in notices(restless)[Notice.FLICKER]


def test_a_recording_that_is_not_replayed_at_its_speed_keeps_its_times() -> None:
    log = EventLog(50.0)
    watch = FrameWatch(log, by_stamps=True)
    frames = [watch.stamp(raw(k, 3.0 + k, 50.0 + 0.01 * k)) for k in range(3)]
    assert [frame.time_s for frame in frames] == [3.0, 4.0, 5.0] and not notices(log)
