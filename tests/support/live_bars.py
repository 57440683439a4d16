"""Two bars that stream to a page."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np

from femsense.xr.landmarks import Landmark, Landmarks
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import Handle, TwinFrame
from femsense.xr.stream.publisher import Publisher
from femsense.xr.stream.run_source import RunStream, frames_of
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer
from femsense.xr.view import live_page_files


class Source:
    """Two bars that stream from a thread until they are paused."""

    def __init__(self, run: RunStream, page: Path, *, still: bool = False, commands: bool = False) -> None:
        self.hub, self.run, self.flowing, self.stop = Hub(), run, Event(), Event()
        self.last: TwinFrame | None = next(frames_of(run)) if still else None
        handle = Handle("top", np.array([0.0, 0.0, 0.2]))
        marks = (Landmark("top", handle.position_m), Landmark("side", np.array([0.015, 0.0, 0.1])))
        known = Landmarks(marks, (Landmark("the camera", np.array([0.3, -0.4, 0.2])),))
        twins = [
            replace(run.twin, name="bar", handles=(handle,), landmarks=known, commands=commands),
            replace(run.twin, name="bar-2"),
        ]
        self.publishers = [Publisher(self.hub, twin) for twin in twins]
        self.wishes: list[dict[str, Any]] = []
        self.hub.listen(self.heard)
        self.server = WebSocketServer(self.hub, live_page_files(page), options=ServerOptions(port=0))
        self.flowing.set()
        Thread(target=self.flow, daemon=True).start()

    def flow(self) -> None:
        begun = time.monotonic()
        for frame in frames_of(self.run, rate_hz=30.0):
            while not self.flowing.wait(0.1) and not self.stop.is_set():
                pass
            if self.stop.wait(max(0.0, begun + frame.time_s - time.monotonic())):
                return
            shown = frame if self.last is None else replace(self.last, time_s=frame.time_s)
            for publisher in self.publishers:
                publisher.publish(shown)

    def heard(self, message: Message, _who: str) -> None:
        self.wishes.append(json.loads(message.payload))
        reach = {"status": "reached", "text": "reached to 0.01 mm", "error_m": 1e-5, "inputs": []}
        self.hub.publish([Message("femsense/bar/reach", json.dumps(reach).encode())])

    def close(self) -> None:
        self.stop.set()
        self.hub.close()
