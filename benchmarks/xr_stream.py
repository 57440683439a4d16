"""Latency of live streams, and what slow, hostile and many viewers do to them.

    python benchmarks/xr_stream.py [--seconds S] [--soak S] [--robots N] [--viewers N]

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
    """Put (robot, seq, age [s]) statistics of the poses that a client receives."""
    ages: list[float] = []
    newest: dict[str, int] = {}

    def take(topic: str, payload: bytes) -> None:
        if topic.endswith("/pose"):
            _, seq, sent = struct.unpack_from("<4sId", payload)
            ages.append(time.monotonic() - sent)
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
    out.put((ages[10:], len(newest)))


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
    ages, _ = out.get(timeout=seconds + 20)
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
    print(table_row("all together", [age for ages, _ in found for age in ages]))
    print(table_row("the worst one", max((ages for ages, _ in found), key=lambda a: float(np.percentile(a, 95)) if a else 0.0)))
    sent = sum(publisher.sent for publisher in publishers)
    share = np.mean([len(ages) for ages, _ in found]) / sent
    print(f"\nEach viewer got {100 * share:.0f} % of {sent} poses, of {min(n for _, n in found)} robots or more.")
    print(f"Memory of the server {before:.0f} → {after:.0f} MB, processor {100 * cpu / (seconds - 4.0):.0f} % of one core.")
    hub.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--soak", type=float, default=60.0)
    parser.add_argument("--robots", type=int, default=10)
    parser.add_argument("--viewers", type=int, default=10)
    asked = parser.parse_args()
    print(json.dumps({"cores": os.cpu_count(), "load": os.getloadavg()[0]}))
    latency(asked.seconds)
    soak(asked.soak, asked.robots, asked.viewers)


if __name__ == "__main__":
    main()
