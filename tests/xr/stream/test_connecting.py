"""What keeps a viewer from a stream or a broker is said in words, with what to do about it."""

from __future__ import annotations

import itertools
import logging
import socket
import ssl
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread

import pytest
from certificates import self_signed
from streams import PAGE, twin, within

from femsense.core.errors import InputError
from femsense.xr.stream.access import Access
from femsense.xr.stream.bridge import Bridge
from femsense.xr.stream.connecting import NO_BROKER, NO_STREAM, NO_TLS, REFUSED
from femsense.xr.stream.hub import Hub
from femsense.xr.stream.mqtt import EmbeddedBroker
from femsense.xr.stream.publisher import Publisher
from femsense.xr.stream.websocket import WebSocketServer

pytest.importorskip("websockets")
pytest.importorskip("amqtt")

NEEDED, WRONG = "a password is needed: --password-file", "the password is wrong: --password-file"
UNTRUSTED = "the certificate is not trusted (self-signed certificate): --authority PEM"


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, object]]:
    """Servers and brokers, plain, with a password, and encrypted, and a port at which nobody listens."""
    certificate, key = self_signed(tmp_path_factory.mktemp("certificate"))
    hub = Hub()
    Publisher(hub, twin())
    ways = {
        "plain": Access(),
        "password": Access(password="secret"),
        "tls": Access(password="secret", certificate=certificate, key=key),
    }
    pages = {name: WebSocketServer(hub, PAGE, access=access).port for name, access in ways.items()}
    brokers = {f"{name}-broker": EmbeddedBroker(hub, port=0, access=access).port for name, access in ways.items()}
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        yield {**pages, **brokers, "nobody": nobody.getsockname()[1], "certificate": certificate}
    hub.close()


@pytest.mark.parametrize(
    ("scheme", "where", "password", "trusted", "why"),
    [
        ("http", "plain", None, False, ""),
        ("http", "password", None, False, NEEDED),
        ("http", "password", "guess", False, WRONG),
        ("http", "password", "secret", False, ""),
        ("http", "nobody", None, False, REFUSED),
        ("https", "plain", None, False, NO_TLS),
        ("http", "tls", "secret", False, NO_STREAM),
        ("https", "tls", "secret", False, UNTRUSTED),
        ("https", "tls", "guess", True, WRONG),
        ("https", "tls", "secret", True, ""),
        ("mqtt", "plain-broker", None, False, ""),
        ("mqtt", "password-broker", None, False, NEEDED),
        ("mqtt", "password-broker", "guess", False, WRONG),
        ("mqtt", "password-broker", "secret", False, ""),
        ("mqtt", "nobody", None, False, REFUSED),
        ("mqtts", "plain-broker", None, False, NO_TLS),
        ("mqtt", "tls-broker", "secret", False, NO_BROKER),
        ("mqtt", "plain", None, False, NO_BROKER),
        ("mqtts", "tls-broker", "secret", False, UNTRUSTED),
        ("mqtts", "tls-broker", "secret", True, ""),
    ],
)
def test_a_stream_that_cannot_be_reached_says_why(
    there: dict[str, object], scheme: str, where: str, password: str | None, trusted: bool, why: str
) -> None:
    authority = there["certificate"] if trusted else None
    assert authority is None or isinstance(authority, Path)
    bridge = Bridge(Hub(), f"{scheme}://127.0.0.1:{there[where]}", password=password, authority=authority)
    try:
        assert within(15.0, lambda: bridge.trouble.startswith(why) if why else not bridge.trouble), bridge.trouble
    finally:
        bridge.close()


def test_a_server_that_is_no_stream_is_told_from_one() -> None:
    """What HTTP says in numbers is said in words."""
    from femsense.xr.stream.connecting import why_not

    class Answer(Exception):
        def __init__(self, status: int) -> None:
            super().__init__(f"HTTP {status}")
            self.code = status

    assert why_not(Answer(404), tls=False, password=False).startswith("the server there is not a femsense stream (HTTP 404)")
    assert "its own names" in why_not(Answer(403), tls=False, password=False)
    assert why_not(Answer(503), tls=False, password=False) == "too many viewers"
    assert why_not(socket.gaierror(), tls=False, password=False) == "no machine of that name is known"


def test_a_certificate_without_its_key_asks_for_it(tmp_path: Path) -> None:
    certificate, _ = self_signed(tmp_path)
    with pytest.raises(InputError, match="--key"):
        Access(password="secret", certificate=certificate).tls()


@pytest.mark.parametrize("said", [b"", b"\x10", b"GET / HTTP/1.0\r\n\r\n", b"\x10\x10\x00\x04MQTT\x04\x02\x00\x3c\x00\x00"])
@pytest.mark.parametrize("where", ["tls", "tls-broker"])
def test_clients_that_break_off_raise_no_alarm(
    there: dict[str, object], where: str, said: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    context = ssl.create_default_context(cafile=str(there["certificate"]))
    for wrapped in (False, True):
        for _ in range(5):
            client = socket.create_connection(("127.0.0.1", int(str(there[where]))))
            if wrapped:
                client = context.wrap_socket(client, server_hostname="127.0.0.1")
            if said:
                client.sendall(said)
            time.sleep(0.02)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # it is reset, not closed
            client.close()
    time.sleep(0.3)
    assert alarms(caplog) == []


def test_a_server_that_hangs_up_raises_no_alarm(caplog: pytest.LogCaptureFixture) -> None:
    answers = itertools.cycle([b"", b"HTTP/1.1 101", b"HTTP/1.1 502 Bad Gateway\r\n\r\ngone", b"\x16\x03"])
    with socket.create_server(("127.0.0.1", 0)) as server:
        stop = Event()

        def hang_up() -> None:
            server.settimeout(0.1)
            while not stop.is_set():
                with suppress(TimeoutError):
                    client, _ = server.accept()
                    client.recv(4096)
                    client.sendall(next(answers))
                    client.close()

        thread = Thread(target=hang_up)
        thread.start()
        bridge = Bridge(Hub(), f"http://127.0.0.1:{server.getsockname()[1]}")
        time.sleep(2.5)
        assert bridge.trouble
        bridge.close()
        stop.set()
        thread.join()
    assert alarms(caplog) == []


def test_what_a_connection_to_elsewhere_says_goes_to_the_log_of_streams(
    there: dict[str, object], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    caplog.set_level(logging.DEBUG, "femsense.stream")
    bridge = Bridge(Hub(), f"http://127.0.0.1:{there['plain']}")
    assert within(5.0, lambda: bridge.trouble == "")
    bridge.close()
    assert not [record.name for record in caplog.records if record.name.startswith("websockets")]


def alarms(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What is printed where nobody asks for a log: not what goes to the stream's own, which is quiet."""
    return [f"{record.name}: {record.getMessage()}" for record in caplog.records if record.name != "femsense.stream"]
