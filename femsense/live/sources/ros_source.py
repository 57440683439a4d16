"""A source of ROS 2 messages: a thread reads them and keeps the newest frame."""

from __future__ import annotations

import queue
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from threading import Event, Thread
from typing import Any

from femsense.live.frames import RawFrame
from femsense.live.sources.ros_topics import TopicFrames, topics_of
from femsense.live.sources.source import FoundCamera, Loss, Opening, SourceInfo, SourceLost

FIRST_FRAME_S = 10.0
"""Time limit for the first image and its CameraInfo [s]."""
Message = tuple[str, str, Any]
"""Topic, type and the decoded message."""


class RosSource(ABC):
    """Base of the sources of ROS 2 messages; subclasses read them in `messages`."""

    kind = "messages"

    def __init__(self, text: str) -> None:
        self.address, self._frames = topics_of(text)
        self._waiting: queue.Queue[RawFrame] = queue.Queue(1)
        self._stop = Event()
        self._lost: SourceLost | None = None
        self._thread: Thread | None = None

    @abstractmethod
    def messages(self, stop: Event, frames: TopicFrames) -> Iterator[Message]:
        """Yield messages of the topics requested by `frames` until `stop` is set. Raises SourceLost, OSError."""

    def open(self, opening: Opening) -> SourceInfo:
        """Start reading, and wait for the first frame, which defines the camera."""
        self._stop, self._lost = Event(), None
        self._thread = Thread(target=self._read, args=(self._stop,), daemon=True, name="femsense-ros")
        self._thread.start()
        end = time.monotonic() + FIRST_FRAME_S
        while self._waiting.empty():
            if self._lost is not None:
                raise self._lost
            if time.monotonic() > end:
                text = f"no depth image with its CameraInfo, and no cloud, within {FIRST_FRAME_S:g} s at {self.address}"
                raise SourceLost(Loss.REFUSED, text)
            time.sleep(0.01)
        camera = None if self._frames.is_cloud else self._frames.camera
        return SourceInfo(f"{self._frames.depth} of {self.address}", (camera,), float("nan"))

    def newest(self, timeout_s: float) -> RawFrame | None:
        """Return the newest frame."""
        with suppress(queue.Empty):
            return self._waiting.get(timeout=timeout_s)
        if self._lost is not None:
            raise self._lost
        return None

    def close(self) -> None:
        """Stop reading; a blocked read ends with the process."""
        self._stop.set()

    def list_devices(self) -> list[FoundCamera]:
        """Return none: topics are not devices."""
        return []

    def _read(self, stop: Event) -> None:
        try:
            for topic, kind, message in self.messages(stop, self._frames):
                frame = self._frames.take(topic, kind, message)
                if frame is not None:
                    with suppress(queue.Empty):
                        self._waiting.get_nowait()
                    with suppress(queue.Full):
                        self._waiting.put_nowait(frame)
            self._lost = SourceLost(Loss.ENDED, f"{self.address} has ended")
        except SourceLost as lost:
            self._lost = lost
        except Exception as error:  # decoders raise various errors on a malformed message
            self._lost = SourceLost(Loss.UNPLUGGED, f"{self.address}: {type(error).__name__}: {error}")
