"""A broker that closes the connection on packets above a limit: the mesh is left out, and poses arrive, the last one too."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
from streams import closing, within

from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import BrokerAddress, MqttSink
from femsense.xr.stream.packet_limit import PacketLimit

MESH, POSE = Message("femsense/arm/glb", bytes(50_000)), Message("femsense/arm/pose", bytes(48))
CONNECT, PUBLISH, SUBSCRIBE, PING = 1, 3, 8, 12


class SmallBroker:
    """Takes packets up to a limit; notes the sizes of what each connection published."""

    def __init__(self, limit: int) -> None:
        self.limit, self.taken = limit, list[list[int]]()
        self.listener = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def port(self) -> int:
        return int(self.listener.getsockname()[1])

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self.listener.accept()
                self.taken.append([])
                threading.Thread(target=self._serve, args=(client, self.taken[-1]), daemon=True).start()

    def _serve(self, client: socket.socket, taken: list[int]) -> None:
        with suppress(OSError, IndexError), client:
            stream = client.makefile("rb")
            while True:
                kind, size, shift = stream.read(1)[0] >> 4, 0, 0
                while True:
                    byte = stream.read(1)[0]
                    size, shift = size | (byte & 127) << shift, shift + 7
                    if not byte & 128:
                        break
                if kind == PUBLISH and size > self.limit:
                    return
                body = stream.read(size)
                answers = {CONNECT: b"\x20\x02\x00\x00", SUBSCRIBE: b"\x90" + bytes([2 + body.count(b"femsense/")]) + body[:2]}
                answers |= {SUBSCRIBE: answers[SUBSCRIBE] + bytes(body.count(b"femsense/")), PING: b"\xd0\x00"}
                client.sendall(answers.get(kind, b""))
                if kind == PUBLISH:
                    taken.append(size)


@contextmanager
def served(limit: int) -> Iterator[tuple[SmallBroker, Hub, MqttSink]]:
    broker, hub = SmallBroker(limit), Hub()
    hub.publish([MESH])
    sink = MqttSink(hub, BrokerAddress("127.0.0.1", broker.port), "arm")
    with closing(broker.listener, sink):
        yield broker, hub, sink


@pytest.mark.filterwarnings("ignore:the broker")
def test_poses_arrive_where_the_mesh_is_too_large() -> None:
    with served(20_000) as (broker, hub, _):

        def has_three_poses_more() -> bool:
            hub.publish([POSE])
            return bool(broker.taken) and len(broker.taken[-1]) > 3

        assert within(20.0, has_three_poses_more)
        assert len(broker.taken) == 3 and all(size < broker.limit for sizes in broker.taken for size in sizes)


def test_the_last_message_arrives_though_the_one_before_it_is_still_being_written() -> None:
    with served(100_000_000) as (broker, hub, sink):
        assert sink.connected.wait(10.0) and within(10.0, lambda: len(broker.taken[-1]) == 1)
        hub.publish([Message(POSE.topic, bytes(50_000_000))])
        hub.publish([POSE])
        assert within(20.0, lambda: len(broker.taken[-1]) == 3 and broker.taken[-1][-1] < 100)


def test_two_ends_after_the_mesh_name_its_size_and_leave_it_out() -> None:
    limit = PacketLimit("here:1883")
    assert limit.fitting((MESH, POSE)) == (MESH, POSE)
    limit.ended()
    assert limit.fitting((MESH, POSE)) == (MESH, POSE)
    with pytest.warns(UserWarning, match=r"here:1883 closes the connection after a packet of 50000 bytes.*max_packet_size"):
        limit.ended()
    assert limit.fitting((MESH, POSE)) == (POSE,)
