"""A broker that closes the connection on packets above a limit: the mesh is left out, and poses arrive."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import BrokerAddress, MqttSink
from femsense.xr.stream.packet_limit import PacketLimit

MESH, POSE = Message("femsense/arm/glb", bytes(50_000)), Message("femsense/arm/pose", bytes(48))
CONNECT, PUBLISH, SUBSCRIBE, PING = 1, 3, 8, 12


class SmallBroker:
    """Takes packets below a limit; notes the sizes of what was published, and how often it was called."""

    def __init__(self, limit: int) -> None:
        self.limit, self.taken, self.calls = limit, list[int](), 0
        self.pose = threading.Event()
        self.listener = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def port(self) -> int:
        return int(self.listener.getsockname()[1])

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self.listener.accept()
                self.calls += 1
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
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
                    self.taken.append(size)
                    self.pose.set() if b"/pose" in body[:40] else None


@pytest.fixture
def broker() -> Iterator[SmallBroker]:
    made = SmallBroker(20_000)
    yield made
    made.listener.close()


@pytest.mark.filterwarnings("ignore:the broker")
def test_poses_arrive_where_the_mesh_is_too_large(broker: SmallBroker) -> None:
    hub = Hub()
    hub.publish([MESH])
    sink = MqttSink(hub, BrokerAddress("127.0.0.1", broker.port), "arm")
    for _ in range(200):
        hub.publish([POSE])
        if broker.pose.wait(0.05):
            break
    calls = broker.calls
    broker.pose.clear()
    hub.publish([POSE])
    again = broker.pose.wait(5.0)
    sink.close()
    assert again and broker.calls == calls and max(broker.taken) < broker.limit


def test_two_ends_after_the_mesh_name_its_size_and_leave_it_out() -> None:
    limit = PacketLimit("here:1883")
    assert limit.fitting((MESH, POSE)) == (MESH, POSE)
    limit.ended()
    assert limit.fitting((MESH, POSE)) == (MESH, POSE)
    with pytest.warns(UserWarning, match=r"here:1883 closes the connection after a packet of 50000 bytes.*max_packet_size"):
        limit.ended()
    assert limit.fitting((MESH, POSE)) == (POSE,)
