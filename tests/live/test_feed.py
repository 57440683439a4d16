"""A camera in a process of its own: a software camera with each fault, seen from the session."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import pytest
from live_block import notices, write_watched_block

from femsense.core.errors import FemsenseError
from femsense.live.events import Notice
from femsense.live.feed import CameraFeed, FeedOptions
from femsense.live.frames import StampedFrame
from femsense.live.link import LinkLimits, LinkState

LIMITS = LinkLimits(warm_up_s=8.0, time_out_s=0.5, restart_s=0.5, first_retry_s=0.1, longest_retry_s=0.2)
PATIENCE_S = 18.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_watched_block(tmp_path_factory.mktemp("watched"), free=8, touched=0)[1]


def watched(feed: CameraFeed, enough) -> tuple[list[StampedFrame], list[LinkState], list[str]]:
    """Return frames, states of the link in their order and their texts, until `enough(frames, states)`."""
    frames, states, texts = [], [], []
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end and not feed.is_over and not enough(frames, states):
        frame = feed.take(0.05)
        status = feed.status
        if not states or states[-1] is not status.state:
            states.append(status.state)
            texts.append(status.text(time.monotonic()))
        if frame is not None:
            frames.append(frame)
    return frames, states, texts


def back_again(frames: list[StampedFrame], states: list[LinkState]) -> bool:
    return len(states) > 2 and states[-1] is LinkState.STREAMING and LinkState.STREAMING in states[:-1]


def test_every_frame_of_a_recording_comes_as_fast_as_it_is_asked_for(recording: Path) -> None:
    with CameraFeed(str(recording), FeedOptions(as_fast_as_possible=True)) as feed:
        frames, states, _ = watched(feed, lambda frames, _states: len(frames) == 9)
    assert [frame.number for frame in frames] == list(range(8)) and states[-1] is LinkState.ENDED
    assert [frame.time_s for frame in frames] == pytest.approx([0.1 * k for k in range(8)])
    assert frames[3].raw.images[0].data == (recording / "clouds" / "000003.ply").read_bytes()


def test_who_is_slow_gets_the_newest_frame_and_the_others_are_counted(recording: Path) -> None:
    skipped: list[int] = []
    with CameraFeed(f"software:{recording}", on_skipped=lambda frame: skipped.append(frame.number)) as feed:
        first = feed.take(PATIENCE_S)
        time.sleep(1.0)
        newest = feed.take(1.0)
        counts = feed.counts
    assert first is not None and newest is not None and newest.number >= first.number + 5
    assert skipped == list(range(first.number + 1, newest.number)) and counts.skipped == len(skipped)
    assert time.monotonic() - newest.taken_s < 5.0


@pytest.mark.parametrize(
    ("fault", "state", "words"),
    [
        ("unplug=3+1.5", LinkState.UNPLUGGED, "reconnect the camera"),
        ("refuse=3+1.5", LinkState.REFUSED, "close other programs"),
        ("silent=3+0.8", LinkState.TIMED_OUT, "check cable and hub"),
        ("hang=3+1.0", LinkState.TIMED_OUT, "no frame for"),
        ("crash=3+0.1", LinkState.RECONNECTING, "the camera driver crashed"),
    ],
)
def test_a_camera_that_is_lost_comes_back_by_itself(recording: Path, fault: str, state: LinkState, words: str) -> None:
    with CameraFeed(f"software:{recording}?{fault}", FeedOptions(link=LIMITS)) as feed:
        frames, states, texts = watched(feed, back_again)
        losses = feed.losses
    assert state in states and states[-1] is LinkState.STREAMING and losses >= 1, states
    assert words in texts[states.index(state)]
    numbers, times = [frame.number for frame in frames], [frame.time_s for frame in frames]
    assert numbers == sorted(set(numbers)) and times == sorted(set(times))


@pytest.mark.parametrize(("fault", "state"), [("refuse=0+4", LinkState.REFUSED), ("unplug=0+4", LinkState.UNPLUGGED)])
def test_a_camera_that_fails_from_the_first_attempt_on_recovers_too(recording: Path, fault: str, state: LinkState) -> None:
    with CameraFeed(f"software:{recording}?{fault}", FeedOptions(link=LIMITS)) as feed:
        frames, states, _ = watched(feed, lambda frames, _states: len(frames) > 1)
    assert state in states and states[-1] is LinkState.STREAMING and frames, states
    assert state in [event.kind for event in feed.log.totals()]


def test_a_recording_with_long_pauses_is_no_failing_camera(recording: Path, tmp_path: Path) -> None:
    slow = tmp_path / "slow"
    shutil.copytree(recording, slow)
    head, *rows = (slow / "frames.csv").read_text().splitlines()
    times = [0.0, 1.9, 3.8, 3.9, 4.0, 4.1, 4.2, 4.3]
    slower = [",".join([row.split(",")[0], str(time_s), *row.split(",")[2:]]) for row, time_s in zip(rows, times)]
    (slow / "frames.csv").write_text("\n".join([head, *slower, ""]))
    with CameraFeed(str(slow), FeedOptions(link=LIMITS)) as feed:
        frames, states, _ = watched(feed, lambda frames, _states: len(frames) == 3)
    assert [frame.number for frame in frames] == [0, 1, 2] and LinkState.TIMED_OUT not in states, states


def test_a_driver_that_hangs_for_good_is_ended_and_started_anew(recording: Path) -> None:
    limits = LinkLimits(warm_up_s=4.0, time_out_s=0.3, restart_s=0.2, retries=1)
    with CameraFeed(f"software:{recording}?hang=2+600", FeedOptions(link=limits)) as feed:
        _, states, _ = watched(feed, lambda _frames, _states: False)
        assert states[-1] is LinkState.GAVE_UP and LinkState.RECONNECTING in states
        begun = time.monotonic()
    assert time.monotonic() - begun < PATIENCE_S


def test_a_camera_without_a_first_frame_is_restarted(recording: Path) -> None:
    limits = LinkLimits(warm_up_s=0.4, retries=60)
    with CameraFeed(f"software:{recording}?silent=0+2", FeedOptions(link=limits)) as feed:
        _, states, texts = watched(feed, lambda _frames, states: LinkState.RECONNECTING in states)
    assert "no frame in 0.4 s of warm-up" in texts[states.index(LinkState.RECONNECTING)]


@pytest.mark.parametrize(
    ("fault", "notice", "words"),
    [
        ("usb2=0+600", Notice.SLOW_LINK, "USB 2.1: use a USB 3 port"),
        ("back=3+600", Notice.STAMPS_BACK, "the time mapping restarts"),
        ("jump=3+600", Notice.STAMPS_JUMP, "by 100"),
        ("apart=0+30", Notice.OUT_OF_STEP, "80 ms of a period of 100 ms"),
        ("drop=3+0.4", Notice.DROPPED, "not delivered by the device or its link"),
        ("flicker=0+600", Notice.FLICKER, "between 4.0 and 12.0 ms"),
    ],
)
def test_what_is_wrong_with_frames_is_said(recording: Path, fault: str, notice: Notice, words: str) -> None:
    said = ""
    with CameraFeed(f"software:{recording}?{fault}") as feed:
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end and not said:
            feed.take(0.05)
            said = notices(feed.log).get(notice, "")
    assert words in said


def test_a_source_that_cannot_be_used_says_why_where_it_is_asked(tmp_path: Path) -> None:
    with CameraFeed("nonsense:1") as feed, pytest.raises(FemsenseError, match="no such source of frames"):
        watched(feed, lambda _frames, _states: False)
    with CameraFeed(f"software:{tmp_path}?unplugged=3+1") as feed, pytest.raises(FemsenseError, match="no such fault"):
        watched(feed, lambda _frames, _states: False)
