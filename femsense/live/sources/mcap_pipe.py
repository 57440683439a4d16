"""ROS 2 topics from a named pipe with MCAP data, written on a machine with ROS; none is needed here."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path
from threading import Event

from femsense.core.errors import InputError, MissingDependency
from femsense.live.sources.ros_source import Message, RosSource
from femsense.live.sources.ros_topics import DECODER, TopicFrames
from femsense.live.sources.source import Loss, SourceLost


class McapPipe(RosSource):
    """`PIPE[?depth=TOPIC&color=TOPIC]`."""

    def messages(self, stop: Event, frames: TopicFrames) -> Iterator[Message]:
        """Yield messages in the order of arrival."""
        try:
            from mcap.reader import NonSeekingReader
            from mcap_ros2.decoder import DecoderFactory
        except ImportError:
            raise MissingDependency(DECODER) from None
        path = Path(self.address).expanduser()
        if not path.exists():
            raise SourceLost(Loss.UNPLUGGED, f"there is no pipe {path}: mkfifo makes one")
        if not stat.S_ISFIFO(path.stat().st_mode):
            raise InputError(
                "a file is not a pipe",
                where=path,
                found="a regular file",
                expected="a named pipe (mkfifo) that a program writes MCAP to",
                hint=f"femsense import {path} -o RECORDING, then --camera RECORDING",
            )
        with path.open("rb") as stream:
            reader = NonSeekingReader(stream, decoder_factories=[DecoderFactory()])
            for found in reader.iter_decoded_messages(log_time_order=False):
                if stop.is_set():
                    return
                name = "" if found.schema is None else found.schema.name
                if frames.is_wanted(found.channel.topic, name):
                    yield found.channel.topic, name, found.decoded_message
