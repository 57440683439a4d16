"""Latency of live streams, and what slow, hostile and many viewers do to them.

    python benchmarks/xr_stream.py [--seconds S] [--soak S] [--robots N] [--viewers N] [--only latency|flood|slow|soak]

The flood: readings at 500 Hz by UDP, JSON and CSV, through a learnt model and out at 60 Hz; the age of a pose counts from when its
reading was made, and what still goes out after the last reading is counted. Beside it a process that does nothing but sleep shows how late
this machine wakes a process at that time. The slow viewers handle 25 frames a second.

Clients run in processes of their own and compare clocks of the same machine (CLOCK_MONOTONIC). A pose has 12 bones, 356 bytes,
60 Hz. The soak: robots at 60 Hz to viewers; one viewer more reads nothing, one sends garbage, floods, asks for files,
sends oversized frames.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing as mp
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from femsense.xr.stream.hub import Hub
from femsense.xr.stream.mqtt import BrokerAddress, EmbeddedBroker, MqttSink, MqttSource
from femsense.xr.stream.payloads import Twin, TwinFrame, pose_bytes
from femsense.xr.stream.publisher import Publisher
from femsense.xr.stream.websocket import WebSocketServer, unpack

BONES, RATE = 12, 60.0
PAPER_MS = 1.19


def twin(name: str) -> Twin:
    """A robot of 12 bones."""
    return Twin(name, b"glTF", tuple(f"b{i}" for i in range(BONES)), np.tile(np.eye(4), (BONES, 1, 1)))


def latencies(kind: str, port: int, seconds: float, out: Any) -> None:
    """Put the ages [s] of the poses that a client receives, the number of robots, and when the last pose came."""
    ages: list[float] = []
    newest: dict[str, int] = {}
    last = float("nan")

    def take(topic: str, payload: bytes) -> None:
        nonlocal last
        if topic.endswith("/pose"):
            _, seq, sent = struct.unpack_from("<4sId", payload)
            last = time.monotonic()
            ages.append(last - sent)
            newest[topic] = seq

    end = time.monotonic() + seconds
    if kind == "mqtt":
        source = MqttSource(BrokerAddress("127.0.0.1", port), lambda m: take(m.topic, m.payload))
        time.sleep(seconds)
        source.close()
    else:
        from websockets.sync.client import connect

        with connect(f"ws://127.0.0.1:{port}/ws", proxy=None, compression=None, max_size=None) as viewer:
            while time.monotonic() < end:
                with suppress(TimeoutError):
                    for message in unpack(viewer.recv(0.2)):
                        take(message.topic, message.payload)
    out.put((ages[10:], len(newest), last))


def send(publishers: list[Publisher], seconds: float) -> None:
    """Publish poses whose time is the moment of sending."""
    bones = np.zeros((BONES, 7), dtype=np.float32)
    begun = time.monotonic()
    for k in range(int(seconds * RATE)):
        time.sleep(max(0.0, begun + k / RATE - time.monotonic()))
        for publisher in publishers:
            publisher.publish(TwinFrame(time.monotonic(), bones))


def table_row(name: str, ages: list[float]) -> str:
    p50, p95, p99 = (1e3 * np.percentile(ages, q) for q in (50, 95, 99)) if ages else (np.nan,) * 3
    return f"| {name} | {p50:.2f} | {p95:.2f} | {p99:.2f} | {len(ages)} |"


def measure(kind: str, port: int, publishers: list[Publisher], seconds: float) -> list[float]:
    out: Any = mp.get_context("spawn").Queue()
    client = mp.get_context("spawn").Process(target=latencies, args=(kind, port, seconds + 3.0, out))
    client.start()
    time.sleep(2.5)
    send(publishers, seconds)
    ages, *_ = out.get(timeout=seconds + 20)
    client.join()
    return list(ages)


def latency(seconds: float) -> None:
    print("| way | p50 [ms] | p95 | p99 | poses |\n|---|---|---|---|---|")
    hub = Hub()
    publishers = [Publisher(hub, twin("arm"))]
    broker = EmbeddedBroker(hub, port=0)
    print(table_row("embedded broker", measure("mqtt", broker.port, publishers, seconds)), flush=True)
    hub.close()
    server_hub = Hub()
    publishers = [Publisher(server_hub, twin("arm"))]
    server = WebSocketServer(server_hub, {})
    print(table_row("WebSocket", measure("ws", server.port, publishers, seconds)), flush=True)
    server_hub.close()
    if (mosquitto := shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")) is not None:
        print(table_row("mosquitto", with_mosquitto(mosquitto, seconds)), flush=True)
    print(f"| paper: message and MQTT | {PAPER_MS} (mean) | | | |")
    begun = time.perf_counter()
    for k in range(10_000):
        pose_bytes(k, 0.0, np.zeros((BONES, 7), dtype=np.float32))
    print(f"\nA pose is packed in {1e2 * (time.perf_counter() - begun):.1f} µs.")


# A flood of readings, and viewers that are slower than the poses


def send_readings(port: int, seconds: float, rate_hz: float, out: Any) -> None:
    """Send readings of two channels by UDP; their time is the moment of sending."""
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    begun, k = time.monotonic(), 0
    while (now := time.monotonic()) < begun + seconds:
        reading = {"time_s": now, "bend": 0.3 * np.sin(now), "sway": 0.0}
        line = json.dumps(reading) if k % 2 else f"{now},{reading['bend']},0.0"
        link.sendto(line.encode(), ("127.0.0.1", port))
        k += 1
        time.sleep(max(0.0, begun + k / rate_hz - time.monotonic()))
    out.put((k, time.monotonic()))


def sleep_only(seconds: float, out: Any) -> None:
    """Put the longest delay [s] with which a process that only sleeps for 2 ms at a time is woken."""
    late, end = 0.0, time.monotonic() + seconds
    while (now := time.monotonic()) < end:
        time.sleep(0.002)
        late = max(late, time.monotonic() - now - 0.002)
    out.put(late)


def line_model() -> Any:
    """A model of five markers on a line, moved by two channels, with twelve bones."""
    from femsense.xr.armature import ArmatureOptions, make_armature
    from femsense.xr.proprioception.domain import learn_domain
    from femsense.xr.proprioception.model import ProprioceptiveModel
    from femsense.xr.proprioception.network import linear_network

    rest = np.outer(np.linspace(0, 0.1, 5), [0, 0, 1.0])
    slopes = np.zeros((5, 3, 2))
    slopes[:, 0, 0], slopes[:, 1, 1] = rest[:, 2], rest[:, 2]
    domain = learn_domain(np.random.default_rng(0).uniform(-0.5, 0.5, (300, 2)))
    network = linear_network(np.zeros(2), np.ones(2), slopes.reshape(15, 2), rest.ravel())
    chain = make_armature(rest, ArmatureOptions(bones=BONES))
    return ProprioceptiveModel(("bend", "sway"), tuple("abcde"), network, (), domain, chain)


def flood(seconds: float, rate_hz: float = 500.0) -> None:
    from femsense.app.stream_command import StreamOptions, stream_sensors
    from femsense.xr.proprioception.model_file import save_model
    from femsense.xr.view import PAGE

    spawn = mp.get_context("spawn")
    out: Any = spawn.Queue()
    sent: Any = spawn.Queue()
    late: Any = spawn.Queue()
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        model = save_model(line_model(), Path(folder) / "line.onnx")
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        probe.close()
        with stream_sensors(f"udp://127.0.0.1:{port}", model, StreamOptions(port=0, page=PAGE)) as live:
            client = spawn.Process(target=latencies, args=("ws", live.server.port, seconds + 5.0, out))
            client.start()
            time.sleep(2.0)
            source = spawn.Process(target=send_readings, args=(port, seconds, rate_hz, sent))
            sleeper = spawn.Process(target=sleep_only, args=(seconds, late))
            source.start()
            sleeper.start()
            count, ended = sent.get(timeout=seconds + 20.0)
            ages, _, last = out.get(timeout=seconds + 20.0)
            woken = late.get(timeout=seconds + 20.0)
            for process in (source, sleeper, client):
                process.join()
            poses, dropped = live.publishers[0].sent, live.sources[0].dropped
    print(f"\n{count} readings at {rate_hz:.0f} Hz, {poses} poses, {dropped} readings replaced by newer ones:\n")
    print("| from a reading to a viewer | p50 [ms] | p95 | p99 | poses |\n|---|---|---|---|---|")
    print(table_row("flood", ages), flush=True)
    print(
        f"\nThe oldest pose was {1e3 * max(ages):.1f} ms old; the last arrived {1e3 * (last - ended):.1f} ms after the last reading.\n"
        f"Meanwhile a process that only sleeps was woken up to {1e3 * woken:.1f} ms late."
    )


def watch_slowly(port: int, seconds: float, confirms: bool, out: Any) -> None:
    """Put the ages of poses at a viewer that takes 40 ms for each frame."""
    from websockets.sync.client import connect

    ages: list[float] = []
    end = time.monotonic() + seconds
    with connect(f"ws://127.0.0.1:{port}/ws", proxy=None, compression=None, max_size=None) as viewer:
        while time.monotonic() < end:
            with suppress(TimeoutError):
                for message in unpack(viewer.recv(0.2)):
                    if message.topic.endswith("/pose"):
                        ages.append(time.monotonic() - struct.unpack_from("<4sId", message.payload)[2])
                time.sleep(0.04)
                if confirms:
                    viewer.send(b"")
    out.put(ages)


def slow(seconds: float) -> None:
    print("\n| viewer that handles 25 frames a second | p50 [ms] | p95 | p99 | poses |\n|---|---|---|---|---|")
    for confirms in (True, False):
        hub = Hub()
        publisher = Publisher(hub, twin("arm"))
        server = WebSocketServer(hub, {})
        out: Any = mp.get_context("spawn").Queue()
        client = mp.get_context("spawn").Process(target=watch_slowly, args=(server.port, seconds + 3.0, confirms, out))
        client.start()
        time.sleep(2.0)
        send([publisher], seconds)
        print(table_row("confirms its frames" if confirms else "does not", out.get(timeout=seconds + 20.0)), flush=True)
        client.join()
        hub.close()


def with_mosquitto(program: str, seconds: float) -> list[float]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder, "mosquitto.conf")
        settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\n", encoding="utf-8")
        broker = subprocess.Popen([program, "-c", str(settings)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            hub = Hub()
            sink = MqttSink(hub, BrokerAddress("127.0.0.1", port), "arm")
            sink.connected.wait(10.0)
            ages = measure("mqtt", port, [Publisher(hub, twin("arm"))], seconds)
            hub.close()
        finally:
            broker.terminate()
            broker.wait()
    return ages


# Many, slow and hostile viewers


def upgrade(port: int) -> bytes:
    return (
        f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    ).encode()


def be_hostile(port: int, seconds: float) -> None:
    """Garbage, floods, paths, oversized frames, one after another."""
    from websockets.sync.client import connect

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for raw in (
            os.urandom(2000),
            b"GET /../../etc/passwd HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
            b"GET / HTTP/1.1\r\n" + b"x: y\r\n" * 300,
        ):
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0) as link:
                link.sendall(raw)
        for frame, times in ((b"x" * 100_000, 1), (os.urandom(100), 1), (b"\x12\x00\x02\x00\x00\x00femsense/arm-0/drag{}", 500)):
            with suppress(Exception), connect(f"ws://127.0.0.1:{port}/ws", proxy=None, open_timeout=2, max_size=None) as viewer:
                for _ in range(times):
                    viewer.send(frame)
        time.sleep(0.2)


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak(seconds: float, robots: int, viewers: int) -> None:
    hub = Hub()
    publishers = [Publisher(hub, twin(f"arm-{i}")) for i in range(robots)]
    server = WebSocketServer(hub, {})
    spawn = mp.get_context("spawn")
    out: Any = spawn.Queue()
    watching = [spawn.Process(target=latencies, args=("ws", server.port, seconds + 6.0, out)) for _ in range(viewers)]
    watching.append(spawn.Process(target=be_hostile, args=(server.port, seconds)))
    for process in watching:
        process.start()
    slow = socket.create_connection(("127.0.0.1", server.port))
    slow.sendall(upgrade(server.port))  # and never reads
    time.sleep(5.0)
    send(publishers, 2.0)
    before, cpu = resident_mb(), time.process_time()
    send(publishers, seconds - 4.0)
    after, cpu = resident_mb(), time.process_time() - cpu
    found = [out.get(timeout=60) for _ in range(viewers)]
    for process in watching:
        process.join(20)
    slow.close()
    print(
        f"\n{robots} robots at {RATE:.0f} Hz to {viewers} viewers for {seconds:.0f} s, beside one that does not read and "
        f"one that is hostile:\n"
    )
    print("| viewer | p50 [ms] | p95 | p99 | poses |\n|---|---|---|---|---|")
    print(table_row("all together", [age for ages, *_ in found for age in ages]))
    print(table_row("the worst one", max((ages for ages, *_ in found), key=lambda a: float(np.percentile(a, 95)) if a else 0.0)))
    sent = sum(publisher.sent for publisher in publishers)
    share = np.mean([len(ages) for ages, *_ in found]) / sent
    print(f"\nEach viewer got {100 * share:.0f} % of {sent} poses, of {min(n for _, n, _ in found)} robots or more.")
    print(f"Memory of the server {before:.0f} → {after:.0f} MB, processor {100 * cpu / (seconds - 4.0):.0f} % of one core.")
    hub.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--soak", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--viewers", type=int, default=10)
    parser.add_argument("--only", choices=["latency", "flood", "slow", "soak"])
    asked = parser.parse_args()
    print(json.dumps({"cores": os.cpu_count(), "load": os.getloadavg()[0]}))
    parts = {
        "latency": lambda: latency(asked.seconds),
        "flood": lambda: flood(asked.seconds),
        "slow": lambda: slow(asked.seconds),
        "soak": lambda: soak(asked.soak, asked.robots, asked.viewers),
    }
    for name, part in parts.items():
        if asked.only in (None, name):
            part()


if __name__ == "__main__":
    main()
