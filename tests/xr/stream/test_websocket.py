"""The page's server: newest to every viewer, nobody held up, nothing given away, garbage survived."""

from __future__ import annotations

import base64
import http.client
import json
import socket
import ssl
import struct
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from certificates import self_signed
from streams import GLB, PAGE, moment, read_frame, twin, within, x_of

from femsense.core.errors import InputError
from femsense.xr.stream.access import Access
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.publisher import Publisher
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer, pack

websockets = pytest.importorskip("websockets")
from websockets.sync.client import connect  # noqa: E402

POSE = "femsense/arm/pose"


@contextmanager
def served(access: Access | None = None, **options: Any) -> Iterator[tuple[Hub, Publisher, WebSocketServer]]:
    hub = Hub()
    publisher = Publisher(hub, twin())
    with closing(WebSocketServer(hub, PAGE, access=access, options=ServerOptions(**options))) as server:
        yield hub, publisher, server


def watch(server: WebSocketServer, **more: Any) -> Any:
    scheme = "wss" if "ssl" in more else "ws"
    return connect(f"{scheme}://127.0.0.1:{server.port}/ws", proxy=None, compression=None, **more)


def get(server: WebSocketServer, path: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    link = http.client.HTTPConnection("127.0.0.1", server.port, timeout=5)
    link.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        link.putheader(name, value)
    link.endheaders()
    answer = link.getresponse()
    return answer.status, answer.read(), dict(answer.getheaders())


def basic(password: str) -> str:
    return "Basic " + base64.b64encode(f"any:{password}".encode()).decode()


def test_a_late_viewer_has_the_model_at_once_and_then_what_comes() -> None:
    with served() as (_, publisher, server):
        publisher.publish(moment(0.0, x=0.25))
        with watch(server) as viewer:
            first = read_frame(viewer.recv(5))
            assert json.loads(first["femsense/arm/model"])["glb"] == "robots/arm.glb"
            assert x_of(first[POSE]) == 0.25 and "femsense/arm/glb" not in first
            time.sleep(0.05)
            publisher.publish(moment(0.1, x=0.5))
            assert x_of(read_frame(viewer.recv(5))[POSE]) == 0.5


def test_only_the_page_and_the_meshes_are_served() -> None:
    with served() as (_, _publisher, server):
        assert get(server, "/")[:2] == (200, PAGE["index.html"])
        status, glb, headers = get(server, "/robots/arm.glb?x=1")
        assert (status, glb, headers["Content-Type"]) == (200, GLB, "model/gltf-binary")
        for path in (
            "/robots/other.glb",
            "/../pyproject.toml",
            "/robots/../../etc/passwd",
            "/%2e%2e/x",
            "//etc/passwd",
            "/robots/",
        ):
            assert get(server, path)[0] == 404, path


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://127.0.0.1:{port}"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "evil.example"}, 403),
    ],
)
def test_pages_of_other_hosts_reach_nothing(headers: dict[str, str], status: int) -> None:
    with served() as (_, _publisher, server):
        filled = {name: value.format(port=server.port) for name, value in headers.items()}
        assert get(server, "/", **filled)[0] == status


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200),
        ("localhost:{port}", 200),
        (f"{socket.gethostname().upper()}.", 200),
        ("tunnel.example:443", 200),
        ("evil.example", 403),
        ("10.9.8.7", 403),
        ("", 403),
    ],
)
def test_with_a_password_too_a_foreign_host_is_refused_before_it_is_asked_for(host: str, status: int) -> None:
    with served(Access("0.0.0.0", "secret", names=("tunnel.example",))) as (_, _publisher, server):
        asked = {"Host": host.format(port=server.port)}
        assert get(server, "/", **asked, Authorization=basic("secret"))[0] == status
        assert get(server, "/", **asked)[0] == (401 if status == 200 else 403)


def test_other_machines_only_with_a_password() -> None:
    with pytest.raises(InputError, match="only with a password"):
        Access("0.0.0.0")
    with served(Access("0.0.0.0", "secret")) as (_, _publisher, server):
        assert get(server, "/")[0] == 401 and get(server, "/robots/arm.glb")[0] == 401
        assert get(server, "/", Authorization=basic("Secret"))[0] == 401
        status, _, headers = get(server, "/", Authorization=basic("secret"))
        assert status == 200 and "HttpOnly" in headers["Set-Cookie"]
        with pytest.raises(websockets.InvalidStatus):
            watch(server)
        with watch(server, additional_headers={"Authorization": basic("secret")}) as viewer:
            assert viewer.recv(5)
        with watch(server, additional_headers={"Cookie": headers["Set-Cookie"].partition(";")[0]}) as viewer:
            assert viewer.recv(5)
        assert get(server, "/", Cookie="femsense=guess")[0] == 401


def test_traffic_is_encrypted_where_there_is_a_certificate(tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path)
    with served(Access(certificate=certificate, key=key)) as (_, _publisher, server):
        assert server.url.startswith("https://")
        trusting = ssl.create_default_context(cafile=certificate)
        trusting.check_hostname = False
        with watch(server, ssl=trusting) as viewer:
            assert viewer.recv(5)
    with pytest.raises(InputError, match="not a certificate"):
        served(Access(certificate=key)).__enter__()


def test_a_viewer_that_does_not_read_holds_up_nobody_and_then_gets_the_newest() -> None:
    big = b"x" * 200_000
    with served() as (hub, _publisher, server):
        slow = socket.create_connection(("127.0.0.1", server.port))
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        slow.sendall(upgrade(server.port))
        assert slow.recv(20).startswith(b"HTTP/1.1 101")
        with watch(server, max_size=None) as viewer:
            viewer.recv(5)
            begun, taken = time.monotonic(), 0
            for k in range(40):
                hub.publish([Message("femsense/arm/cloud", struct.pack("<I", k) + big)])
                taken += struct.unpack_from("<I", read_frame(viewer.recv(5))["femsense/arm/cloud"])[0] == k
            assert taken == 40 and time.monotonic() - begun < 4.0
        slow.settimeout(0.5)
        held = 0
        try:
            while chunk := slow.recv(1 << 20):
                held += len(chunk)
                if held > 12 * len(big):
                    break
        except TimeoutError:
            pass
        slow.close()
        assert held < 8 * len(big)  # of forty: what lay in the sockets, and the newest


@pytest.mark.parametrize("confirms", [True, False])
def test_a_viewer_that_is_slower_than_the_source_sees_the_newest(confirms: bool) -> None:
    with served() as (hub, _publisher, server), watch(server, max_queue=1) as viewer:
        viewer.recv(5)
        if confirms:
            viewer.send(b"")
        hub.publish([Message(POSE, b"first")])
        assert viewer.recv(5)
        for k in range(200):
            hub.publish([Message(POSE, struct.pack("<I", k))])
            time.sleep(0.002)
        seen = []
        while not seen or seen[-1] != 199:
            seen.append(struct.unpack("<I", read_frame(viewer.recv(5))[POSE])[0])
            if confirms:
                viewer.send(b"")
        assert len(seen) <= 6  # those that were under way, and the newest


def test_what_is_confirmed_without_having_been_sent_counts_as_a_flood() -> None:
    with served() as (_hub, _publisher, server), watch(server) as viewer:
        viewer.recv(5)
        with pytest.raises(websockets.ConnectionClosed):
            for _ in range(5):
                viewer.send(b"")
            while True:
                viewer.recv(5)


def upgrade(port: int) -> bytes:
    return (
        f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    ).encode()


@pytest.mark.parametrize(
    "bad",
    [
        "text",
        b"\x00",
        b"\xff" * 100,
        b"x" * 100_000,
        pack([Message("femsense/arm/pose", b"a lie")]),
        pack([Message("femsense/arm/command", b"{}")]),
    ],
    ids=["text", "short", "ones", "oversized", "pose", "command"],
)
def test_who_sends_what_viewers_may_not_send_is_let_go(bad: str | bytes) -> None:
    with served() as (hub, _publisher, server), watch(server) as good:
        heard: list[Message] = []
        hub.listen(lambda message, _: heard.append(message))
        good.recv(5)
        with watch(server) as viewer:
            viewer.send(bad)
            with pytest.raises(websockets.ConnectionClosed):
                while True:
                    viewer.recv(5)
        hub.publish([Message(POSE, b"next")])
        assert read_frame(good.recv(5)) == {POSE: b"next"} and not heard


def test_a_flood_ends_its_connection_and_garbage_hurts_nobody() -> None:
    wanted = pack([Message("femsense/arm/drag", b"{}")])
    with served() as (hub, _publisher, server), watch(server) as good:
        heard: list[Message] = []
        hub.listen(lambda message, _: heard.append(message))
        good.recv(5)
        with watch(server) as viewer, pytest.raises(websockets.ConnectionClosed):
            for _ in range(3000):
                viewer.send(wanted)
            viewer.recv(5)
            viewer.recv(5)
        assert 0 < len(heard) < 1000
        for raw in (b"\x00" * 1000, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 5000, b"POST / HTTP/1.1\r\n\r\n", b"\r\n\r\n"):
            with socket.create_connection(("127.0.0.1", server.port)) as link:
                link.sendall(raw)
        hub.publish([Message(POSE, b"next")])
        assert read_frame(good.recv(5)) == {POSE: b"next"}
        assert within(3.0, lambda: server.viewers == 1)


def test_too_many_viewers_are_told_so_and_a_taken_port_too() -> None:
    with served(most_viewers=1) as (_, _publisher, server), watch(server) as viewer:
        viewer.recv(5)
        with pytest.raises(websockets.InvalidStatus, match="503"):
            watch(server)
        with pytest.raises(InputError, match="cannot be served"):
            served(port=server.port).__enter__()
