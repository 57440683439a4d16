"""Rates, order, and what a hub tells whom."""

from __future__ import annotations

import dataclasses
import json
import struct
import threading
import time

import numpy as np
from streams import moment, twin

from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import FieldKind
from femsense.xr.stream.publisher import Publisher, PublishOptions, RateLimit, play


class Kept:
    """A sink that keeps what it is given."""

    def __init__(self) -> None:
        self.batches: list[tuple[Message, ...]] = []

    def send(self, messages: tuple[Message, ...]) -> None:
        self.batches.append(messages)

    def close(self) -> None:
        self.batches.clear()

    def topics(self) -> list[str]:
        return [message.topic.rpartition("/")[2] for batch in self.batches for message in batch]


def test_a_source_of_the_wanted_rate_passes_with_its_jitter_and_a_faster_one_is_thinned() -> None:
    limit = RateLimit(60.0)
    assert sum(limit.allows(k / 60 + (0.002 if k % 2 else 0.0)) for k in range(600)) == 600
    limit = RateLimit(60.0)
    assert 595 <= sum(limit.allows(k / 1000) for k in range(10_000)) <= 606


def test_who_comes_late_is_told_the_model_and_the_newest() -> None:
    hub, late = Hub(), Kept()
    publisher = Publisher(hub, twin(), PublishOptions(json_mirror=True))
    publisher.publish(moment(0.0), now=0.0)
    publisher.publish(moment(1.0, x=0.5), now=1.0)
    hub.attach(late)
    assert late.topics() == ["glb", "model", "status", "pose", "force", "inputs", "pose_json"]
    assert {m.topic for m in late.batches[0] if m.retained} == {f"femsense/arm/{k}" for k in ("glb", "model", "status")}


def test_messages_of_a_moment_go_together_and_too_many_do_not_go() -> None:
    hub, sink = Hub(), Kept()
    publisher = Publisher(hub, twin())
    hub.attach(sink)
    sink.batches.clear()
    assert publisher.publish(moment(0.0), now=0.0) and not publisher.publish(moment(0.001), now=0.001)
    assert sink.topics() == ["status", "pose", "force", "inputs"] and len(sink.batches) == 1
    publisher.end()
    assert b"ended" in hub.newest()["femsense/arm/status"].payload


def test_until_the_first_pose_it_is_said_what_is_waited_for() -> None:
    hub = Hub()
    publisher = Publisher(hub, twin(), PublishOptions(waits_for="readings of a.csv"))

    def status() -> dict[str, object]:
        return json.loads(hub.newest()["femsense/arm/status"].payload)

    waiting = {"state": "waiting", "detail": "readings of a.csv"}
    assert status() == waiting
    publisher.watch(now=time.monotonic() + 10.0)
    publisher.announce(twin(name="arm", frame="markers"))  # something else about it has changed
    assert status() == waiting  # what never was live is not stale
    publisher.publish(moment(0.0))
    assert status() == {"state": "live", "detail": ""}
    publisher.announce(twin())
    assert status() == {"state": "live", "detail": ""}


def test_a_source_that_stops_is_stale_until_it_goes_on() -> None:
    hub, late = Hub(), Kept()
    publisher = Publisher(hub, twin(frame="markers"))

    def status() -> dict[str, object]:
        return json.loads(hub.newest()["femsense/arm/status"].payload)

    begun = time.time()
    publisher.publish(moment(0.0), now=10.0)
    publisher.watch(now=10.39)
    assert status()["state"] == "live"
    publisher.watch(now=10.41)
    hub.attach(late)
    assert status()["state"] == "stale" and begun <= float(str(status()["since_s"])) <= time.time()
    assert late.topics()[:3] == ["glb", "model", "status"]  # who comes late is told before it shows a pose
    publisher.watch(now=12.0)
    assert len(late.batches) == 1  # it is said once
    publisher.publish(moment(1.0), now=13.0)
    assert status() == {"state": "live", "detail": ""} and late.topics()[-4:] == ["status", "pose", "force", "inputs"]
    assert b'"frame_id":"markers"' in hub.newest()["femsense/arm/force"].payload
    publisher.end()
    publisher.watch(now=20.0)
    publisher.publish(moment(2.0), now=21.0)
    assert status()["state"] == "ended"


def test_what_is_old_when_it_comes_is_stale_from_the_first_and_as_old_as_it_is() -> None:
    hub, late = Hub(), Kept()
    publisher = Publisher(hub, twin())
    publisher.publish(dataclasses.replace(moment(0.0), read_at=900.0), now=1000.0)
    hub.attach(late)
    told = json.loads(hub.newest()["femsense/arm/status"].payload)
    assert (told["state"], told["detail"]) == ("stale", "") and 99.0 < time.time() - told["since_s"] < 110.0
    assert late.topics()[:4] == ["glb", "model", "status", "pose"]
    publisher.publish(dataclasses.replace(moment(1.0), read_at=1001.0), now=1001.0)
    assert json.loads(hub.newest()["femsense/arm/status"].payload)["state"] == "live"


def test_frames_without_a_new_pose_do_not_keep_it_live_and_their_reason_is_said() -> None:
    hub, late = Hub(), Kept()
    publisher = Publisher(hub, twin())

    def blind(at: float, read_at: float) -> None:
        publisher.publish(dataclasses.replace(moment(at), read_at=read_at, status="red: no number"), now=at)

    def status() -> tuple[str, str]:
        told = json.loads(hub.newest()["femsense/arm/status"].payload)
        return told["state"], told["detail"]

    blind(9.0, float("-inf"))
    assert status() == ("waiting", "red: no number") and "femsense/arm/pose" not in hub.newest()
    publisher.publish(dataclasses.replace(moment(10.0), read_at=10.0), now=10.0)
    assert status() == ("live", "") and publisher.trouble == ""
    hub.attach(late)
    late.batches.clear()
    blind(10.3, 10.0)
    blind(10.5, 10.0)
    assert late.topics() == ["force", "inputs", "status", "force", "inputs"] and publisher.sent == 1
    assert status() == ("stale", "red: no number") and publisher.trouble == "red: no number"
    numbers = [json.loads(m.payload)["header"]["seq"] for batch in late.batches for m in batch if m.topic.endswith("/force")]
    assert numbers == [2, 3]  # each document has its own
    publisher.publish(dataclasses.replace(moment(11.0), read_at=11.0), now=11.0)
    assert status() == ("live", "") and publisher.trouble == ""


def test_a_field_goes_out_ten_times_a_second_at_most() -> None:
    hub, sink = Hub(), Kept()
    coloured = dataclasses.replace(twin(), field=FieldKind("stress", "Pa", largest=2500.0))
    publisher, shares = Publisher(hub, coloured), np.array([0, 128, 255], dtype=np.uint8)
    hub.attach(sink)
    for k in range(60):
        publisher.publish(dataclasses.replace(moment(k / 60), field=shares), now=k / 60)
    assert sink.topics().count("field") in (10, 11) and sink.topics().count("pose") >= 59
    payload = hub.newest()["femsense/arm/field"].payload
    magic, _, _, count, largest = struct.unpack_from("<4sIdIf", payload)
    assert (magic, count, largest) == (b"FSV1", 3, 2500.0) and payload[24:] == shares.tobytes()
    assert b'"field":{"name":"stress","unit":"Pa"}' in hub.newest()["femsense/arm/model"].payload.replace(b" ", b"")


def test_frames_are_played_at_their_times() -> None:
    hub, sink = Hub(), Kept()
    publisher, now = Publisher(hub, twin()), [100.0]

    class Waiting(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            now[0] += timeout or 0.0
            times.append(now[0] - 100.0)
            return False

    times: list[float] = []
    play(publisher, [moment(t) for t in (2.0, 2.5, 4.0)], Waiting(), clock=lambda: now[0])
    hub.attach(sink)
    assert times == [0.0, 0.5, 2.0] and publisher.sent >= 1
