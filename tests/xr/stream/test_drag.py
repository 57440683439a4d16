"""From a dragged point to the robot: off until armed, slow, within limits, gone when nobody holds; and the tip arrives."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from analytic import bar_body
from hand import Hand
from helpers import block_mesh
from obedient import ObedientRobot
from streams import bones_of, documented, names_in, within

import femsense as fs
from femsense.fem.mesh import embed_points, surface_triangles, to_quadratic
from femsense.model.effects import apply_effects
from femsense.model.robot import Observation, Robot, plain_actuation
from femsense.xr.skinning import fit_skin
from femsense.xr.stream.command_gate import CommandGate, GateOptions
from femsense.xr.stream.drag_server import DragOptions, DragServer, drive_inputs, handles_of
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import Input, inputs_bytes
from femsense.xr.stream.tip_feedback import FeedbackOptions, TipFeedback

TIP = np.array([[0.1, 0.015, 0.03], [0.1, 0.0, 0.015]])
INPUTS = (Input("top", "N", 0.0, 4.0), Input("side", "N", 0.5, 2.5))


def bar(cells: tuple[int, int, int]) -> Robot:
    """A bar with two cables, pulled up and aside, and two markers at its end."""
    body = bar_body(to_quadratic(block_mesh(cells)))
    ties = embed_points(body.mesh, TIP)
    none = np.zeros(0, np.int64)
    return Robot("bar", body, ("tip", "side"), TIP, ties, none, None, plain_actuation(2), Observation())


# ---- the gate


def test_nothing_goes_out_unless_it_is_allowed_armed_and_held() -> None:
    for allowed, armed in ((False, True), (True, False), (False, False)):
        gate = CommandGate(INPUTS, GateOptions(allowed=allowed))
        gate.hold(0.0, armed=armed)
        gate.want({"top": 1.0, "side": 1.0})
        assert gate.step(0.1, {}) is None and not gate.moving


def test_inputs_move_slowly_from_where_they_are_and_stay_within_their_range() -> None:
    gate = CommandGate(INPUTS, GateOptions(allowed=True, range_per_s=0.25))
    gate.want({"top": 99.0, "side": -99.0})
    seen = []
    for k in range(500):
        gate.hold(0.02 * k, armed=True)
        seen.append(gate.step(0.02 * k, {"top": 1.0, "side": 2.0}))
    top, side = (np.array([s[name] for s in seen if s]) for name in ("top", "side"))
    assert top[0] == 1.0 and side[0] == 2.0
    assert np.abs(np.diff(top)).max() <= 0.25 * 4.0 * 0.02 + 1e-12 and np.abs(np.diff(side)).max() <= 0.25 * 2.0 * 0.02 + 1e-12
    assert top[-1] == 4.0 and side[-1] == 0.5


def test_commands_end_when_nobody_holds_on_and_begin_where_the_robot_is() -> None:
    gate = CommandGate(INPUTS, GateOptions(allowed=True, hold_s=0.25))
    gate.hold(0.0, armed=True)
    gate.want({"top": 4.0, "side": 0.5})
    assert gate.step(0.2, {"top": 1.0}) is not None and gate.step(0.26, {}) is None and not gate.moving
    gate.hold(5.0, armed=True)
    again = gate.step(5.0, {"top": 0.3})
    assert again is not None and again["top"] == 0.3
    gate.release()
    assert gate.step(5.01, {}) is None and not gate.moving


@pytest.mark.parametrize("seed", range(4))
def test_commands_never_jump_whatever_the_lapse_and_wherever_the_target_went(seed: int) -> None:
    rng = np.random.default_rng(seed)
    gate, now, sent = CommandGate(INPUTS, GateOptions(allowed=True, range_per_s=0.25, hold_s=0.25)), 0.0, []
    for _ in range(60):
        lapse = rng.choice([0.0, 0.03, 0.3, 7.0])  # let go and taken again, a page that stalls, a connection that is lost
        if rng.random() < 0.5:
            gate.release()
        now += lapse
        sent += [[out["top"], out["side"]] for out in [gate.step(now, {})] if out]
        gate.want({"top": rng.choice([0.0, 4.0]), "side": rng.choice([0.5, 2.5])})  # rest is among them
        for _ in range(rng.integers(1, 60)):
            now += rng.choice([0.004, 0.02, 0.2])  # a thread that is held up makes nothing up for
            gate.hold(now, armed=True)
            out = gate.step(now, {})
            assert out is not None
            sent.append([out["top"], out["side"]])
    jumps = np.abs(np.diff(sent, axis=0)).max(axis=0)
    assert (jumps <= 0.25 * np.array([4.0, 2.0]) * 0.02 + 1e-12).all(), jumps
    assert (np.ptp(sent, axis=0) > [1.0, 0.5]).all()


def test_what_was_found_for_an_earlier_turn_moves_nothing() -> None:
    gate = CommandGate(INPUTS, GateOptions(allowed=True))
    gate.hold(0.0, armed=True)
    turn = gate.turn
    gate.release()
    gate.hold(0.1, armed=True)
    gate.want({"top": 4.0, "side": 2.5}, turn=turn)
    assert gate.step(0.1, {}) is None
    gate.want({"top": 4.0, "side": 2.5}, turn=gate.turn)
    assert gate.step(0.1, {}) == {"top": 0.0, "side": 0.5}


# ---- the server


@pytest.fixture
def served() -> Iterator[tuple[Hub, DragServer, ObedientRobot]]:
    """A model of few elements, and a robot of others that obeys it."""
    robot, hub = bar((4, 1, 1)), Hub()
    mesh = robot.body.mesh
    used = np.unique(surface_triangles(mesh))
    skin = fit_skin(mesh.nodes[used], mesh.nodes[used][None], bones=4)
    gate = GateOptions(allowed=True, range_per_s=1.0, hold_s=0.3)
    server = DragServer(hub, robot, skin, name="bar", options=DragOptions(gate=gate))
    there = ObedientRobot(hub, bar((6, 2, 2)), "bar", drive_inputs(robot))
    yield hub, server, there
    server.close()


@pytest.fixture
def alone() -> Iterator[tuple[Hub, DragServer]]:
    """A model that is dragged, an equilibrium an answer, and no robot that says where it is."""
    robot, hub = bar((4, 1, 1)), Hub()
    nodes = robot.body.mesh.nodes[np.unique(surface_triangles(robot.body.mesh))]
    skin = fit_skin(nodes, nodes[None], bones=4)
    server = DragServer(hub, robot, skin, name="bar", options=DragOptions(gate=GateOptions(allowed=True), answer_s=0.0))
    yield hub, server
    server.close()


class Commands:
    """A sink that keeps the inputs that were commanded, and says now and then that the robot is elsewhere, as a run that plays."""

    def __init__(self, hub: Hub, server: DragServer) -> None:
        self.hub, self.server, self.sent = hub, server, []
        self.numbers: list[int] = []
        hub.attach(self)

    def send(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            told = json.loads(message.payload) if message.topic == "femsense/bar/command" else {}
            self.numbers += [told["header"]["seq"]] if told else []
            if told.get("armed"):
                self.sent.append([row["value"] for row in told["inputs"]])

    def play(self, *values: float) -> None:
        """Say what a run says that plays."""
        inputs = inputs_bytes(0, 0.0, self.server.gate.inputs, values)
        self.hub.publish([Message("femsense/bar/inputs", inputs)])

    def farthest(self) -> float:
        """How far one command was from the one before, as a share of what the rate allows."""
        gate = self.server.gate
        most = gate.options.range_per_s * np.array([one.high - one.low for one in gate.inputs]) / gate.options.command_hz
        return float((np.abs(np.diff(self.sent, axis=0)) / most).max())

    def close(self) -> None:
        pass


def hold(hub: Hub, out: Commands, target: Any, *, said: bytes = b"", who: str = "me") -> None:
    """Hold a point until twenty more commands have gone out; the robot says something beside."""
    end, count = time.monotonic() + 30.0, len(out.sent)
    while time.monotonic() < end and len(out.sent) < count + 20:
        drag(hub, target, who=who)
        if said:
            hub.received(Message("femsense/bar/measured", said), "the robot")
        time.sleep(0.03)
    assert len(out.sent) >= count + 20


def drag(hub: Hub, target: Any, *, armed: bool = True, held: bool = True, who: str = "me", handle: str = "tip") -> None:
    hand_of(hub, who).drag(target, armed=armed, held=held, handle=handle)


def hand_of(hub: Hub, who: str = "me") -> Hand:
    """The one hand of somebody at a hub."""
    hands: dict[str, Hand] = hub.__dict__.setdefault("hands of this test", {})
    if who not in hands:
        hands[who] = Hand(hub, who)
    return hands[who]


def reach_of(hub: Hub) -> dict[str, Any]:
    message = hub.newest().get("femsense/bar/reach")
    return {} if message is None else json.loads(message.payload)


def answers(hub: Hub) -> list[dict[str, Any]]:
    """A list that fills with what is answered."""
    told: list[dict[str, Any]] = []

    class Sink:
        def send(self, messages: tuple[Message, ...]) -> None:
            told.extend(json.loads(message.payload) for message in messages if message.topic == "femsense/bar/reach")

        def close(self) -> None:
            pass

    hub.attach(Sink())
    return told


def target_of(robot: Robot, tension: dict[str, float]) -> np.ndarray:
    return robot.markers.positions(fs.solve_equilibrium(robot.body, tension=tension).positions)[0]


def test_the_tip_of_another_mesh_arrives_and_stops_when_let_go(served: tuple[Hub, DragServer, ObedientRobot]) -> None:
    hub, server, there = served
    names = server.robot.body.cable_names
    wanted = target_of(server.robot, dict(zip(names, (1.5, 0.6))))
    end = time.monotonic() + 20.0  # kernels may be compiled first
    while time.monotonic() < end and abs(there.inputs[names[0]] - 1.5) > 2e-2:
        drag(hub, wanted)
        time.sleep(0.03)
    away = np.linalg.norm(wanted - server.robot.markers.positions(server.robot.body.mesh.nodes)[0])
    missed = np.linalg.norm(there.place(0) - wanted)
    assert away > 0.02 and missed < 0.15 * away  # its mesh has other elements, and the model is not told
    told = reach_of(hub)
    assert told["status"] == "reached" and told["error_m"] <= 1e-4
    assert names_in({**told, "measured_error_m": 0.0}) == names_in(documented("reach"))
    assert json.loads(hub.newest()["femsense/bar/command"].payload).keys() == documented("command").keys()
    assert len(bones_of(hub.newest()["femsense/bar/ghost"].payload)) == 4
    assert within(2.0, lambda: not there.armed)  # nobody holds on any more
    count = len(there.heard)
    time.sleep(0.2)
    assert len(there.heard) == count


@pytest.mark.parametrize("post", [None, (np.array([0.05, 0.015, 0.03]), 0.0325)])
def test_what_is_measured_brings_the_tip_home_though_law_mesh_and_contact_are_unknown(
    served: tuple[Hub, DragServer, ObedientRobot], post: tuple[np.ndarray, float] | None
) -> None:
    hub, server, _ = served
    other = apply_effects(bar((6, 2, 2)), [{"name": "hyperelastic", "law": "neo_hookean"}, {"name": "stiffness", "scale": 1.15}])
    real = ObedientRobot(hub, other, "bar", drive_inputs(server.robot), post=post)
    names = server.robot.body.cable_names
    real.inputs = dict(zip(names, (1.5, 0.6)))  # somewhere that two cables can bring it, past the post too
    wanted = real.place(0)
    assert np.linalg.norm(wanted - target_of(server.robot, real.inputs)) > 3e-3
    real.inputs = dict.fromkeys(names, 0.0)
    missed: list[float] = []
    end = time.monotonic() + 20.0
    while time.monotonic() < end and not (len(missed) > 10 and max(missed[-3:]) < 5e-4):
        drag(hub, wanted)
        time.sleep(0.03)
        real.report(("tip", "side"))
        missed.append(float(np.linalg.norm(real.place(0) - wanted)))
    assert max(missed[-3:]) < 1e-3 and max(missed) > 0.01
    assert reach_of(hub)["correction_m"] > 1e-3 and reach_of(hub)["measured_error_m"] < 2e-3
    assert (real.pushed_n > 0.02) == (post is not None)
    assert all(one.low <= heard[one.name] <= one.high for _, heard in real.heard for one in server.gate.inputs)
    drag(hub, wanted, held=False)
    assert within(2.0, lambda: not real.armed) and not server.feedback.correction_m.any()


def test_a_correction_is_bounded_waits_for_the_robot_and_forgets() -> None:
    feedback, wanted = TipFeedback(0.1, FeedbackOptions(time_s=0.3, most_share=0.1)), np.array([0.0, 0.0, 0.2])
    feedback.measured(1.0, np.zeros(3))
    np.testing.assert_array_equal(feedback.target(1.0, wanted, settled_since=None), wanted)  # still on its way
    np.testing.assert_array_equal(feedback.target(1.1, wanted, settled_since=1.05), wanted)  # measured before it stood still
    for k in range(40):
        feedback.measured(2.0 + 0.1 * k, np.zeros(3))
        target = feedback.target(2.0 + 0.1 * k, wanted, settled_since=1.05)
    assert np.linalg.norm(target - wanted) == pytest.approx(0.01) and target[2] > wanted[2]
    assert feedback.missed_m == pytest.approx(0.2)
    feedback.target(9.0, wanted, settled_since=1.05)
    assert np.isnan(feedback.missed_m)  # too old to say anything
    feedback.forget()
    np.testing.assert_array_equal(feedback.target(9.0, wanted, settled_since=1.05), wanted)


@pytest.mark.parametrize("arrived", [True, False])
def test_where_a_point_will_be_is_what_the_model_says_beside_what_was_measured(arrived: bool) -> None:
    feedback, wanted = TipFeedback(0.1), np.array([0.0, 0.0, 0.2])
    reached = wanted if arrived else np.array([0.0, 0.0, 0.19])
    np.testing.assert_array_equal(feedback.expected(reached), reached)
    for k in range(40):
        feedback.measured(2.0 + 0.1 * k, reached - [0.01, 0.0, 0.0])
        feedback.target(2.0 + 0.1 * k, wanted, settled_since=1.05, reached_m=reached, arrived=arrived)
    np.testing.assert_allclose(feedback.expected(reached + 1e-3), reached + 1e-3 - [0.01, 0.0, 0.0], atol=1e-15)
    feedback.forget()
    np.testing.assert_array_equal(feedback.expected(reached), reached)


def test_an_answer_speaks_of_the_target_that_was_asked_and_says_why_nothing_is_measured(
    served: tuple[Hub, DragServer, ObedientRobot],
) -> None:
    hub, server, _ = served
    real = ObedientRobot(hub, bar((6, 2, 2)), "bar", drive_inputs(server.robot))
    far = server.robot.marker_points[0] + [0.02, 0.0, 0.0]  # it does not grow longer
    end = time.monotonic() + 20.0
    while time.monotonic() < end and not reach_of(hub).get("correction_m", 0.0) > 1e-3:
        drag(hub, far)
        real.report(("tip", "side"))
        time.sleep(0.03)
    told = reach_of(hub)
    assert told["measured_error_m"] > 0.015 and told["error_m"] == pytest.approx(told["measured_error_m"], abs=3e-3)
    assert f"{1e3 * told['error_m']:.3g} mm" in told["text"] and "not measured" not in told["text"]

    def says(text: str, more: dict[str, Any] | None = None) -> bool:
        drag(hub, far)
        if more:
            hub.received(Message("femsense/bar/measured", json.dumps(more).encode()), "sensors")
        return text in reach_of(hub)["text"] and "measured_error_m" not in reach_of(hub)

    assert within(10.0, lambda: says("; not measured: nothing for "))
    assert within(10.0, lambda: says("; not measured: bend = 50 is outside", {"markers": [], "detail": "bend = 50 is outside"}))
    drag(hub, far, handle="side", held=False)


def test_a_drag_that_has_ended_is_armed_for_nobody_and_its_inputs_stay(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    out = Commands(hub, server)
    far = target_of(server.robot, dict(zip(server.robot.body.cable_names, (1.5, 0.6))))
    for end in (lambda: drag(hub, far, held=False), server.close):
        hold(hub, out, far)
        assert within(5.0, lambda: reach_of(hub)["armed"])
        end()
        assert within(5.0, lambda: not reach_of(hub)["armed"])
        last = json.loads(hub.newest()["femsense/bar/command"].payload)
        assert not last["armed"] and [row["value"] for row in last["inputs"]] == out.sent[-1]


def test_after_a_lapse_commands_go_on_from_the_last_one_though_a_run_plays_on(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    names, out = server.robot.body.cable_names, Commands(hub, server)
    far, rest = (target_of(server.robot, dict(zip(names, pull))) for pull in ((1.5, 0.6), (0.0, 0.0)))
    out.play(0.5, 0.2)
    hold(hub, out, far)
    assert out.sent[0] == pytest.approx([0.5, 0.2])  # before the first command that is where the robot is
    assert out.sent[-1] != out.sent[0]
    for lapse, played, target, who in (
        (0.0, (1.4, 0.0), far, "me"),  # armed again at once
        (0.5, (0.0, 1.4), far, "me"),  # a connection that was away
        (2.0, (0.7, 0.7), rest, "another"),  # long, somebody else, and back to rest
    ):
        if lapse:
            time.sleep(lapse)
        else:
            drag(hub, far, armed=False)
        assert within(5.0, lambda: not server.gate.moving)
        out.play(*played)
        hold(hub, out, target, who=who)
    assert out.farthest() <= 1.0 + 1e-9


def test_a_robot_that_stands_at_its_target_stays_there_after_a_lapse_though_a_run_plays_on(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    out = Commands(hub, server)
    wanted = target_of(server.robot, dict(zip(server.robot.body.cable_names, (0.6, 0.0))))
    for _ in range(20):
        hold(hub, out, wanted)
        if np.ptp(out.sent[-20:], axis=0).max() < 1e-6 and reach_of(hub)["status"] == "reached":
            break
    stood, count = np.array(out.sent[-1]), len(out.sent)
    assert reach_of(hub)["status"] == "reached"
    time.sleep(0.5)
    out.play(0.0, 1.4)
    hold(hub, out, wanted)
    assert np.abs(np.array(out.sent[count:]) - stood).max() < 1e-3


def test_commands_begin_where_the_robot_itself_says_that_it_is(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    names, out = server.robot.body.cable_names, Commands(hub, server)
    far = target_of(server.robot, dict(zip(names, (1.5, 0.6))))
    hold(hub, out, far)
    drag(hub, far, held=False)
    assert within(5.0, lambda: not server.gate.moving)
    count, rows = len(out.sent), [{"name": name, "unit": "N", "value": v} for name, v in zip(names, (2.5, 1.5))]
    rubbish: list[Any] = [{"name": ["a list"], "unit": "N", "value": 1.0}, {"name": names[0], "unit": "Pa", "value": 3.0}]
    rubbish += [{"name": names[1], "unit": "N", "value": float("nan")}, 7]
    for told in (rubbish, "no list"):
        hub.received(Message("femsense/bar/measured", json.dumps({"inputs": told, "markers": told}).encode()), "the robot")
    hold(hub, out, far, said=json.dumps({"inputs": rows}).encode())
    assert out.sent[count] == pytest.approx([2.5, 1.5])


def test_each_command_has_a_number_of_its_own_and_none_is_left_out(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    out = Commands(hub, server)
    far = target_of(server.robot, dict(zip(server.robot.body.cable_names, (1.5, 0.6))))
    for _ in range(2):
        hold(hub, out, far)
        drag(hub, far, held=False)
        assert within(5.0, lambda: not server.gate.moving)
    assert within(5.0, lambda: len(out.numbers) == len(out.sent) + 2)  # that it ends is a message too
    assert out.numbers == list(range(len(out.numbers)))


def test_before_the_first_command_it_is_said_where_it_begins_unless_the_robot_says_where_it_is(
    alone: tuple[Hub, DragServer],
) -> None:
    hub, server = alone
    names, out = server.robot.body.cable_names, Commands(hub, server)
    far, warned = target_of(server.robot, dict(zip(names, (1.5, 0.6)))), "the first command starts from the displayed ones"
    drag(hub, far, armed=False)
    assert within(20.0, lambda: warned in reach_of(hub).get("text", ""))
    inputs = [{"name": name, "unit": "N", "value": 0.1} for name in names]

    def says_where_it_begins(count: int) -> bool:
        said = json.dumps({"inputs": inputs[:count]}).encode()
        hub.received(Message("femsense/bar/measured", said), "the robot")
        drag(hub, far, armed=False)
        time.sleep(0.1)
        return warned in reach_of(hub)["text"]

    assert within(20.0, lambda: not says_where_it_begins(2))
    time.sleep(0.6)  # that is too old now
    assert within(20.0, lambda: says_where_it_begins(1))  # all of them must be known
    hold(hub, out, far)
    assert within(20.0, lambda: warned not in reach_of(hub)["text"])


def test_who_comes_back_after_a_lapse_begins_anew(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    far = target_of(server.robot, dict(zip(server.robot.body.cable_names, (1.5, 0.6))))
    drag(hub, far)
    turn = server.gate.turn
    drag(hub, far)
    assert server.gate.turn == turn
    time.sleep(1.5 * server.gate.options.hold_s)
    drag(hub, far)
    assert server.gate.turn == turn + 1


def test_without_arming_the_ghost_moves_and_the_robot_does_not(served: tuple[Hub, DragServer, ObedientRobot]) -> None:
    hub, server, there = served
    wanted = target_of(server.robot, {server.robot.body.cable_names[0]: 0.4})
    drag(hub, wanted, armed=False)
    assert within(5.0, lambda: reach_of(hub).get("status") == "reached")
    drag(hub, np.add(wanted, [0.0, 0.0, 0.05]), armed=False)
    assert within(10.0, lambda: "cannot bring it closer than " in reach_of(hub)["text"]) and not there.heard


def test_a_drag_begins_where_the_robot_is(served: tuple[Hub, DragServer, ObedientRobot]) -> None:
    hub, server, there = served
    told, inputs = answers(hub), dict(zip(server.robot.body.cable_names, (1.2, 0.5)))
    there.inputs = inputs
    there.obey({"armed": False})  # says where it is
    drag(hub, target_of(server.robot, inputs), armed=False)
    assert within(5.0, lambda: bool(told))
    assert told[0]["error_m"] < 1e-6
    assert {row["name"]: row["value"] for row in told[0]["inputs"]} == pytest.approx(inputs, abs=1e-6)


def test_answers_go_on_by_themselves_until_nothing_comes_nearer(alone: tuple[Hub, DragServer]) -> None:
    hub, server = alone
    told = answers(hub)
    drag(hub, target_of(server.robot, dict(zip(server.robot.body.cable_names, (1.5, 0.6)))), armed=False)  # said once
    assert within(10.0, lambda: bool(told) and told[-1]["status"] == "reached")
    assert len(told) > 1 and {one["status"] for one in told[:-1]} == {"converging"}
    errors = [one["error_m"] for one in told]
    assert errors == sorted(errors, reverse=True) and told[0]["text"].startswith("Looking for a way: ")


def test_one_hand_at_a_time_and_wishes_that_cannot_be_meant_do_nothing(served: tuple[Hub, DragServer, ObedientRobot]) -> None:
    hub, server, there = served
    wanted = target_of(server.robot, {server.robot.body.cable_names[0]: 0.4})
    drag(hub, wanted, armed=False, who="first")
    drag(hub, wanted, armed=True, who="second")
    sent = json.loads(hand_of(hub, "first").wishes[-1].payload) | {"armed": True}
    odd = ({"target_m": None}, {"handle": "no"}, {"client": 7}, {"client": ""}, {"seq": True}, {"seq": "9"}, {"lease": 1.5})
    for bad in [b"", b"[]", *(json.dumps({**sent, "seq": 1000, **more}).encode() for more in odd)]:
        hub.received(Message("femsense/bar/drag", bad), "first")
    drag(hub, [0.0, 0.0, 99.0], who="first")
    drag(hub, [float("nan"), 0.0, 0.0], who="first")
    time.sleep(0.2)
    assert not there.heard and not there.armed


# ---- who steers


@pytest.fixture
def steered(alone: tuple[Hub, DragServer]) -> tuple[Hub, DragServer, Commands, np.ndarray]:
    """A robot that is dragged, its commands, and a place for its tip that needs both cables."""
    hub, server = alone
    far = target_of(server.robot, dict(zip(server.robot.body.cable_names, (1.5, 0.6))))
    return hub, server, Commands(hub, server), far


def commands_in(seconds: float, out: Commands) -> int:
    """How many commands go out from now on."""
    time.sleep(0.1)  # what is under way
    count = len(out.sent)
    time.sleep(seconds)
    return len(out.sent) - count


def test_two_clients_that_come_the_same_way_do_not_steer_in_turns(
    steered: tuple[Hub, DragServer, Commands, np.ndarray],
) -> None:
    hub, _server, out, far = steered
    first, second = Hand(hub, "first", way="MQTT"), Hand(hub, "second", way="MQTT")
    elsewhere = np.add(far, [0.0, 0.0, -0.02])
    end = time.monotonic() + 20.0
    while time.monotonic() < end and len(out.sent) < 20:
        first.drag(far)
        second.drag(elsewhere)
        second.drag(elsewhere, armed=False, held=False)  # nor may it let go for somebody else
        time.sleep(0.03)
    assert len(out.sent) >= 20 and second.told["client"] == "first" and second.lease == 0
    first.drag(far, held=False)
    assert within(3.0, lambda: first.told["client"] == "")
    second.drag(elsewhere)
    assert second.lease > 0 and first.lease == 0


def test_wishes_that_are_replayed_or_come_late_move_nothing(steered: tuple[Hub, DragServer, Commands, np.ndarray]) -> None:
    hub, server, out, far = steered
    hand = hand_of(hub)
    hold(hub, out, far)
    recorded = list(hand.wishes)
    hand.drag(far, held=False)
    assert within(3.0, lambda: not server.gate.moving)
    for message in recorded:
        hub.received(message, hand.way)
        hub.received(message, "another way")  # there the first asks for a lease, and the others quote none that is valid
    assert commands_in(0.3, out) == 0 and not server.gate.moving
    hub.received(recorded[-1], hand.way)
    hold(hub, out, far)  # its own newer ones count


def test_a_replay_to_a_server_that_was_started_again_moves_nothing(
    steered: tuple[Hub, DragServer, Commands, np.ndarray],
) -> None:
    hub, server, out, far = steered
    hold(hub, out, far)
    recorded = [message for message in hand_of(hub).wishes if json.loads(message.payload)["lease"]]
    server.close()
    nodes = server.robot.body.mesh.nodes[np.unique(surface_triangles(server.robot.body.mesh))]
    again = Hub()
    later = DragServer(again, server.robot, fit_skin(nodes, nodes[None], bones=4), name="bar", options=server.options)
    told = Commands(again, later)
    for message in recorded:
        again.received(message, "me")
    assert commands_in(0.3, told) == 0 and not later.gate.moving
    later.close()


@pytest.mark.parametrize("payload", [b"", b'{"client": "somebody"}', b"\xff"])
def test_anybody_stops_everything_and_hands_that_hold_on_do_not_go_on(
    steered: tuple[Hub, DragServer, Commands, np.ndarray], payload: bytes
) -> None:
    hub, _server, out, far = steered
    hold(hub, out, far)
    hub.received(Message("femsense/bar/stop", payload), "a bystander")
    last = json.loads(hub.newest()["femsense/bar/command"].payload)
    assert not last["armed"] and [row["value"] for row in last["inputs"]] == pytest.approx(out.sent[-1])
    assert within(3.0, lambda: not reach_of(hub)["armed"])
    lease = json.loads(hub.newest()["femsense/bar/lease"].payload)
    assert lease["stopped"] and names_in(lease) == names_in(documented("lease"))
    count = len(out.sent)
    for _ in range(10):
        for who in ("me", "a stranger who is armed"):
            drag(hub, far, who=who)
        time.sleep(0.03)
    assert len(out.sent) == count
    drag(hub, far, armed=False)
    assert hand_of(hub).lease > 0  # an open hand has been seen
    hold(hub, out, far)


def test_inputs_and_handles_are_those_of_the_robot() -> None:
    robot = bar((4, 1, 1))
    assert [(i.name, i.unit, i.low) for i in drive_inputs(robot)] == [(name, "N", 0.0) for name in robot.body.cable_names]
    assert all(np.isfinite(i.high) for i in drive_inputs(robot))
    assert [h.name for h in handles_of(robot)] == ["tip", "side"]
    np.testing.assert_array_equal(handles_of(robot)[0].position_m, TIP[0])
