"""From frames of a twin to messages, at a limited rate."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import isnan
from threading import Event, Lock

from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import (
    Kind,
    Twin,
    TwinFrame,
    cloud_bytes,
    field_bytes,
    force_bytes,
    inputs_bytes,
    model_bytes,
    pose_bytes,
    pose_json_bytes,
    status_bytes,
    topic,
)

FIRST_POSE = "the first pose"
STALE_S = 0.4
"""Time without a pose after which a robot is stale [s]."""
EARLY = 0.2
"""A frame may come early by this share of the shortest interval: clocks of sources jitter, and 60 Hz should not become 30."""


@dataclass(frozen=True, slots=True)
class PublishOptions:
    """Content and maximum rates of the messages."""

    rate_hz: float = 60.0
    """Of poses and forces."""
    cloud_rate_hz: float = 10.0
    """Of clouds and fields: they are large."""
    json_mirror: bool = False
    """Also `pose_json`, for clients that read only text."""
    waits_for: str = FIRST_POSE
    """What the stream waits for before the first pose, in words."""


class RateLimit:
    """Limits a message rate; messages that are too early are dropped, since newer ones follow."""

    def __init__(self, rate_hz: float) -> None:
        self._interval = 1.0 / rate_hz
        self._next = float("-inf")

    def wait_s(self, now: float) -> float:
        """Return how long after this time [s] the next message may go out [s]."""
        return max(0.0, self._next - EARLY * self._interval - now)

    def allows(self, now: float) -> bool:
        """Return whether a message at this time [s] may go out."""
        if self.wait_s(now) > 0.0:
            return False
        self._next = max(self._next, now - EARLY * self._interval) + self._interval
        return True


class Publisher:
    """Sends one twin's frames into a hub."""

    def __init__(self, hub: Hub, twin: Twin, options: PublishOptions | None = None) -> None:
        """Announce the twin: its mesh, its description, and what the stream waits for."""
        self.hub, self.twin = hub, twin
        self.options = options or PublishOptions()
        self.sent = 0
        """How many poses went out."""
        self._has_cloud = False
        self._lock = Lock()
        self._seq = 0
        self._came = self._shown = float("-inf")  # times of the data of the last received frame, and of the last sent one
        self._since = float("nan")
        self._blind = ""  # why the frame before had no pose
        self._said = ("waiting", self.options.waits_for)
        self._pose_limit = RateLimit(self.options.rate_hz)
        self._cloud_limit, self._field_limit = RateLimit(self.options.cloud_rate_hz), RateLimit(self.options.cloud_rate_hz)
        self.announce(twin)

    def announce(self, twin: Twin) -> None:
        """Send the description; also later, when it has changed."""
        self.twin = twin
        glb = topic(twin.name, Kind.GLB)
        model = Message(topic(twin.name, Kind.MODEL), model_bytes(twin, f"robots/{glb.split('/')[1]}.glb"))
        with self._lock:
            self.hub.publish([Message(glb, twin.glb), model, self._status(*self._said)])

    def publish(self, frame: TwinFrame, *, now: float | None = None) -> bool:
        """Send a frame unless the rate limit forbids it; return whether it was sent.

        A frame with data no newer than the previous one is sent without a pose, with its other content.
        """
        moment = time.monotonic() if now is None else now
        with self._lock:
            read_at = moment if isnan(frame.read_at) else frame.read_at
            self._came = max(self._came, read_at)
            if not self._pose_limit.allows(moment):
                return False
            is_new = read_at > self._shown
            self._blind = "" if is_new else frame.status
            if is_new:
                self._shown, self._since = read_at, time.time() - (moment - read_at)
                self.sent += 1
            self.hub.publish([*self._judged(moment), *self._messages(frame, moment, is_new=is_new)])
            self._seq += 1
        return True

    def wait_s(self) -> float:
        """Return the time until the next frame may be sent [s]: a caller that then takes the newest data sends nothing outdated."""
        return self._pose_limit.wait_s(time.monotonic())

    def watch(self, *, now: float | None = None) -> None:
        """Report the stream as stale if there were no data for `STALE_S`; the next pose reports it as live."""
        moment = time.monotonic() if now is None else now
        with self._lock:
            if told := self._judged(moment):
                self.hub.publish(told)

    @property
    def trouble(self) -> str:
        """Reason why the readings of the sensors give no pose; empty if they do, or if there are no readings."""
        with self._lock:
            return self._blind if self._said[0] in ("waiting", "stale") else ""

    def _judged(self, moment: float) -> list[Message]:
        """Return the status at a time of our clock [s] if it has changed."""
        if self._shown == float("-inf"):
            told = ("waiting", self._blind or self.options.waits_for)
        else:
            told = ("stale", self._blind) if moment - self._came > STALE_S else ("live", "")
        return [] if self._said[0] == "ended" or told == self._said else [self._status(*told)]

    def end(self, detail: str = "") -> None:
        """Announce the end of the stream."""
        with self._lock:
            self.hub.publish([self._status("ended", detail)])

    def _status(self, state: str, detail: str = "") -> Message:
        self._said = (state, detail)
        since = self._since if state == "stale" else float("nan")
        return Message(topic(self.twin.name, Kind.STATUS), status_bytes(state, detail, since))

    def _messages(self, frame: TwinFrame, moment: float, *, is_new: bool) -> list[Message]:
        """Return the messages of a frame at a time of our clock [s]; its pose only if it is new."""
        seq, name, t = self._seq, self.twin.name, frame.time_s
        messages = [Message(topic(name, Kind.POSE), pose_bytes(seq, t, frame.bones))] if is_new else []
        messages.append(Message(topic(name, Kind.FORCE), force_bytes(seq, frame, self.twin.frame)))
        if frame.inputs:
            messages.append(
                Message(topic(name, Kind.INPUTS), inputs_bytes(seq, t, self.twin.inputs, frame.inputs, self.twin.frame))
            )
        if self.options.json_mirror and is_new:
            messages.append(Message(topic(name, Kind.POSE_JSON), pose_json_bytes(seq, t, frame.bones)))
        if self._has_cloud and frame.cloud is None:
            messages.append(Message(topic(name, Kind.CLOUD), cloud_bytes(seq, t, [])))  # clears the previous cloud
            self._has_cloud = False
        elif frame.cloud is not None and self._cloud_limit.allows(moment):
            messages.append(Message(topic(name, Kind.CLOUD), cloud_bytes(seq, t, frame.cloud)))
            self._has_cloud = True
        if self.twin.field is not None and frame.field is not None and self._field_limit.allows(moment):
            messages.append(Message(topic(name, Kind.FIELD), field_bytes(seq, t, self.twin.field.largest, frame.field)))
        return messages


def play(
    publisher: Publisher,
    frames: Iterable[TwinFrame],
    stop: Event,
    *,
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Send frames at their own times, the first at once, until they end or `stop` is set.

    Arguments:
        publisher: publisher of the twin to which the frames belong.
        frames: in order of time.
        stop: ends it.
        clock: [s].
    """
    begun: float | None = None
    for frame in frames:
        begun = clock() - frame.time_s if begun is None else begun
        if stop.wait(max(0.0, begun + frame.time_s - clock())):
            return
        publisher.publish(frame)
