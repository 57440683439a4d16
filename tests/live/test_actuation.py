"""Inputs at the time of a frame: interpolation, delay, and a source that is late, frozen or away."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from helpers import write_block_robot
from streams import within

from femsense.core.errors import InputError
from femsense.io.robot_toml import load_robot
from femsense.live.actuation import Actuation, ActuationLimits, FrameActuation, ReadActuation, columns_of, make_actuation
from femsense.live.events import Notice
from femsense.model.robot import Robot
from femsense.xr.stream.readings import Reading, Readings

COLUMNS = ("cable_top", "cable_side")


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("robot")))


def reader(rows: list[Reading], *, away: str = "", limits: ActuationLimits | None = None, paced: bool = False) -> ReadActuation:
    """Return an actuation that has read some rows, at once or at their own times; its source stays open."""
    stop, done = Event(), Event()
    readings = Readings(lambda row: row, stop, away=lambda: away)

    def send() -> None:
        before = rows[0][0] if rows else 0.0
        for row in rows:
            time.sleep(max(0.05, row[0] - before) if paced else 0.05)  # one at a time: only the newest is kept
            before = row[0]
            readings.hear(row)
        time.sleep(0.05)
        done.set()

    made = ReadActuation(COLUMNS, readings, stop, "udp://x", limits)
    Thread(target=send, daemon=True).start()
    assert done.wait(5.0)
    return made


def value(actuation: Actuation, taken_s: float) -> list[float]:
    found = actuation.at(taken_s)
    assert found is not None
    return found.tolist()


RAMP: list[Reading] = [(0.0, np.array([0.0, 10.0])), (0.4, np.array([4.0, 10.0]))]


def test_values_are_interpolated_at_the_time_of_the_frame() -> None:
    actuation = reader(RAMP, paced=True)
    middle = time.monotonic() - 0.2
    low, high = value(actuation, middle - 0.05), value(actuation, middle + 0.05)
    assert high[0] - low[0] == pytest.approx(1.0, abs=0.01) and low[1] == high[1] == 10.0
    assert value(actuation, middle + 5.0) == [4.0, 10.0] and value(actuation, middle - 5.0) == [0.0, 10.0]
    actuation.close()


def test_a_delay_takes_older_values() -> None:
    late = reader(RAMP, paced=True, limits=ActuationLimits(delay_s=0.3))
    now = time.monotonic()
    assert value(late, now - 0.05)[0] == pytest.approx(1.0, abs=0.5) and value(late, now + 0.3)[0] == pytest.approx(4.0, abs=0.3)
    late.close()


def test_a_channel_without_a_value_holds_its_last_one() -> None:
    actuation = reader([(0.0, np.array([1.0, np.nan])), (1.0, np.array([np.nan, 5.0]))])
    assert value(actuation, time.monotonic() + 9.0) == [1.0, 5.0]
    actuation.close()


def test_late_values_hold_and_are_said() -> None:
    actuation = reader([(0.0, np.array([1.0, 2.0]))])
    assert value(actuation, time.monotonic()) == [1.0, 2.0] and not actuation.notices()
    assert value(actuation, time.monotonic() + 3.0) == [1.0, 2.0]
    assert "older than the frame" in actuation.notices()[Notice.ACTUATION_LATE]
    actuation.close()


def test_a_sender_whose_clock_stands_still_is_said() -> None:
    actuation = reader([(5.0, np.array([1.0, 2.0]))] * 3, limits=ActuationLimits(late_s=0.05))
    assert within(5.0, lambda: Notice.ACTUATION_FROZEN in actuation.notices())
    assert "does not advance" in actuation.notices()[Notice.ACTUATION_FROZEN]
    actuation.close()


def test_a_source_that_is_away_is_said_and_its_last_values_hold() -> None:
    actuation = reader([(0.0, np.array([1.0, 2.0]))], away="unplugged")
    assert value(actuation, time.monotonic() + 60.0) == [1.0, 2.0]
    assert actuation.notices() == {Notice.ACTUATION_AWAY: "udp://x: unplugged; the last values hold"}
    actuation.close()


def test_a_sender_that_began_anew_is_followed() -> None:
    actuation = reader([(1000.0, np.array([1.0, 2.0])), (0.0, np.array([3.0, 4.0]))])
    assert value(actuation, time.monotonic() + 1.0) == [3.0, 4.0]
    actuation.close()


def test_nothing_is_known_before_the_first_value() -> None:
    actuation = reader([])
    assert actuation.at(0.0) is None
    actuation.close()


def test_inputs_come_by_udp(robot: Robot) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    actuation = make_actuation(f"udp://127.0.0.1:{port}", robot)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def sent() -> bool:
            sender.sendto(json.dumps({"cable_top": 1.5, "cable_side": 0.5}).encode(), ("127.0.0.1", port))
            return actuation.at(time.monotonic()) is not None

        assert within(10.0, sent)
    assert value(actuation, time.monotonic()) == [1.5, 0.5]
    actuation.close()


def test_inputs_come_by_websocket_also_after_the_server_was_away(robot: Robot) -> None:
    from websockets.sync.server import ServerConnection, serve

    def answer(connection: ServerConnection) -> None:
        connection.send(json.dumps({"cable_top": 2.0, "cable_side": 0.25}))
        connection.recv()

    with serve(answer, "127.0.0.1", 0) as first:
        port = first.socket.getsockname()[1]
    actuation = make_actuation(f"ws://127.0.0.1:{port}", robot)
    assert within(10.0, lambda: "no connection" in actuation.notices().get(Notice.ACTUATION_AWAY, ""))
    with serve(answer, "127.0.0.1", port) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        assert within(10.0, lambda: actuation.at(time.monotonic()) is not None)
        assert value(actuation, time.monotonic()) == [2.0, 0.25] and not actuation.notices()
        actuation.close()
        server.shutdown()


def test_inputs_come_from_a_file_that_grows(robot: Robot, tmp_path: Path) -> None:
    file = tmp_path / "inputs.csv"
    file.write_text("time_s,cable_side,cable_top\n0.0,0.1,0.2\n")
    actuation = make_actuation(str(file), robot)
    assert within(10.0, lambda: actuation.at(time.monotonic()) is not None)
    with file.open("a") as stream:
        stream.write("0.1,0.3,0.4\n")
    assert within(10.0, lambda: value(actuation, time.monotonic() + 10.0) == [0.4, 0.3])
    actuation.close()


def test_fixed_inputs_are_named_as_the_cables_are(robot: Robot) -> None:
    assert columns_of(robot) == COLUMNS
    actuation = make_actuation("fixed:side=0.5,cable_top=2", robot)
    assert value(actuation, 0.0) == [2.0, 0.5] and not actuation.notices()
    assert value(make_actuation("fixed", robot), 0.0) == [0.0, 0.0]
    with pytest.raises(InputError, match="no such input"):
        make_actuation("fixed:tip=1", robot)
    with pytest.raises(InputError, match="not a number"):
        make_actuation("fixed:top=much", robot)


def test_frames_bring_their_inputs_or_it_is_said_which_are_missing() -> None:
    actuation = FrameActuation(COLUMNS)
    assert actuation.of({"cable_side": 1.0, "cable_top": 2.0, "more": 3.0}, "camera").tolist() == [2.0, 1.0]
    with pytest.raises(InputError, match="--actuation SOURCE"):
        actuation.of({"cable_top": 2.0}, "camera")


@pytest.mark.parametrize("first", [[1.0, 2.0], [1.0, np.nan]])
def test_an_input_that_is_missing_in_the_messages_is_named(first: list[float]) -> None:
    """Misspelt from the start, or from some message on: the others go on arriving."""
    limits = ActuationLimits(late_s=0.2)
    rows: list[Reading] = [(0.1 * k, np.array(first if k == 0 else [1.0 + k, np.nan])) for k in range(8)]
    actuation = reader(rows, limits=limits, paced=True)
    told = actuation.notices()
    assert list(told) == [Notice.ACTUATION_LATE]
    assert "without cable_side" in told[Notice.ACTUATION_LATE] and "need cable_top, cable_side" in told[Notice.ACTUATION_LATE]
    assert (actuation.at(time.monotonic()) is None) == bool(np.isnan(first[1]))
    actuation.close()
