"""Brokers: embedded and mosquitto; retained models, the last will, brokers that die and come back, bridges."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from certificates import self_signed
from streams import GLB, PAGE, closing, moment, twin, within, x_of

from femsense.core.errors import InputError
from femsense.xr.stream.access import Access
from femsense.xr.stream.bridge import Bridge
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import (
    BrokerAddress,
    EmbeddedBroker,
    MqttSink,
    MqttSource,
    broker_address,
    lets_anybody_in,
    make_client,
)
from femsense.xr.stream.publisher import Publisher, PublishOptions
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer

pytest.importorskip("paho.mqtt.client")
pytest.importorskip("amqtt")
MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="no mosquitto on this machine")


class Heard:
    """What an MQTT client hears."""

    def __init__(self, port: int, address: BrokerAddress | None = None, topics: tuple[str, ...] = ("femsense/#",)) -> None:
        self.messages: dict[str, bytes] = {}
        self.kinds: list[str] = []
        """Of all messages, in the order in which they came."""
        self.source = MqttSource(address or BrokerAddress("127.0.0.1", port), self.take, topics=topics)

    def take(self, message: Message) -> None:
        self.kinds.append(message.topic.rpartition("/")[2])
        self.messages[self.kinds[-1]] = message.payload

    def state(self) -> str:
        return str(json.loads(self.messages.get("status", b"{}")).get("state"))

    def close(self) -> None:
        self.source.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def mosquitto(folder: Path, port: int) -> Iterator[subprocess.Popen[bytes]]:
    settings = folder / "mosquitto.conf"
    settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\n", encoding="utf-8")
    with subprocess.Popen([str(MOSQUITTO), "-c", str(settings)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        assert within(5.0, lambda: answers(port))
        yield process
        process.terminate()


def answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 0.2).close()
    except OSError:
        return False
    return True


def test_the_embedded_broker_has_the_model_for_who_comes_late_and_the_pose_for_all() -> None:
    hub = Hub()
    publisher = Publisher(hub, twin(), PublishOptions(json_mirror=True))
    broker = EmbeddedBroker(hub, port=0)
    heard = Heard(broker.port)
    with closing(heard, hub):
        assert within(5.0, lambda: {"glb", "model", "status"} <= heard.messages.keys())
        assert heard.messages["glb"] == GLB and heard.state() == "waiting"
        publisher.publish(moment(0.0, x=0.5))
        assert within(5.0, lambda: {"pose", "force", "inputs", "pose_json"} <= heard.messages.keys())
        assert x_of(heard.messages["pose"]) == 0.5
        publisher.end()
        assert within(5.0, lambda: heard.state() == "ended")


def test_the_embedded_broker_gives_what_is_kept_once_to_each_of_several_and_only_what_it_asked_for() -> None:
    hub = Hub()
    publisher = Publisher(hub, twin())
    broker = EmbeddedBroker(hub, port=0)
    first = Heard(broker.port)
    with closing(first, hub):
        assert within(5.0, lambda: "status" in first.kinds)
        second, states = Heard(broker.port), Heard(broker.port, topics=("femsense/+/status",))
        with closing(second, states):
            assert within(5.0, lambda: "status" in second.kinds and "status" in states.kinds)
            publisher.end()  # what comes after all that is kept
            assert within(5.0, lambda: all(one.state() == "ended" for one in (first, second, states)))
            for one in (first, second):
                assert sorted(one.kinds) == ["glb", "model", "status", "status"]
            assert states.kinds == ["status", "status"]
        assert broker.clients == 3


def test_a_client_of_the_embedded_broker_that_does_not_read_holds_up_nobody_and_then_gets_the_newest() -> None:
    hub, seen = Hub(), []
    broker = EmbeddedBroker(hub, port=0)
    reads, sleeps = Heard(broker.port), make_client(BrokerAddress("127.0.0.1", broker.port))
    sleeps.on_message = lambda _client, _data, got: seen.append(got.payload[0])
    sleeps.on_subscribe = lambda *_: seen.append(0)
    with closing(reads, hub):
        assert within(5.0, reads.source.connected.is_set)
        sleeps.connect("127.0.0.1", broker.port)
        sleeps.subscribe("femsense/arm/cloud")
        assert within(5.0, lambda: sleeps.loop(0.1) == 0 and bool(seen))  # and then it does not read
        for k in range(1, 151):
            hub.publish([Message("femsense/arm/cloud", bytes([k]) * 200_000)])
            assert within(5.0, lambda k=k: reads.messages.get("cloud", b"-")[0] == k)
        assert within(10.0, lambda: sleeps.loop(0.1) == 0 and seen[-1] == 150)
        sleeps.disconnect()
    assert seen == sorted(seen) and len(seen) < 140


def test_a_taken_port_is_said() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="broker cannot be served"):
            EmbeddedBroker(Hub(), port=taken.getsockname()[1])


@needs_mosquitto
def test_a_broker_that_dies_and_comes_back_gets_all_again(tmp_path: Path) -> None:
    hub, port = Hub(), free_port()
    publisher = Publisher(hub, twin())
    sink = MqttSink(hub, BrokerAddress("127.0.0.1", port), "arm")  # there is no broker yet
    with closing(hub):
        with mosquitto(tmp_path, port):
            assert sink.connected.wait(10.0)
        assert within(5.0, lambda: not sink.connected.is_set())
        publisher.publish(moment(0.0))  # nobody hears it, nothing breaks
        with mosquitto(tmp_path, port):
            heard = Heard(port)
            with closing(heard):
                assert within(10.0, lambda: heard.state() == "live" and heard.messages.get("glb") == GLB)
                time.sleep(0.02)
                publisher.publish(moment(1.0, x=0.75))
                assert within(5.0, lambda: x_of(heard.messages.get("pose", bytes(80))) == 0.75)


@needs_mosquitto
def test_a_program_that_is_killed_is_announced_as_lost(tmp_path: Path) -> None:
    port = free_port()
    code = (
        "import sys, time; from streams import twin; from femsense.xr.stream.hub import Hub\n"
        "from femsense.xr.stream.mqtt import BrokerAddress, MqttSink; from femsense.xr.stream.publisher import Publisher\n"
        f"hub = Hub(); Publisher(hub, twin()); MqttSink(hub, BrokerAddress('127.0.0.1', {port}), 'arm'); time.sleep(60)"
    )
    with mosquitto(tmp_path, port):
        heard = Heard(port)
        paths = f"import sys; sys.path[:0] = {sys.path!r}\n"
        with subprocess.Popen([sys.executable, "-c", paths + code]) as program, closing(heard):
            assert within(20.0, lambda: heard.state() == "waiting")
            program.send_signal(signal.SIGKILL)
            assert within(10.0, lambda: heard.state() == "lost")


def test_a_broker_with_a_password_and_a_certificate_serves_who_has_both(tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path)
    hub, got = Hub(), []
    hub.listen(lambda message, _: got.append(message))
    Publisher(hub, twin())
    broker = EmbeddedBroker(hub, port=0, access=Access(password="secret", certificate=certificate, key=key))
    url = f"mqtts://me:secret@127.0.0.1:{broker.port}"
    heard = {
        name: Heard(broker.port, broker_address(text, authority=authority))
        for name, text, authority in (
            ("both", url, certificate),
            ("no certificate", url, None),
            ("no encryption", url.replace("mqtts", "mqtt"), None),
            ("wrong password", url.replace("secret", "guess"), certificate),
            ("no password", url.replace("me:secret@", ""), certificate),
        )
    }
    with closing(*heard.values(), hub):
        assert within(10.0, lambda: heard["both"].messages.get("glb") == GLB)
        heard["both"].source.send(Message("femsense/arm/measured", b"{}"))
        assert within(5.0, lambda: [m.topic for m in got] == ["femsense/arm/measured"])
        assert within(1.0, lambda: False) is False
        assert [name for name, one in heard.items() if one.messages] == ["both"]
    with pytest.raises(InputError, match="not a certificate"):
        EmbeddedBroker(hub, port=0, access=Access(certificate=key))


def test_wishes_and_measurements_come_in_by_a_broker() -> None:
    hub, got = Hub(), []
    hub.listen(lambda message, _: got.append(message.topic))
    broker = EmbeddedBroker(hub, port=0)
    other = Hub()
    sink = MqttSink(other, BrokerAddress("127.0.0.1", broker.port), "arm")
    others: list[str] = []
    other.listen(lambda message, _: others.append(message.topic))
    client = Heard(broker.port)
    with closing(client, sink, hub):
        assert sink.connected.wait(5.0) and within(5.0, lambda: client.source.connected.is_set())
        for kind in ("drag", "pose", "measured"):
            client.source.send(Message(f"femsense/arm/{kind}", b"{}"))
        wanted = ["femsense/arm/drag", "femsense/arm/measured"]
        assert within(5.0, lambda: got == wanted) and within(5.0, lambda: others == wanted)


def test_a_bridge_brings_a_broker_to_the_page() -> None:
    there, here = Hub(), Hub()
    broker = EmbeddedBroker(there, port=0)
    publisher = Publisher(there, twin())
    bridge = Bridge(here, f"mqtt://127.0.0.1:{broker.port}")
    with closing(bridge, there):
        assert within(5.0, lambda: "femsense/arm/glb" in here.newest() and "femsense/arm/model" in here.newest())
        publisher.publish(moment(0.0, x=0.5))
        assert within(5.0, lambda: "femsense/arm/pose" in here.newest())
        broker.close()
        status = {"state": "lost", "detail": f"127.0.0.1:{broker.port}"}
        assert within(5.0, lambda: json.loads(here.newest()["femsense/arm/status"].payload) == status)
        EmbeddedBroker(there, port=broker.port)
        assert within(10.0, lambda: b"live" in here.newest()["femsense/arm/status"].payload)


def test_a_bridge_brings_another_page_s_stream_comes_back_and_takes_wishes_along() -> None:
    there, here, wishes = Hub(), Hub(), []
    publisher = Publisher(there, twin())
    there.listen(lambda message, _: wishes.append(message.payload))
    server = WebSocketServer(there, PAGE)
    bridge = Bridge(here, server.url)
    with closing(bridge, there):
        assert within(5.0, lambda: "femsense/arm/model" in here.newest())
        assert here.newest()["femsense/arm/glb"].payload == GLB
        here.received(Message("femsense/arm/drag", b"{}"), "me")
        assert within(5.0, lambda: wishes == [b"{}"])
        server.close()
        assert within(5.0, lambda: b"lost" in here.newest()["femsense/arm/status"].payload)
        again = WebSocketServer(there, PAGE, options=ServerOptions(port=server.port))
        with closing(again):
            assert within(5.0, lambda: b"waiting" in here.newest()["femsense/arm/status"].payload)
            publisher.publish(moment(1.0, x=0.5))
            assert within(5.0, lambda: "femsense/arm/pose" in here.newest())
            assert x_of(here.newest()["femsense/arm/pose"].payload) == 0.5


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("box", ("box", 1883, None, False)),
        ("box:1999", ("box", 1999, None, False)),
        ("mqtts://me:pa%20ss@box", ("box", 8883, "me", True)),
    ],
)
def test_addresses_of_brokers(text: str, wanted: tuple[object, ...]) -> None:
    address = broker_address(text)
    assert (address.host, address.port, address.user, address.tls) == wanted
    assert address.password == ("pa ss" if address.user else None) and "pa ss" not in repr(address)


@pytest.mark.parametrize("text", ["", "box:port", "http://box", "box:99999"])
def test_what_is_no_broker_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="not a broker"):
        broker_address(text)
    with pytest.raises(InputError, match="not a stream"):
        Bridge(Hub(), "ftp://x")


@pytest.mark.parametrize(("password", "anybody"), [(None, True), ("secret", False)])
def test_a_broker_that_lets_anybody_in_is_known_by_asking(password: str | None, anybody: bool) -> None:
    hub = Hub()
    with closing(hub):
        broker = EmbeddedBroker(hub, port=0, access=Access(password=password))
        known = broker_address(f"127.0.0.1:{broker.port}", password="secret")
        assert lets_anybody_in(known) is anybody
    assert lets_anybody_in(broker_address("127.0.0.1:1", password="secret"), timeout_s=0.2) is None
    assert lets_anybody_in(broker_address("127.0.0.1:1")) is True  # nothing is asked of it
