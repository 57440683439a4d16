"""From readings to bones, live: a file that grows, UDP, MQTT, a serial line; and the tube that shows them."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from streams import within

from femsense.core.errors import InputError
from femsense.xr.armature import ArmatureOptions, make_armature
from femsense.xr.glb_reader import read_glb
from femsense.xr.proprioception.domain import learn_domain
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.proprioception.network import linear_network
from femsense.xr.skinning import skin_vertices
from femsense.xr.stream.payloads import model_bytes
from femsense.xr.stream.readings import Reading, read_line, readings_of
from femsense.xr.stream.sensor_source import frames_of_sensors, markers_of_sensors, sensor_twin
from femsense.xr.user_skin import UserSkin

CHANNELS = ("bend", "sway")
REST = np.outer(np.linspace(0, 0.1, 5), [0, 0, 1.0])


@pytest.fixture(scope="module")
def model() -> ProprioceptiveModel:
    """Markers on a line; the readings shift each by its height times the reading, along x and y."""
    return line_model(np.eye(3))


def line_model(R: np.ndarray) -> ProprioceptiveModel:
    """The same, all of it turned."""
    C = np.zeros((5, 3, 2))
    C[:, 0, 0], C[:, 1, 1] = REST[:, 2], REST[:, 2]
    domain = learn_domain(np.random.default_rng(0).uniform(-0.5, 0.5, (300, 2)))
    rest = REST @ R.T
    network = linear_network(np.zeros(2), np.ones(2), np.einsum("ij,mjk->mik", R, C).reshape(15, 2), rest.ravel())
    return ProprioceptiveModel(CHANNELS, tuple("abcde"), network, (), domain, make_armature(rest, ArmatureOptions(bones=6)))


def take(source: str, count: int, send: object) -> list[Reading]:
    """The first readings of a source while something is sent to it again and again."""
    stop, found = Event(), []
    readings = readings_of(source, CHANNELS, stop)

    def keep_sending() -> None:
        while not stop.wait(0.02):
            send()  # type: ignore[operator]

    Thread(target=keep_sending, daemon=True).start()
    for reading in readings:
        found.append(reading)
        if len(found) == count:
            stop.set()
            break
    return found


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        (b'{"time_s": 2.5, "sway": 2, "bend": 1}\r\n', (2.5, [1, 2])),
        (b"2.5,1,2", (2.5, [1, 2])),
        (b'{"bend": "x", "sway": 2, "time_s": 2.5}', (2.5, [np.nan, 2])),
        (b'{"bend": 1e400, "sway": 2, "time_s": 2.5}', (2.5, [np.nan, 2])),
        (b"1;2", (None, [1, 2])),
        (b"2.5,1,", (2.5, [1, np.nan])),
        (b"nan,2", (None, [np.nan, 2])),
        (b"2.5,1,x", None),
        (b"[1, 2, 3, 4]", None),
        (b'{"bend": [1, 2], "sway": 2}', None),
        (b'{"bend": true, "sway": 2}', None),
        (b'{"bend": null, "sway": NaN}', None),
        (b"1e400,nan", None),
        (b"", None),
        (b"1,2,3,4", None),
        (b"{broken", None),
        (b"[1, 2]", None),
        (b'{"other": 1}', None),
        (b"\xff\xfe", None),
    ],
)
def test_lines_are_readings_or_nothing(line: bytes, wanted: tuple[float | None, list[float]] | None) -> None:
    found = read_line(line, CHANNELS)
    if wanted is None:
        assert found is None
        return
    assert found is not None
    np.testing.assert_array_equal(found[1], wanted[1])
    assert found[0] == wanted[0] or wanted[0] is None


def test_a_file_that_grows_is_followed_from_its_end_and_again_when_it_starts_anew(tmp_path: Path) -> None:
    file = tmp_path / "sensors.csv"
    head = "time_s,frame,sway,bend\n"
    file.write_text(head + "0,0,1,2\n1,1,3,4\n", encoding="utf-8")
    stop = Event()
    readings = readings_of(str(file), CHANNELS, stop)
    assert next(readings)[1].tolist() == [4, 3]
    with file.open("a", encoding="utf-8") as stream:
        stream.write("2,2,5,")
        stream.flush()
        Thread(target=lambda: (time.sleep(0.05), stream.write("6\n"), stream.flush())).start()
        assert next(readings)[1].tolist() == [6, 5]
        time.sleep(0.05)
    file.write_text(head + "9,0,7,8\n", encoding="utf-8")
    assert next(readings)[0] == 9.0
    stop.set()
    (tmp_path / "other.csv").write_text("time_s,bend\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"channels are missing[\s\S]*sway"):
        readings_of(str(tmp_path / "other.csv"), CHANNELS, Event())


def test_a_file_that_is_not_there_yet_is_waited_for_and_says_what_it_lacks(tmp_path: Path) -> None:
    file, stop, found = tmp_path / "sensors.csv", Event(), []
    readings = readings_of(str(file), CHANNELS, stop)
    assert readings.away == readings.trouble == "there is no such file yet"
    Thread(target=lambda: found.extend(readings), daemon=True).start()
    for text, away in (
        ("", "it is empty yet"),
        ("time_s,bend\n1,2\n", "channels are missing: sway"),
        ("time_s,be", "it is empty yet"),
        ("time_s,bend,sway\n0,8,9\n1,2,3\n", ""),
    ):
        file.write_text(text, encoding="utf-8")
        assert within(3.0, lambda away=away: readings.away == away)
    assert within(3.0, lambda: bool(found)) and found[0][0] == 1.0 and found[0][1].tolist() == [2, 3]
    stop.set()


def test_of_a_long_file_the_last_row_is_shown(tmp_path: Path) -> None:
    file = tmp_path / "sensors.csv"
    file.write_text("time_s,bend,sway\n" + "".join(f"{k},{k},{2 * k}\n" for k in range(200_000)), encoding="utf-8")
    assert next(readings_of(str(file), CHANNELS, Event()))[0] == 199_999.0


def test_a_time_that_is_not_said_counts_from_the_beginning(tmp_path: Path) -> None:
    file = tmp_path / "sensors.csv"
    file.write_text("bend,sway\n1,2\n", encoding="utf-8")
    readings = readings_of(str(file), CHANNELS, Event())
    assert 0.0 <= next(readings)[0] < 60.0


def test_datagrams_are_readings() -> None:
    port = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        found = take(f"udp://127.0.0.1:{port}", 2, lambda: out.sendto(b'{"bend": 1, "sway": 2}', ("127.0.0.1", port)))
    assert [row.tolist() for _, row in found] == [[1, 2], [1, 2]] and found[1][0] > found[0][0]


def test_of_a_flood_the_newest_reading_is_taken_and_the_others_are_counted() -> None:
    port, stop = free_udp_port(), Event()
    readings = readings_of(f"udp://127.0.0.1:{port}", CHANNELS, stop)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for k in range(200):
            out.sendto(f"{k / 500},{k},0".encode(), ("127.0.0.1", port))
            time.sleep(0.0005)
    assert within(3.0, lambda: readings.dropped == 199)
    assert next(readings)[1].tolist() == [199, 0]
    found: list[Reading] = []
    Thread(target=lambda: found.extend(readings), daemon=True).start()
    time.sleep(0.3)
    assert found == [] and readings.trouble == ""  # nothing waits behind the last one
    stop.set()


@pytest.mark.parametrize("date", [True, False])
def test_a_reading_is_as_old_as_its_sender_says(date: bool) -> None:
    port, stop = free_udp_port(), Event()
    readings = readings_of(f"udp://127.0.0.1:{port}", CHANNELS, stop)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:

        def age_of(age_s: float) -> float:
            made = (time.time() if date else time.monotonic()) - age_s
            out.sendto(f"{made!r},1,2".encode(), ("127.0.0.1", port))
            next(readings)
            return time.monotonic() - readings.came

        assert age_of(4.0) >= (4.0 if date else 0.0)  # of a clock that counts from anywhere, delays are known but for their least
        assert age_of(0.0) < 2.0
        time.sleep(1.0)
        assert 0.8 <= age_of(0.9) < 2.0
        assert age_of(-50.0) < 1.0 and age_of(0.0) < 1.0  # its clock was set
    stop.set()


def test_a_reading_that_was_overtaken_on_its_way_is_dropped() -> None:
    port, stop = free_udp_port(), Event()
    readings = readings_of(f"udp://127.0.0.1:{port}", CHANNELS, stop)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        for line in (b"5.0,1,1", b"5.2,2,2", b"5.1,3,3"):
            out.sendto(line, ("127.0.0.1", port))
    assert within(3.0, lambda: readings.overtaken == 1) and readings.dropped == 2
    assert next(readings)[0] == 5.2
    stop.set()


def test_frames_of_a_websocket_are_readings_and_it_is_found_again() -> None:
    server = pytest.importorskip("websockets.sync.server")
    port = free_udp_port()
    stop = Event()
    readings = readings_of(f"ws://127.0.0.1:{port}/sensors", CHANNELS, stop)
    assert within(3.0, lambda: "Connection refused" in readings.trouble)
    for value in (1, 2):

        def answer(connection: Any, value: int = value) -> None:
            connection.send(json.dumps({"bend": value, "sway": 0}))
            connection.send(f"{value},5".encode())
            time.sleep(0.3)

        with server.serve(answer, "127.0.0.1", port) as serving:
            Thread(target=serving.serve_forever, daemon=True).start()
            while next(readings)[1].tolist() != [value, 5]:
                pass
            serving.shutdown()
    stop.set()


def test_messages_of_a_broker_are_readings() -> None:
    pytest.importorskip("amqtt")
    from femsense.xr.stream.hub import Hub, Message
    from femsense.xr.stream.mqtt import EmbeddedBroker

    hub = Hub()
    broker = EmbeddedBroker(hub, port=0)
    message = Message("lab/arm/sensors", json.dumps({"bend": 1, "sway": 2, "time_s": 7}).encode())
    found = take(f"mqtt://127.0.0.1:{broker.port}/lab/arm/sensors", 1, lambda: hub.publish([message]))
    hub.close()
    assert found[0][0] == 7.0 and found[0][1].tolist() == [1, 2]


def test_a_serial_line_is_read_line_by_line() -> None:
    pytest.importorskip("serial")
    pty = pytest.importorskip("pty")
    ours, theirs = pty.openpty()
    parts: Iterator[bytes] = iter([b"garb", b"age\n1,", b"2\n", *[b"3,4\n"] * 100])
    found = take(f"serial:{os.ttyname(theirs)}?baud=9600", 2, lambda: os.write(ours, next(parts)))
    assert [row.tolist() for _, row in found] == [[1, 2], [3, 4]]


def test_a_serial_line_that_was_unplugged_comes_back(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    pty = pytest.importorskip("pty")
    port, stop = tmp_path / "port", Event()
    first, theirs = pty.openpty()
    port.symlink_to(os.ttyname(theirs))
    readings = readings_of(f"serial:{port}", CHANNELS, stop)
    os.write(first, b"1,2\n")
    assert next(readings)[1].tolist() == [1, 2]
    os.close(theirs)
    os.close(first)
    port.unlink()
    found: list[tuple[float, np.ndarray]] = []
    Thread(target=lambda: found.append(next(readings)), daemon=True).start()
    assert within(5.0, lambda: readings.trouble == "unplugged")
    time.sleep(0.5)  # it is asked for again and again meanwhile
    second, theirs = pty.openpty()
    port.symlink_to(os.ttyname(theirs))

    def keep_sending() -> None:
        while not stop.wait(0.05):
            os.write(second, b"3,4\n")

    Thread(target=keep_sending, daemon=True).start()
    assert within(5.0, lambda: bool(found)) and found[0][1].tolist() == [3, 4]
    stop.set()


def test_a_serial_port_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    pty = pytest.importorskip("pty")
    port, stop = tmp_path / "port", Event()
    readings, found = readings_of(f"serial:{port}", CHANNELS, stop), []
    assert readings.away == readings.trouble == "there is no such port yet"
    Thread(target=lambda: found.append(next(readings)), daemon=True).start()
    time.sleep(0.2)
    ours, theirs = pty.openpty()
    port.symlink_to(os.ttyname(theirs))
    assert within(5.0, lambda: readings.away == "")
    os.write(ours, b"1,2\n")
    assert within(5.0, lambda: bool(found)) and found[0][1].tolist() == [1, 2]
    stop.set()


def test_a_row_that_stood_in_a_file_is_as_old_as_the_file_and_one_that_is_added_is_new(tmp_path: Path) -> None:
    file, stop = tmp_path / "sensors.csv", Event()
    file.write_text("time_s,bend,sway\n0,1,2\n", encoding="utf-8")
    os.utime(file, (time.time() - 100.0,) * 2)
    readings = readings_of(str(file), CHANNELS, stop)
    next(readings)
    assert 100.0 <= time.monotonic() - readings.came < 110.0 and readings.trouble == "they stopped"
    adding = Thread(target=lambda: (time.sleep(0.2), file.open("a", encoding="utf-8").write("1,3,4\n")))
    adding.start()
    assert next(readings)[1].tolist() == [3, 4] and time.monotonic() - readings.came < 5.0
    assert readings.trouble == ""
    adding.join()


def test_markers_of_a_row_that_is_old_say_nothing(model: ProprioceptiveModel, tmp_path: Path) -> None:
    file, stop, found = tmp_path / "sensors.csv", Event(), []
    file.write_text("time_s,bend,sway\n0,0.1,0.2\n", encoding="utf-8")
    os.utime(file, (time.time() - 100.0,) * 2)
    Thread(target=lambda: found.extend(markers_of_sensors(readings_of(str(file), CHANNELS, stop), model)), daemon=True).start()
    time.sleep(0.3)
    with file.open("a", encoding="utf-8") as stream:
        stream.write("1,0.3,0.4\n")
    assert within(5.0, lambda: bool(found)) and [at for at, *_ in found] == [1.0]
    stop.set()


def test_a_file_that_is_replaced_is_read_anew(tmp_path: Path) -> None:
    file, newer = tmp_path / "sensors.csv", tmp_path / "newer.csv"
    file.write_text("time_s,bend,sway\n0,1,2\n", encoding="utf-8")
    stop = Event()
    readings = readings_of(str(file), CHANNELS, stop)
    assert next(readings)[1].tolist() == [1, 2]
    newer.write_text("time_s,bend,sway\n" + "5,3,4\n" * 9, encoding="utf-8")
    file.unlink()

    def replace_later() -> None:
        time.sleep(0.05)
        newer.rename(file)

    Thread(target=replace_later).start()
    assert next(readings)[1].tolist() == [3, 4]


@pytest.mark.parametrize(
    "source",
    [
        "no-such-folder/no-such.csv",
        ".",
        "udp://127.0.0.1:99999",
        "udp://127.0.0.1",
        "mqtt://host",
        "serial:/dev/no-such-port?baud=fast",
        "ftp://x",
    ],
)
def test_what_is_no_source_is_refused_at_once(source: str) -> None:
    with pytest.raises(InputError):
        readings_of(source, CHANNELS, Event())


def test_the_tube_bends_as_the_markers_do(model: ProprioceptiveModel, tmp_path: Path) -> None:
    twin = sensor_twin(model, "arm")
    assert (twin.frame, sensor_twin(replace(model, frame="robot"), "arm").frame) == ("markers", "robot")
    mesh = read_glb(twin.glb)
    radius = np.linalg.norm(mesh.skin.rest[:, :2], axis=1)
    assert np.ptp(radius[radius > 1e-6]) < 1e-6 and (radius < 1e-6).sum() == 2
    assert mesh.skin.rest[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert mesh.skin.rest[:, 2].max() == pytest.approx(0.1, abs=1e-6)
    file = tmp_path / "sensors.csv"
    file.write_text("time_s,bend,sway\n0,0,0\n", encoding="utf-8")
    with file.open("a", encoding="utf-8") as stream:
        frames = frames_of_sensors(readings_of(str(file), CHANNELS, Event()), model)
        still = next(frames)
        stream.write("1,0.4,-0.2\n")
        stream.flush()
        bent = next(frames)
        stream.write("2,9,0\n")
        stream.flush()
        odd = next(frames)
        stream.write("3,,0\n")
        stream.flush()
        blind = next(frames)
    np.testing.assert_allclose(still.bones[:, :3], twin.T_robot_bone[:, :3, 3], atol=1e-7)
    np.testing.assert_allclose(still.bones[:, 3:], np.tile([0, 0, 0, 1.0], (6, 1)), atol=1e-6)
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(bent.bones[:, 3:]).as_matrix(), bent.bones[:, :3]
    top = np.argmax(mesh.skin.rest[:, 2] - radius)  # the middle of the upper end
    ends = skin_vertices(mesh.skin, T[None])[0][top]
    np.testing.assert_allclose(ends[:2] / ends[2], [0.4, -0.2], atol=1e-3)  # on the line that the markers are on
    assert bent.contacts is None and bent.status == "ok" and "bend = 9" in odd.status and "no number" in blind.status
    np.testing.assert_array_equal(blind.bones, odd.bones)
    assert still.read_at < bent.read_at < odd.read_at == blind.read_at  # what is blind shows what was read before


def test_the_robot_s_own_skin_bends_as_the_markers_do_and_elsewhere_it_is_refused(
    model: ProprioceptiveModel, tmp_path: Path
) -> None:
    height = np.linspace(0.0, 0.1, 21)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * 0.01
    rest = np.concatenate([np.column_stack([corners, np.full(4, z)]) for z in height])
    red = np.tile([1.0, 0.0, 0.0], (len(rest), 1))
    worn = UserSkin(rest, np.array([[i, i + 1, i + 4] for i in range(len(rest) - 4)]), red)
    twin = sensor_twin(replace(model, report={"error_mm": 2.5}), "arm", worn)
    mesh = read_glb(twin.glb)
    np.testing.assert_allclose(mesh.skin.rest, rest, atol=1e-7)
    told = json.loads(model_bytes(twin, "robots/arm.glb"))
    assert told["error_m"] == 2.5e-3 and [marker["name"] for marker in told["markers"]] == list("abcde")
    file = tmp_path / "sensors.csv"
    file.write_text("time_s,bend,sway\n0,0.2,0.1\n", encoding="utf-8")
    bones = next(frames_of_sensors(readings_of(str(file), CHANNELS, Event()), model)).bones
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(bones[:, 3:]).as_matrix(), bones[:, :3]
    middle = skin_vertices(mesh.skin, T[None])[0].reshape(21, 4, 3).mean(axis=1)
    np.testing.assert_allclose(
        middle[:, :2], np.outer(middle[:, 2], [0.2, 0.1]), atol=1e-4
    )  # on the line that the markers are on
    for wrong in (replace(worn, rest=1000.0 * rest), replace(worn, rest=np.add(rest, [0.0, 0.2, 0.0]))):
        with pytest.raises(InputError, match="the skin is not at the model's bones"):
            sensor_twin(model, "arm", wrong)


def test_bones_of_a_lying_body_have_the_axes_of_the_robot_at_rest(tmp_path: Path) -> None:
    R = Rotation.from_euler("yz", [90, 30], degrees=True).as_matrix()
    file, lying = tmp_path / "sensors.csv", line_model(R)
    file.write_text("time_s,bend,sway\n0,0.4,-0.2\n", encoding="utf-8")
    bent = next(frames_of_sensors(readings_of(str(file), CHANNELS, Event()), lying)).bones
    axis = Rotation.from_quat(bent[-1, 3:]).as_matrix() @ R[:, 2]  # along the body at rest
    np.testing.assert_allclose(axis, R @ (np.array([0.4, -0.2, 1.0]) / np.sqrt(1.2)), atol=1e-3)


def test_triangles_of_the_tube_look_outward(model: ProprioceptiveModel) -> None:
    from femsense.xr.stream.sensor_source import tube_around

    rest = model.rest_bones
    points, triangles = tube_around(rest.positions, rest.T_robot_bone[:, :3, :2])
    a, b, c = (points[triangles[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    n = 20
    assert volume == pytest.approx(
        0.5 * n * np.sin(2 * np.pi / n) * np.linalg.norm(points[:, :2], axis=1).max() ** 2 * 0.1, rel=1e-6
    )


def test_a_source_without_readings_says_why() -> None:
    stop = Event()
    nowhere = readings_of("mqtt://me:secret@127.0.0.1:1/arm", CHANNELS, stop)
    assert within(3.0, lambda: "no connection" in nowhere.trouble) and "secret" not in nowhere.trouble
    stop.set()
    assert list(nowhere) == []


def test_a_line_that_is_no_reading_is_shown_until_one_is() -> None:
    port = free_udp_port()
    readings, found = readings_of(f"udp://127.0.0.1:{port}", CHANNELS, Event()), []
    assert readings.trouble == "nothing has come yet"
    Thread(target=lambda: found.append(next(readings)), daemon=True).start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for line, said in (
            (b"1,2,3,4,5,6,7,8,9", "what comes is no reading of its channels, first '1,2,3,4,5,6,7,8,9'"),
            (b"1,2", ""),
        ):
            sender.sendto(line, ("127.0.0.1", port))
            assert within(3.0, lambda said=said: readings.trouble == said)
    assert within(3.0, lambda: bool(found)) and found[0][1].tolist() == [1.0, 2.0]
    assert readings.passed == 1 and "first '1,2,3,4,5,6,7,8,9'" in readings.refused


def test_what_is_no_reading_among_readings_is_counted(tmp_path: Path) -> None:
    file, stop = tmp_path / "sensors.csv", Event()
    file.write_text("time_s,bend,sway\n0,1,2\n", encoding="utf-8")
    readings = readings_of(str(file), CHANNELS, stop)
    assert next(readings)[0] == 0.0
    with file.open("a", encoding="utf-8") as stream:
        stream.write("1,x,y\n\n2,nan,\n3,3,4\n")  # a blank line is none
    assert next(readings)[0] == 3.0
    assert readings.passed == 2 and "'bend': 'x'" in readings.refused
