"""ROS 2 topics from a Foxglove bridge that runs next to ROS: a WebSocket with messages and their schemas."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from threading import Event
from typing import Any

from femsense.core.errors import MissingDependency
from femsense.live.sources.ros_source import Message, RosSource
from femsense.live.sources.ros_topics import DECODER, TopicFrames
from femsense.live.sources.source import Loss, SourceLost

PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
DATA = struct.Struct("<BIQ")
"""Header of a message: operation, subscription and time [ns]."""
MESSAGE = 1
LARGEST = 1 << 27
POLL_S = 0.2


class Foxglove(RosSource):
    """`ws://HOST:8765[?depth=TOPIC&color=TOPIC]`."""

    def messages(self, stop: Event, frames: TopicFrames) -> Iterator[Message]:
        """Subscribe to the required topics, and yield their messages."""
        try:
            from mcap.records import Schema
            from mcap_ros2.decoder import DecoderFactory
            from websockets.exceptions import ConnectionClosed, WebSocketException
            from websockets.sync.client import connect
            from websockets.typing import Subprotocol
        except ImportError:
            raise MissingDependency(DECODER) from None
        factory = DecoderFactory()
        known: dict[int, tuple[str, str, Callable[[bytes], Any]]] = {}
        try:
            with connect(self.address, subprotocols=[Subprotocol(one) for one in PROTOCOLS], max_size=LARGEST) as socket:
                while not stop.is_set():
                    try:
                        data = socket.recv(timeout=POLL_S)
                    except TimeoutError:
                        continue
                    if isinstance(data, str):
                        for channel in json.loads(data).get("channels", ()):
                            topic, kind, number = channel["topic"], channel["schemaName"], channel["id"]
                            if frames.is_wanted(topic, kind) and channel["encoding"] == "cdr":
                                schema = Schema(data=channel["schema"].encode(), encoding="ros2msg", id=number, name=kind)
                                decode = factory.decoder_for("cdr", schema)
                                if decode is not None:
                                    known[number] = topic, kind, decode
                                    wanted = [{"id": number, "channelId": number}]
                                    socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                    elif data[:1] == bytes([MESSAGE]):
                        _, number, _ = DATA.unpack_from(data)
                        topic, kind, decode = known[number]
                        yield topic, kind, decode(data[DATA.size :])
        except ConnectionClosed:
            raise SourceLost(Loss.UNPLUGGED, f"the bridge at {self.address} closed the connection") from None
        except (OSError, WebSocketException) as error:
            raise SourceLost(Loss.UNPLUGGED, f"no Foxglove bridge at {self.address}: {error}") from None
