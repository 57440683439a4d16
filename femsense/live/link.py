"""The link to a camera as a state machine, with the reason of each state and advice to the user."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class LinkState(StrEnum):
    """State of the link."""

    WARMING_UP = "warm-up"
    """Opened or being opened; no frame yet."""
    STREAMING = "streaming"
    TIMED_OUT = "time-out"
    """No frame for longer than `LinkLimits.time_out_s`; the device is still connected."""
    UNPLUGGED = "unplugged"
    REFUSED = "refused"
    """The device is connected and cannot be used."""
    RECONNECTING = "reconnecting"
    """Being opened again after a loss."""
    ENDED = "ended"
    """The recording has ended."""
    GAVE_UP = "gave up"
    """All retries have failed."""


class LinkEvent(StrEnum):
    """Events of a link."""

    OPENED = "opened"
    FRAME = "frame"
    UNPLUGGED = "unplugged"
    REFUSED = "refused"
    ENDED = "ended"
    DIED = "died"
    """The camera process ended: its driver crashed."""


LOST = (LinkState.TIMED_OUT, LinkState.UNPLUGGED, LinkState.REFUSED, LinkState.RECONNECTING, LinkState.GAVE_UP)
"""States in which a result is older than it should be."""
FINAL = (LinkState.ENDED, LinkState.GAVE_UP)
ADVICE = {
    LinkState.WARMING_UP: "the first frames are on their way",
    LinkState.STREAMING: "",
    LinkState.TIMED_OUT: "check cable and hub; the camera is restarted if none comes",
    LinkState.UNPLUGGED: "reconnect the camera: the session continues by itself",
    LinkState.REFUSED: "close other programs that use the camera",
    LinkState.RECONNECTING: "the camera is being reset and opened again",
    LinkState.ENDED: "",
    LinkState.GAVE_UP: "start the session again once `femsense doctor` lists the camera",
}


@dataclass(frozen=True, slots=True)
class LinkLimits:
    """Timing of loss detection and retries."""

    warm_up_s: float = 10.0
    """Cameras need up to 5 s for their first frame after a reset."""
    time_out_s: float = 1.0
    restart_s: float = 2.0
    """A camera without frames for this long after a time-out is restarted in a new process."""
    first_retry_s: float = 0.5
    longest_retry_s: float = 5.0
    """The delay doubles from retry to retry up to this."""
    retries: int = 60
    """Maximum number of retries without a frame in between: about five minutes."""


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """A state with its reason."""

    state: LinkState
    since_s: float
    """[s, monotonic clock]."""
    reason: str = ""
    attempts: int = 0
    """Number of retries since the last frame."""

    def text(self, now_s: float) -> str:
        """Return the status in words: state, duration, reason, and advice."""
        if self.state is LinkState.STREAMING:
            return self.state.value
        parts = [f"{self.state.value} for {now_s - self.since_s:.0f} s", self.reason, ADVICE[self.state]]
        tried = f" (retry {self.attempts})" if self.attempts and self.state not in FINAL else ""
        return "; ".join(part for part in parts if part) + tried


class Link:
    """The state machine. It has no clock and no device: events and times are its input, restarts its output."""

    def __init__(self, now_s: float, limits: LinkLimits | None = None) -> None:
        self.limits = limits or LinkLimits()
        self.status = LinkStatus(LinkState.WARMING_UP, now_s)
        self.losses = 0
        """Number of times that a stream was lost."""
        self.longest_wait_s = 0.0
        """Longest planned time between two frames [s]; time-out and warm-up are longer by it."""
        self._last_frame_s = now_s
        self._started_s = now_s
        self._next_try_s = float("inf")

    def feed(self, event: LinkEvent, now_s: float, reason: str = "") -> None:
        """Process an event."""
        state = self.status.state
        if state in FINAL:
            return
        if event is LinkEvent.FRAME:
            self._last_frame_s, self._next_try_s = now_s, float("inf")
            if state is not LinkState.STREAMING:
                self.status = LinkStatus(LinkState.STREAMING, now_s)
        elif event is LinkEvent.OPENED:
            self._enter(LinkState.WARMING_UP, now_s, "")
            self._started_s = now_s
        elif event is LinkEvent.ENDED:
            self._enter(LinkState.ENDED, now_s, reason)
        else:
            self._count_loss()
            lost = LinkState(event.value) if event is not LinkEvent.DIED else LinkState.RECONNECTING
            self._enter(lost, now_s, reason)
            wait = self.limits.first_retry_s * 2.0 ** min(self.status.attempts, 16)
            self._next_try_s = now_s + min(wait, self.limits.longest_retry_s)

    def rest(self, now_s: float) -> None:
        """Exclude a time in which no frame was requested."""
        self._last_frame_s = self._started_s = now_s

    def tick(self, now_s: float) -> bool:
        """Advance the time; return whether to restart the camera now."""
        status, limits = self.status, self.limits
        time_out_s, warm_up_s = (one + self.longest_wait_s for one in (limits.time_out_s, limits.warm_up_s))
        if status.state is LinkState.STREAMING and now_s - self._last_frame_s > time_out_s:
            self._count_loss()
            self._enter(LinkState.TIMED_OUT, now_s, f"no frame for {time_out_s:g} s")
        elif status.state is LinkState.TIMED_OUT and now_s - status.since_s > limits.restart_s:
            return self._retry(now_s, LinkState.RECONNECTING, "no more frames arrived")
        elif now_s >= self._next_try_s:
            return self._retry(now_s, status.state, status.reason)
        elif self._is_starting and now_s - self._started_s > warm_up_s:
            return self._retry(now_s, LinkState.RECONNECTING, f"no frame in {warm_up_s:g} s of warm-up")
        return False

    @property
    def _is_starting(self) -> bool:
        """Whether the camera was started and has not delivered a frame yet."""
        waits = self._next_try_s < float("inf")
        return not waits and self.status.state not in (*FINAL, LinkState.STREAMING, LinkState.TIMED_OUT)

    def _retry(self, now_s: float, state: LinkState, reason: str) -> bool:
        """Count a retry, and stop at the maximum."""
        attempts = self.status.attempts + 1
        self._next_try_s = float("inf")
        if attempts > self.limits.retries:
            self._enter(LinkState.GAVE_UP, now_s, f"{reason}; {self.limits.retries} retries")
            return False
        self._started_s = now_s
        since = self.status.since_s if state is self.status.state else now_s
        self.status = LinkStatus(state, since, reason, attempts)
        return True

    def _enter(self, state: LinkState, now_s: float, reason: str) -> None:
        same = state is self.status.state
        self.status = LinkStatus(state, self.status.since_s if same else now_s, reason, self.status.attempts)

    def _count_loss(self) -> None:
        self.losses += self.status.state is LinkState.STREAMING
