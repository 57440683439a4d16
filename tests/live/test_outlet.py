"""What a session shows and sends."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import write_block_robot
from rich.console import Console
from streams import bones_of

from femsense.core.arrays import freeze
from femsense.io.robot_toml import load_robot
from femsense.live.dashboard import draw, lines
from femsense.live.events import Notice, SessionEvent
from femsense.live.feed import FeedCounts
from femsense.live.figures import Latency, Snapshot, Stopwatch
from femsense.live.link import LinkState, LinkStatus
from femsense.live.mcap_sink import McapSink
from femsense.live.outlet import Outlet, live_document, wrench_bytes
from femsense.live.senser import Answer
from femsense.model.robot import Robot
from femsense.sensing.types import ContactForce, FrameReport
from femsense.xr.stream.hub import Hub, Message

SLOW = SessionEvent(Notice.SLOW_LINK, "use a USB 3 port", 92.0, float("inf"))
JUMPS = SessionEvent(Notice.STAMPS_JUMP, "by 100.0 s", 93.0, 96.0, count=2)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("robot")))


def answer_of(robot: Robot, *, shift: float = 0.0) -> Answer:
    place, force = freeze([0.1, 0.02, 0.03]), freeze([0.0, 0.5, -1.0])
    contact = ContactForce(4, 0.4, 0, place, freeze([0.0, 0.0, 1.0]), force, 1.118, 0.05, "cloud", 2)
    report = FrameReport(4, 0.4, "ok", 1, 100, 1e-3, 1e-4, 12.0, {"top": 1.0, "side": 0.5})
    return Answer(report, (contact,), robot.body.mesh.nodes + np.array([shift, 0.0, 0.0]))


def snapshot_of(robot: Robot, state: LinkState = LinkState.STREAMING, reason: str = "") -> Snapshot:
    return Snapshot(
        phase="sensing",
        todo="",
        link=LinkStatus(state, 98.0, reason),
        camera="Software D400",
        link_speed="USB 2.1",
        answer=answer_of(robot),
        taken_s=99.9,
        latency=Latency(0.05, 0.08, 0.09, 14.2),
        counts=FeedCounts(100, 40, 2, 3),
        used=57,
        notices=(SLOW, JUMPS),
        begun_s=90.0,
        recording="here",
    )


def text_of(snapshot: Snapshot, now_s: float) -> str:
    console = Console(width=140, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(draw(snapshot, now_s, "http://x"))
    return console.export_text()


def test_the_terminal_shows_force_interval_age_rates_drops_and_keys(robot: Robot) -> None:
    text = text_of(snapshot_of(robot), 100.0)
    for part in (
        "1.118",
        "1.020 … 1.216",
        "100, 20, 30",
        "ok, 100 ms ago",
        "50 / 80 / 90 ms",
        "14.2 frames/s",
        "57 sensed, 40 skipped, 2 missed, 3 not delivered",
        "recorded in here",
        "! slow link (for 8 s): use a USB 3 port",
        "! stamps jump (4 s ago, 2 times): by 100.0 s",
        "t zero",
        "http://x",
    ):
        assert part in text, part


def test_a_lost_camera_leaves_the_last_answer_with_its_age(robot: Robot) -> None:
    text = text_of(snapshot_of(robot, LinkState.UNPLUGGED, "gone"), 103.0)
    assert "unplugged for 5 s; gone; reconnect the camera" in text and "3.1 s old: ok" in text and "1.118" in text


def test_lines_say_what_has_changed_once(robot: Robot) -> None:
    before, lost = snapshot_of(robot), snapshot_of(robot, LinkState.UNPLUGGED, "gone")
    assert list(lines(None, before, 100.0)) == [
        "sensing",
        "2.0 s: slow link: use a USB 3 port",
        "3.0 s: stamps jump: by 100.0 s",
    ]
    assert list(lines(before, before, 100.0)) == []
    said = list(lines(before, replace(lost, notices=(replace(SLOW, ended_s=99.0),)), 100.0))
    assert said[0].startswith("camera: unplugged for 2 s") and said[1:] == ["9.0 s: slow link: over after 7.0 s"]


def test_latencies_are_percentiles_of_the_last_seconds() -> None:
    watch = Stopwatch(window_s=10.0)
    assert np.isnan(watch.latency().p50_s)
    watch.add(0.0, 9.0)
    for k in range(101):
        watch.add(50.0 + 0.1 * k, 0.001 * k)
    found = watch.latency()
    assert (found.p50_s, found.p95_s, found.p99_s) == pytest.approx((0.050, 0.095, 0.099)) and found.rate_hz == pytest.approx(
        10.0
    )


def test_a_wrench_is_the_sum_of_the_forces_and_their_torque_about_the_origin(robot: Robot) -> None:
    document = json.loads(wrench_bytes(3, 12.5, answer_of(robot)))
    assert set(document) == {"header", "wrench"} and document["header"]["stamp"] == {"secs": 12, "nsecs": 500_000_000}
    assert document["header"]["frame_id"] == "robot" and document["wrench"]["force"] == {"x": 0.0, "y": 0.5, "z": -1.0}
    torque = np.cross([0.1, 0.02, 0.03], [0.0, 0.5, -1.0])
    assert [document["wrench"]["torque"][axis] for axis in "xyz"] == pytest.approx(torque.tolist())


def test_what_is_not_known_is_left_out_of_the_state(robot: Robot) -> None:
    document = live_document(replace(snapshot_of(robot), latency=Latency()), 100.0)
    assert "rate_hz" not in document and document["answer_age_s"] == pytest.approx(0.1)
    slow = {"kind": "slow link", "text": "use a USB 3 port", "time_s": 2.0, "duration_s": 8.0, "lasts": True, "count": 1}
    assert document["notices"][0] == slow and document["notices"][1]["duration_s"] == 3.0 and json.dumps(document)


def test_a_session_streams_poses_forces_and_its_state_and_never_an_old_force_as_new(robot: Robot) -> None:
    import time

    hub = Hub()
    outlet = Outlet(hub, robot)
    assert json.loads(hub.newest()["femsense/block/status"].payload)["state"] == "waiting"
    now = time.monotonic()
    outlet.show(answer_of(robot, shift=0.01), now)
    newest = {name: message.payload for name, message in hub.newest().items()}
    bones, rest = bones_of(newest["femsense/block/pose"]), outlet.publisher.twin.T_robot_bone[:, :3, 3]
    assert bones[:, :3] == pytest.approx(rest + np.array([0.01, 0.0, 0.0]), abs=2e-4)
    force = json.loads(newest["femsense/block/force"])
    assert force["contacts"][0]["size_n"] == pytest.approx(1.118, abs=1e-3) and force["status"] == "ok"
    poses = outlet.publisher.sent
    lost = replace(snapshot_of(robot, LinkState.UNPLUGGED, "gone"), taken_s=now)
    time.sleep(0.5)
    outlet.tell(lost, time.monotonic())
    after = {name: json.loads(m.payload) for name, m in hub.newest().items() if name.endswith(("force", "status", "live"))}
    assert outlet.publisher.sent == poses  # no pose: what is shown is as old as it was
    assert "unplugged" in after["femsense/block/force"]["status"] and "s old" in after["femsense/block/force"]["status"]
    assert after["femsense/block/status"]["state"] == "stale" and after["femsense/block/live"]["link"] == "unplugged"
    outlet.end()


def test_messages_are_written_as_mcap(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    hub = Hub()
    hub.attach(McapSink(tmp_path / "session.mcap"))
    sender = threading.Thread(
        target=lambda: hub.publish([Message("femsense/arm/wrench", b'{"a": 1}'), Message("femsense/arm/pose", b"x")])
    )
    sender.start()
    sender.join()
    hub.close()
    with (tmp_path / "session.mcap").open("rb") as stream:
        found = [(schema.name, channel.topic, message.data) for schema, channel, message in make_reader(stream).iter_messages()]
    assert found == [("geometry_msgs/WrenchStamped", "femsense/arm/wrench", b'{"a": 1}')]
