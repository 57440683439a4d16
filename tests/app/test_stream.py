"""`femsense stream` and `view --stream`: from a run on one end to a viewer on the other."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Timer

import numpy as np
import pytest
from glb import ROOT
from hand import Hand
from helpers import write_block_robot, write_small_recording
from small_run import make_run, write_run_with_a_cloud
from streams import within
from xr_bar import write_run_with_mesh

from femsense.app.stream_command import (
    StreamOptions,
    let_drag,
    measure_by_sensors,
    show_stream,
    stream_document,
    stream_runs,
    stream_sensors,
    stream_text,
)
from femsense.app.stream_options import need_one
from femsense.calib.calibration import Calibration
from femsense.calib.files import write_calibration
from femsense.core.errors import InputError
from femsense.fem.equilibrium import solve_equilibrium
from femsense.io.clouds.cloud_files import write_cloud
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.run_files import run_inputs, write_run
from femsense.xr.armature import make_armature
from femsense.xr.proprioception.domain import learn_domain
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.model_file import save_model
from femsense.xr.proprioception.network import linear_network
from femsense.xr.stream.command_gate import GateOptions
from femsense.xr.stream.connecting import REFUSED
from femsense.xr.stream.drag_server import DragOptions
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import EmbeddedBroker
from femsense.xr.stream.websocket import pack, unpack
from femsense.xr.view import PAGE

pytest.importorskip("websockets")
from websockets.sync.client import connect

pytest.importorskip("amqtt")


@pytest.fixture
def page(tmp_path: Path) -> Path:
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<p>page</p>", encoding="utf-8")
    return folder


def test_two_runs_reach_a_viewer_of_a_viewer(tmp_path: Path, page: Path) -> None:
    run = write_run_with_mesh(tmp_path / "bar")
    with (
        stream_runs([run, run], StreamOptions(port=0, page=page, broker_port=0, json_mirror=True)) as live,
        show_stream(live.url, page=page) as shown,
    ):
        said = stream_document(live)
        assert said["robots"] == ["bar", "bar-2"] and said["url"] == live.url and said["broker_port"] > 0
        assert live.url in stream_text(live) and "femsense/bar-2" in stream_text(live)
        for robot in said["robots"]:
            assert within(10.0, lambda name=robot: f"femsense/{name}/pose_json" in shown.hub.newest())
            assert shown.hub.newest()[f"femsense/{robot}/glb"].payload[:4] == b"glTF"
    assert json.loads(live.hub.newest()["femsense/bar/status"].payload)["state"] == "ended"


def test_a_run_without_its_mesh_says_that_it_is_made_and_streams_what_was_measured(tmp_path: Path, page: Path) -> None:
    run, made, _ = write_run_with_a_cloud(tmp_path)
    surface = PointCloud(made.states.nodes_m[1].astype(float), None)
    write_cloud(tmp_path / "recording" / "clouds" / "000001.ply", surface)
    unknown, here = np.zeros((6, 6)), np.eye(4)
    write_calibration(
        Calibration(here, (here,), ("",), {}, {}, 0.0, {}, (), here, unknown, {}, {}, "given"), run / "calibration.json"
    )
    said: list[str] = []
    with stream_runs([run], StreamOptions(port=0, page=page), say=said.append) as live:
        assert said == [f"making the mesh of {run}"]
        newest, topic = live.hub.newest, f"femsense/{made.robot.name}/cloud"
        assert within(30.0, lambda: topic in newest() and len(newest()[topic].payload) > 100)
        points = np.frombuffer(newest()[topic].payload[20:], dtype="<f4").reshape(-1, 4)
    assert len(points) > 30 and np.abs(points[:, 3]).max() < 0.02  # points of the body, by their distance from its surface


def test_a_run_that_is_played_once_ends_and_says_so(tmp_path: Path, page: Path) -> None:
    run = write_run_with_mesh(tmp_path / "bar")
    with stream_runs([run], StreamOptions(port=0, page=page), loop=False) as live:
        live.wait()
        assert b"ended" in live.hub.newest()["femsense/bar/status"].payload and live.publishers[0].sent > 100


def test_a_connection_that_is_missing_is_said_until_it_is_there(tmp_path: Path, page: Path) -> None:
    run, said = write_run_with_mesh(tmp_path / "bar"), []
    nowhere = stream_runs([run], StreamOptions(port=0, page=page, mqtt="127.0.0.1:1"), loop=False)
    with nowhere, show_stream("http://127.0.0.1:1", page=page) as shown:
        assert within(5.0, lambda: "Connection refused" in shown.trouble)
        assert within(5.0, lambda: REFUSED in nowhere.trouble)
        assert nowhere.trouble == f"no connection to 127.0.0.1:1 ({REFUSED}), trying again"
        Timer(4.0, shown.stop.set).start()
        shown.wait(said.append)
        assert len(said) == 1 and said[0].startswith("no connection to http://127.0.0.1:1 (")
    with stream_runs([run], StreamOptions(port=0, page=page)) as live, show_stream(live.url, page=page) as shown:
        assert within(5.0, lambda: shown.trouble == "")


def test_a_stream_that_ends_has_ended_for_a_viewer_of_a_viewer_too(tmp_path: Path, page: Path) -> None:
    run = write_run_with_mesh(tmp_path / "bar")
    with stream_runs([run], StreamOptions(port=0, page=page, broker_port=0)) as live:
        broker = show_stream(f"mqtt://127.0.0.1:{live.broker.port}", page=page) if live.broker else None
        shown = [one for one in (broker, show_stream(live.url, page=page)) if one is not None]
        for one in shown:
            assert within(30.0, lambda one=one: "femsense/bar/pose" in one.hub.newest())
    assert len(shown) == 2
    for one in shown:
        with one:
            assert within(30.0, lambda one=one: one.trouble != "")
            assert json.loads(one.hub.newest()["femsense/bar/status"].payload) == {"state": "ended", "detail": ""}


def test_sensors_that_say_nothing_are_said_until_readings_come(tmp_path: Path, page: Path) -> None:
    rest, said, states = np.outer(np.arange(5.0), [0.0, 0.0, 0.02]), [], []
    network = linear_network(np.zeros(1), np.ones(1), np.ones((15, 1)), rest.ravel())
    domain = learn_domain(np.random.default_rng(0).uniform(-2.0, 2.0, (300, 1)))
    chain = ProprioceptiveModel(("bend",), tuple("abcde"), network, (), domain, make_armature(rest))
    model = save_model(chain, tmp_path / "m.onnx")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with stream_sensors("mqtt://me:secret@127.0.0.1:1/arm", model, StreamOptions(port=0, page=page)) as live:
        assert within(5.0, lambda: REFUSED in live.trouble)
        assert live.trouble == f"no readings of mqtt://127.0.0.1:1/arm (no connection, {REFUSED}), waiting"
    with stream_sensors(f"udp://127.0.0.1:{port}", model, StreamOptions(port=0, page=page)) as live:
        assert live.trouble == f"no readings of udp://127.0.0.1:{port} (nothing has come yet), waiting"

        def state() -> object:
            return json.loads(live.hub.newest()["femsense/m/status"].payload)["state"]

        def send() -> None:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                for count in (1, 3):
                    within(20.0, lambda count=count: len(said) == count)
                    states.append(state())
                    sender.sendto(b"0.5", ("127.0.0.1", port))
                    within(1.0, lambda: state() == "live")
                    states.append(state())
                    within(20.0, lambda count=count: len(said) == count + 1)
            live.stop.set()

        Timer(0.1, send).start()
        live.wait(said.append)
    why = ("nothing has come yet", "they stopped")
    silences = [f"no readings of udp://127.0.0.1:{port} ({text}), waiting" for text in why]
    come = f"readings of udp://127.0.0.1:{port} come"
    assert said == [silences[0], come, silences[1], come]
    assert states == ["waiting", "live", "stale", "live"]


def test_a_password_travels_encrypted_or_it_is_said(tmp_path: Path, page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FEMSENSE_PASSWORD", "secret")
    with stream_runs([write_run_with_mesh(tmp_path / "bar")], StreamOptions(port=0, page=page)) as live:
        assert "unencrypted" in stream_text(live) and "secret" not in stream_text(live)
    (tmp_path / "empty").write_text("\n", encoding="utf-8")
    with pytest.raises(InputError, match="password is empty"):
        show_stream("http://127.0.0.1:1", page=page, password_file=tmp_path / "empty")


@pytest.mark.skipif(not (PAGE / "index.html").is_file(), reason="the page was not built into this installation")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_the_command_line_says_at_once_what_it_does_and_at_the_end_what_was_streamed(tmp_path: Path, end: signal.Signals) -> None:
    run = write_run_with_mesh(tmp_path / "bar")
    call = [sys.executable, "-m", "femsense", "stream", str(run), "--port", "0"]
    with subprocess.Popen(
        call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, preexec_fn=heeding_interrupts
    ) as program:
        try:
            assert program.stdout is not None and program.stderr is not None
            assert program.stderr.readline() == f"reading {run}\n"
            url = program.stdout.readline().strip()
            with connect(f"{url.replace('http', 'ws')}ws", proxy=None, compression=None, max_size=None) as viewer:
                assert viewer.recv(5)
            program.send_signal(end)
            assert program.wait(20) == 0
            said = program.stderr.read()
        finally:
            program.kill()
    assert re.fullmatch(r"streamed [1-9]\d* poses? of bar in \d+\.\d s, to 1 viewer\n", said), said


@pytest.mark.skipif(not (PAGE / "index.html").is_file(), reason="the page was not built into this installation")
def test_the_command_line_lets_a_viewer_drag_and_a_viewer_of_it_too(tmp_path: Path) -> None:
    robot = write_block_robot(tmp_path / "robot")
    made = make_run(load_robot(robot))
    recording = load_recording(write_small_recording(tmp_path / "recording"))
    run = write_run(made, tmp_path / "run", inputs=run_inputs(made.robot, recording, None))
    marker = made.robot.glued_names[0]
    place = dict(zip("xyz", map(float, made.robot.marker_points[0] + [0.0, 0.0, 0.002])))
    with stream_runs([run], StreamOptions(port=0)) as live:  # kernels that are compiled here are there for the command too
        server = let_drag(live, run, DragOptions())
        answered = server.answer(marker, (place["x"], place["y"], place["z"]))
        while answered.status == "converging":
            answered = server.answer(marker, (place["x"], place["y"], place["z"]))
    assert answered.status in ("reached", "nearest")
    wish = {"client": "me", "handle": marker, "target_m": place, "held": True, "armed": True}
    for commands in ((), ("--commands",)):
        with (
            command_line("stream", str(run), "--drag", *commands, "--port", "0") as url,
            command_line("view", "--stream", url, "--no-browser") as again,
        ):
            heard: dict[str, dict[str, object]] = {}
            with connect(f"{again.replace('http', 'ws')}ws", proxy=None, compression=None, max_size=None) as viewer:
                end, sent, seq = time.monotonic() + 30.0, 0.0, 0
                while time.monotonic() < end and not (is_found(heard) and heard.get("command", {}).get("armed")):
                    if is_found(heard) and not commands:
                        end = min(end, time.monotonic() + 0.5)
                    if time.monotonic() - sent > 0.03:  # as the page does
                        lease, seq = heard.get("lease", {}), seq + 1
                        number = lease["number"] if lease.get("client") == "me" else 0
                        said = json.dumps({**wish, "seq": seq, "lease": number}).encode()
                        viewer.send(pack([Message(f"femsense/{made.robot.name}/drag", said)]))
                        sent = time.monotonic()
                    for message in unpack(viewer.recv(5)):
                        if not message.topic.endswith(("/pose", "/ghost", "/cloud", "/field")):
                            heard[message.topic.rpartition("/")[2]] = json.loads(message.payload)
            assert heard["model"]["commands"] is bool(commands)
            assert [handle["name"] for handle in heard["model"]["handles"]] == list(made.robot.glued_names)
            assert is_found(heard) and ("command" in heard) == bool(commands)
            if commands:
                assert {row["name"] for row in heard["command"]["inputs"]} == set(made.robot.body.cable_names)


def test_commands_of_a_drag_are_counted_from_the_calibrated_initial_tensions(tmp_path: Path, page: Path) -> None:
    robot = write_block_robot(tmp_path / "robot")
    made = make_run(load_robot(robot))
    recording = load_recording(write_small_recording(tmp_path / "recording"))
    run = write_run(made, tmp_path / "run", inputs=run_inputs(made.robot, recording, None))
    body = made.robot.body
    state = solve_equilibrium(body, tension=dict.fromkeys(body.cable_names, 1.0))
    place = tuple(float(x) for x in made.robot.markers.positions(state.positions)[0])

    def tensions() -> np.ndarray:
        with stream_runs([run], StreamOptions(port=0, page=page)) as live:
            server = let_drag(live, run, DragOptions())
            answered = server.answer(made.robot.glued_names[0], place)
            while answered.status == "converging":
                answered = server.answer(made.robot.glued_names[0], place)
        return np.array([answered.inputs[name] for name in body.cable_names])

    from_zero = tensions()
    initial = dict.fromkeys(body.cable_names, 0.2)
    here, unknown = np.eye(4), np.zeros((6, 6))
    found = Calibration(here, (here,), ("",), initial, {}, 0.0, {}, (), here, unknown, initial, {}, "converged")
    write_calibration(found, run / "calibration.json")
    np.testing.assert_allclose(tensions(), from_zero - 0.2, atol=0.02)


def is_found(heard: dict[str, dict[str, object]]) -> bool:
    """Whether inputs for the wish are found: answers before that say that they converge."""
    return heard.get("reach", {}).get("status") in ("reached", "nearest")


@pytest.mark.parametrize("embedded", [True, False])
def test_commands_over_a_broker_that_lets_anybody_in_are_refused_unless_that_is_wanted(
    tmp_path: Path, page: Path, embedded: bool
) -> None:
    run, hub = write_run_with_mesh(tmp_path / "bar"), Hub()
    elsewhere = EmbeddedBroker(hub, port=0)
    way = {"broker_port": 0} if embedded else {"mqtt": f"127.0.0.1:{elsewhere.port}"}
    options = StreamOptions(port=0, page=page, commands=True, **way)
    with pytest.raises(InputError, match=r"lets anybody in[\s\S]*--insecure"):
        stream_runs([run], options)
    with stream_runs([run], replace(options, insecure=True)) as live:
        assert live.commands
    with stream_runs([run], replace(options, commands=False)) as live, pytest.raises(InputError, match="sends no commands"):
        let_drag(live, run, DragOptions(gate=GateOptions(allowed=True)))
    hub.close()


def test_sensors_say_where_the_dragged_marker_is(tmp_path: Path, page: Path) -> None:
    robot = write_block_robot(tmp_path / "robot")
    made = make_run(load_robot(robot))
    recording = load_recording(write_small_recording(tmp_path / "recording"))
    run = write_run(made, tmp_path / "run", inputs=run_inputs(made.robot, recording, None))
    marker, rest = made.robot.glued_names[0], made.robot.marker_points[0]
    network = linear_network(np.zeros(1), np.ones(1), np.array([[0.0], [0.0], [1e-3]]), rest)  # a millimetre up for each unit
    domain = learn_domain(np.random.default_rng(0).uniform(-2.0, 2.0, (300, 1)))
    chain = ProprioceptiveModel(("bend",), (marker,), network, (), domain, None, frame="robot")
    two = linear_network(np.zeros(1), np.ones(1), np.zeros((6, 1)), np.tile(rest, 2))
    turned = save_model(replace(chain, frame="markers"), tmp_path / "t.onnx")
    model, strange = (
        save_model(chain, tmp_path / "m.onnx"),
        save_model(replace(chain, marker_names=(marker, "other"), network=two), tmp_path / "o.onnx"),
    )
    readings = tmp_path / "sensors.csv"
    readings.write_text("time_s,bend\n0,1\n", encoding="utf-8")
    with stream_runs([run], StreamOptions(port=0, page=page)) as live:
        let_drag(live, run, DragOptions())
        hand = Hand(live.hub, robot=made.robot.name)
        with pytest.raises(InputError, match="markers that the robot does not have"):
            measure_by_sensors(live, str(readings), strange)
        with pytest.raises(InputError, match="not in the robot's frame"):
            measure_by_sensors(live, str(readings), turned)
        measure_by_sensors(live, str(readings), model)
        told: dict[str, object] = {}
        end = time.monotonic() + 20.0
        with readings.open("a", encoding="utf-8") as file:
            while time.monotonic() < end and "measured_error_m" not in told:
                file.write(f"{time.monotonic()},1\n")
                file.flush()
                hand.drag(rest + 2e-3 * np.eye(3)[2], armed=False, handle=marker)
                time.sleep(0.05)
                newest = live.hub.newest().get(f"femsense/{made.robot.name}/reach")
                told = {} if newest is None else json.loads(newest.payload)
            (said,) = json.loads(live.hub.newest()[f"femsense/{made.robot.name}/measured"].payload)["markers"]
            assert said["name"] == marker and said["position_m"]["z"] == pytest.approx(rest[2] + 1e-3, abs=1e-7)
            assert told["measured_error_m"] == pytest.approx(1e-3, abs=1e-6)
            file.write("1e9,50\n")  # never learnt: says no place, and why
            file.flush()
            time.sleep(0.2)
    unknown = json.loads(live.hub.newest()[f"femsense/{made.robot.name}/measured"].payload)
    assert unknown["markers"] == [] and unknown["detail"].startswith("bend = 50 is outside ")


def heeding_interrupts() -> None:
    """Heed SIGINT, which a shell has what it starts in the background ignore."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@contextmanager
def command_line(*arguments: str) -> Iterator[str]:
    """The address that a command says it serves; it ends when it is told to, without a traceback."""
    call = [sys.executable, "-m", "femsense", *arguments, "--json"]
    with subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as program:
        assert program.stdout is not None and program.stderr is not None
        text = ""
        while not text.endswith("\n}\n"):
            line = program.stdout.readline()
            assert line, program.stderr.read()
            text += line
        try:
            yield json.loads(text)["url"]
        finally:
            program.terminate()
            program.wait(20)
        said = program.stderr.read()
        assert program.returncode in (0, 130) and "Traceback" not in said
        assert said.startswith(("reading ", "connecting to "))  # at once, whatever takes long


def test_commands_that_name_nothing_or_too_much_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    from femsense.app.cli import run

    assert run(["stream"]) == 2 and "femsense: RUN: either a run or a live source" in capsys.readouterr().err
    assert run(["stream", "no-such-run"]) == 2 and "no states.npz" in capsys.readouterr().err
    assert (
        run(["stream", "no-such-run", "--sensors", "x.csv", "--model", "m.onnx"]) == 2
        and "femsense: RUN with --sensors: RUN with --sensors does nothing without --drag" in capsys.readouterr().err
    )
    for call, needs in (
        (["stream", "a-run", "--commands"], "--commands does nothing without --drag"),
        (["stream", "--sensors", "x.csv", "--model", "m.onnx", "--drag"], "--drag does nothing without RUN"),
        (["stream", "--sensors", "x.csv", "--model", "m.onnx", "--once"], "--once does nothing without RUN"),
        (["stream", "a-run", "--broker-port", "0"], "--broker-port does nothing without --broker"),
        (["stream", "a-run", "--mqtt", "box", "--authority", "ca.pem"], "--authority does nothing without --mqtt mqtts://"),
        (["view", "--stream", "http://127.0.0.1:1", "-o", "page"], "--output does nothing without RUN"),
        (["view", "a-run", "--password-file", "word"], "--password-file does nothing without --stream"),
        (
            ["view", "--stream", "http://127.0.0.1:1", "--authority", "ca.pem"],
            "--authority does nothing without --stream https://",
        ),
    ):
        assert run(call) == 2 and needs in capsys.readouterr().err
    assert run(["view"]) == 2 and "nothing to show" in capsys.readouterr().err
    assert run(["view", "a-run", "--stream", "http://127.0.0.1:1"]) == 2
    with pytest.raises(InputError):
        need_one([Path("x")], "udp://:1")
