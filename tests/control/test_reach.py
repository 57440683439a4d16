"""The inverse problem of motion: what can be reached is reached, limits are kept, and what limits is named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from analytic import bar_body
from helpers import DATA, block_mesh

import femsense as fs
from femsense.control.goal import make_goal
from femsense.control.slopes import Slopes, approximate_slopes, exact_slopes
from femsense.core.errors import InputError
from femsense.fem.equilibrium import SolveOptions
from femsense.fem.mesh import embed_points
from femsense.io.robot_toml import load_robot
from femsense.model.effects import apply_effects
from femsense.model.robot import Observation, Robot, plain_actuation

TIP = np.array([[0.1, 0.015, 0.03], [0.1, 0.0, 0.015]])


def bar(*, friction: float = 0.0) -> Robot:
    """A bar with two cables, pulled up and aside, and two markers at its end."""
    body = bar_body(block_mesh((4, 1, 1)), friction=friction)
    return Robot(
        name="bar",
        body=body,
        marker_names=("tip", "side"),
        marker_points=TIP,
        markers=embed_points(body.mesh, TIP),
        features=np.zeros(0, np.int64),
        color_rgb=None,
        actuation=plain_actuation(2),
        observation=Observation(),
    )


def place(robot: Robot, tension: dict[str, float], marker: int = 0, **more: object) -> np.ndarray:
    """Where a marker is at equilibrium under tensions [m]."""
    return robot.markers.positions(fs.solve_equilibrium(robot.body, tension=tension, **more).positions)[marker]


def limited(robot: Robot, **limits: float) -> Robot:
    """The robot with other limits of its cables."""
    return robot.with_body(robot.body.with_cables(tuple(replace(c, **limits) for c in robot.body.cables)))


@pytest.mark.parametrize("control", ["tension", "displacement"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_some_inputs_reach_is_reached_and_the_inputs_do_it(control: str, seed: int) -> None:
    robot = bar()
    tension = dict(zip(robot.body.cable_names, np.random.default_rng(seed).uniform(0.05, 0.8, 2)))
    wanted = place(robot, tension)
    motion = fs.reach(robot, {"tip": wanted}, control=control)
    assert motion.status == "reached" and motion.error_m <= 1e-10 and not motion.limits
    drive = {"tension": motion.inputs} if control == "tension" else {"shortening": motion.inputs}
    again = fs.solve_equilibrium(robot.body, **drive)
    np.testing.assert_allclose(robot.markers.positions(again.positions)[0], wanted, atol=2e-7)
    np.testing.assert_allclose(motion.reached_m["tip"], wanted, atol=1e-10)
    assert motion.certificate.equilibrium_n < 1e-8 and motion.certificate.violation == 0.0


def test_along_a_path_the_inputs_hold_the_body_at_each_target() -> None:
    """Factors that are kept from one target to the next leave no state unfinished: solved anew, it is where it was said to be."""
    robot = bar()
    motion, finely = None, SolveOptions(relative_tolerance=1e-13)
    for share in (0.0, 0.1, 0.2, 0.5, 1.0):
        wanted = place(robot, {"top": 0.2 + 0.5 * share, "side": 0.6 - 0.3 * share}, options=finely)
        motion = fs.reach(robot, {"tip": wanted}, start=motion)
        there = place(robot, motion.inputs, start=motion.equilibrium, options=finely)
        assert motion.status == "reached"
        np.testing.assert_allclose(there, wanted, rtol=0, atol=1.2e-10)


def test_slopes_are_those_of_the_states_near_by() -> None:
    robot, tension = bar(), {"top": 0.4, "side": 0.3}
    goal = make_goal(robot, {"tip": [0.0, 0.0, 0.0]}, (), ())
    state = fs.solve_equilibrium(robot.body, tension=tension)
    slopes, keeps = exact_slopes(robot.body, goal, state)
    near = place(robot, {"top": 0.4 + 1e-4, "side": 0.3}) - place(robot, {"top": 0.4 - 1e-4, "side": 0.3})
    np.testing.assert_allclose(slopes.points[:, 0], near / 2e-4, rtol=1e-4, atol=1e-8)
    lent = approximate_slopes(robot.body, goal, keeps)
    assert slopes.exact and lent is not None and not lent.exact
    np.testing.assert_allclose(lent.points, slopes.points)
    assert approximate_slopes(robot.body, goal, replace(state, factor=None)) is None


def test_slopes_that_a_step_has_shown_give_that_step_and_leave_others() -> None:
    rng = np.random.default_rng(3)
    before = Slopes(rng.normal(size=(3, 3)), rng.normal(size=(2, 3)), np.ones(3), exact=True)
    change, moved, wound = rng.normal(size=3), rng.normal(size=3), rng.normal(size=2)
    after = before.learned(change, moved, wound)
    np.testing.assert_allclose(after.points @ change, moved, atol=1e-12)
    np.testing.assert_allclose(after.wound @ change, wound, atol=1e-12)
    other = np.cross([1.0, 0.0, 0.0], (before.points**2).sum(axis=0) * change)  # stands on the step, as efforts count
    np.testing.assert_allclose(after.points @ other, before.points @ other, atol=1e-12)
    assert not after.exact


def test_a_direction_may_be_left_free() -> None:
    robot = bar()
    up = place(robot, {})[2] + 0.004
    motion = fs.reach(robot, {"tip": [np.nan, np.nan, up]})
    assert motion.status == "reached" and motion.reached_m["tip"][2] == pytest.approx(up, abs=1e-10)


def test_what_no_input_reaches_is_answered_with_the_nearest_and_its_limits() -> None:
    robot = limited(bar(), max_tension=0.3)
    names = robot.body.cable_names
    wanted = np.add(place(robot, {}), [0.0, 0.0, 0.2])
    motion = fs.reach(robot, {"tip": wanted})
    assert motion.status == "nearest" and any("largest tension, 0.3 N" in limit for limit in motion.limits)
    assert all(0.0 <= motion.inputs[name] <= 0.3 for name in names) and motion.certificate.gradient < 1e-6
    for i, name in enumerate(names):  # no neighbour within the limits is nearer
        for step in (-0.01, 0.01):
            tension = {**motion.inputs, name: float(np.clip(motion.inputs[name] + step, 0.0, 0.3))}
            assert np.linalg.norm(place(robot, tension) - wanted) >= motion.error_m - 1e-9, (i, step)


def test_a_far_target_beside_the_way_of_the_tip_ends_in_few_equilibria() -> None:
    motion = fs.reach(limited(bar(), max_tension=3.0), {"tip": [0.0186, 0.0271, -0.0132]})
    assert motion.status == "nearest" and motion.certificate.gradient < 1e-9
    assert motion.iterations <= 12  # with slopes alone 28
    assert motion.error_m == pytest.approx(0.0903, abs=1e-4)


def test_where_equilibria_end_the_search_ends_with_the_nearest_and_says_so() -> None:
    motion = fs.reach(bar(), {"tip": [0.05, 0.0, -0.2]})  # without limits the bar buckles before it comes nearer
    assert motion.status == "nearest" and motion.limits[-1].startswith("no equilibrium further on (")
    assert (
        motion.iterations <= 42
    )  # 48 where the step grows as if none had failed, "stopped" after 60 where it shrinks to nothing
    assert motion.error_m == pytest.approx(0.2262, abs=5e-4)
    assert motion.certificate.equilibrium_n < 1e-6


def test_limits_of_length_are_kept() -> None:
    robot = bar()
    name = robot.body.cable_names[0]
    wanted = place(robot, {name: 0.6})
    free = fs.reach(robot, {"tip": wanted}, control="displacement")
    most = 0.5 * free.inputs[name]
    motion = fs.reach(robot, {"tip": wanted}, control="displacement", limits={name: (-1.0, most)})
    assert motion.status == "nearest" and motion.inputs[name] == pytest.approx(most, abs=1e-9)
    assert any(limit.startswith(f"{name} wound up by no more than") for limit in motion.limits)


def test_limits_of_length_hold_what_a_cable_stretches_by_too() -> None:
    robot = apply_effects(bar(), [{"name": "cable_stretch", "stiffness_n_m": 20.0}])  # most of what is wound up stretches it
    name = robot.body.cable_names[0]
    wanted = place(robot, {name: 0.6})
    free = fs.reach(robot, {"tip": wanted})
    wound = fs.solve_equilibrium(robot.body, tension=free.inputs).shortening[name] + free.inputs[name] / 20.0
    motion = fs.reach(robot, {"tip": wanted}, control="displacement", limits={name: (-1.0, 0.5 * wound)})
    assert motion.status == "nearest" and motion.inputs[name] == pytest.approx(0.5 * wound, abs=1e-9)
    held = fs.solve_equilibrium(robot.body, shortening=motion.inputs)
    np.testing.assert_allclose(robot.markers.positions(held.positions)[0], motion.reached_m["tip"], atol=2e-7)
    assert motion.iterations <= 8 and motion.certificate.violation < 1e-9


def test_a_cable_that_cannot_push_is_said_to_be_what_limits() -> None:
    robot = bar()
    motion = fs.reach(robot, {"tip": np.subtract(place(robot, {}), [0.0, 0.0, 0.01])})
    assert motion.status == "nearest" and any("cannot push" in limit for limit in motion.limits)
    assert min(motion.inputs.values()) >= 0.0


def test_known_contact_forces_act_meanwhile() -> None:
    robot = bar()
    name = robot.body.cable_names[0]
    push = np.zeros_like(robot.body.mesh.nodes)
    at = int(np.argmin(np.linalg.norm(robot.body.mesh.nodes - TIP[0], axis=1)))
    point = robot.body.mesh.nodes[at]
    push[at] = [0.0, 0.02, -0.05]
    wanted = place(robot, {name: 0.4}, nodal_forces=push)
    motion = fs.reach(robot, {"tip": wanted}, forces=[(point, push[at])])
    assert motion.status == "reached" and motion.inputs[name] == pytest.approx(0.4, abs=1e-4)


def test_a_wall_is_pressed_with_the_wanted_force() -> None:
    robot = bar()
    above = place(robot, {})[2] + 0.002
    wall = fs.WallContact(tuple(TIP[0]), (0.0, 0.0, -1.0), -above, 0.05)
    motion = fs.reach(robot, {"side": [np.nan, place(robot, {}, 1)[1], np.nan]}, contacts=[wall])
    assert motion.status == "reached"
    tip = embed_points(robot.body.mesh, TIP[:1])
    np.testing.assert_allclose(tip.positions(motion.positions)[0, 2], above, atol=1e-9)
    lift = tip.spread(np.array([[0.0, 0.0, -0.05]]), len(robot.body.mesh.nodes))  # the wall pushes down with what was wanted
    held = fs.solve_equilibrium(robot.body, tension=motion.equilibrium.tension, nodal_forces=lift)
    np.testing.assert_allclose(tip.positions(held.positions)[0, 2], above, atol=1e-7)


@pytest.mark.parametrize(
    ("control", "effects"),
    [
        (
            "tension",
            [{"name": "cable_gain", "scale": {"top": 0.8, "side": 1.1}}, {"name": "cable_offset", "tension_n": {"top": 0.1}}],
        ),
        (
            "displacement",
            [{"name": "cable_slack", "displacement_m": {"top": 1e-3}}, {"name": "cable_stretch", "stiffness_n_m": 800.0}],
        ),
    ],
)
def test_commands_are_those_of_the_motors(control: str, effects: list[dict[str, object]]) -> None:
    plain = bar()
    robot = apply_effects(plain, effects)
    wanted = place(plain, {"top": 0.5, "side": 0.2})
    motion = fs.reach(robot, {"tip": wanted}, control=control)
    assert motion.status == "reached"
    recording = fs.make_recording(
        fs.Timeline([0.0]), drives=fs.Drives(robot.body.cable_names, [list(motion.inputs.values())], actuation=control)
    )
    from femsense.model.drive import DrivenRobot, drive_of
    from femsense.model.frame_state import solve_frame

    state = solve_frame(DrivenRobot(robot, drive_of(robot, recording)), 0)
    np.testing.assert_allclose(robot.markers.positions(state.positions)[0], wanted, atol=1e-6)


def test_friction_is_paid_for() -> None:
    plain, rubbing = bar(), bar(friction=0.3)
    wanted = place(plain, {"top": 0.5})
    motion = fs.reach(rubbing, {"tip": [np.nan, np.nan, wanted[2]]})
    assert motion.status == "reached"
    assert sum(motion.inputs.values()) > sum(fs.reach(plain, {"tip": [np.nan, np.nan, wanted[2]]}).inputs.values()) + 0.01


def test_pressures_reach_too() -> None:
    robot = load_robot("pneu-finger")
    name = robot.body.chamber_names[0]
    pressed = fs.solve_equilibrium(robot.body, pressure={name: 4e3})
    wanted = robot.markers.positions(pressed.positions)[0]
    motion = fs.reach(robot, {robot.marker_names[0]: wanted})
    assert motion.status == "reached" and motion.inputs[name] == pytest.approx(4e3, rel=1e-6)


@pytest.mark.skipif(not (DATA / "finger").is_dir(), reason="the finger of the peers is not here")
def test_the_finger_of_the_peers_reaches_its_heights_and_keeps_its_limits() -> None:
    """Goals and limits of SoftRobots.Inverse's own scenes: heights are met to 1e-10 in its unit, millimetres (PEERS, H)."""
    robot = load_robot(str(DATA / "finger"))
    cable, nodes = robot.body.cable_names[0], robot.body.mesh.nodes
    far_end = nodes[np.argmax(np.linalg.norm(nodes - nodes[robot.body.clamped].mean(axis=0), axis=1))]
    name, tip = tuple(far_end.tolist()), embed_points(robot.body.mesh, far_end[None])
    here = tip.positions(fs.solve_equilibrium(robot.body).positions)[0]
    way = tip.positions(fs.solve_equilibrium(robot.body, tension={cable: 1.0}).positions)[0] - here
    axis = int(np.argmax(np.abs(way)))
    start = None
    for share in (0.3, 0.6, 0.9):
        wanted = np.full(3, np.nan)
        wanted[axis] = here[axis] + share * way[axis]
        start = fs.reach(robot, {name: wanted}, start=start)
        assert start.status == "reached" and start.error_m <= 1e-10
    back = np.full(3, np.nan)
    back[axis] = here[axis] - 0.5 * way[axis]
    assert fs.reach(robot, {name: back}).inputs[cable] >= 0.0
    far = np.full(3, np.nan)
    far[axis] = here[axis] + 3.0 * way[axis]
    assert fs.reach(robot, {name: far}, limits={cable: (0.0, 0.8)}).inputs[cable] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("target", "more", "text"),
    [
        ({"tap": [0.0, 0.0, 0.0]}, {}, "did you mean 'tip'"),
        ({}, {}, "no target"),
        ({"tip": [0.0, 0.0]}, {}, "not a position"),
        ({(0.05, 0.5, 0.0): [0.0, 0.0, 0.0]}, {}, r"target: far from the surface of the body\n.* 470.0 mm from the body"),
        ({"tip": [0.0, 0.0, 0.0]}, {"forces": [([0.05, 0.5, 0.0], [0.0, 0.0, 0.1])]}, "forces: far from the surface"),
        ({"tip": [0.0, 0.0, 0.0]}, {"forces": [([50.0, 0.0, 15.0], [0.0, 0.0, 0.1])]}, "divide by 1000"),
        ({"tip": [0.0, 0.0, 0.0]}, {"contacts": [fs.WallContact((0.05, 0.5, 0.0), (0.0, 0.0, 1.0), 0.0, 0.1)]}, "contacts: far"),
        ({"tip": [0.0, 0.0, 0.0]}, {"control": "torque"}, "unknown control"),
        ({"tip": [0.0, 0.0, 0.0]}, {"limits": {"bottom": (0.0, 1.0)}}, "unknown cable or chamber"),
        ({"tip": [0.0, 0.0, 0.0]}, {"limits": {"top": (1.0, 0.0)}}, "reversed limits"),
    ],
)
def test_what_cannot_be_meant_is_refused(target: dict[str, list[float]], more: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        fs.reach(bar(), target, **more)


def test_the_command_says_inputs_limits_and_exit_status(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from femsense.app.cli import run

    robot = load_robot("four-leg")
    name = robot.marker_names[0]
    x, y, _ = place(robot, {})
    out = tmp_path / "motion.json"
    assert run(["reach", "four-leg", "--target", f"{name}={x + 0.003},{y},", "-o", str(out)]) == 0
    assert "reached" in capsys.readouterr().out and out.is_file()
    assert run(["reach", "four-leg", "--target", f"{name}={x + 0.3},,"]) == 1
    assert "out of reach" in capsys.readouterr().out
    assert run(["reach", "four-leg", "--target", "0.1,0.2"]) == 2
    capsys.readouterr()
    assert run(["reach", "four-leg", "--target", f"{name}={1e3 * x + 3},,"]) == 2
    assert "this looks like millimetres" in capsys.readouterr().err


def test_a_held_point_is_moved_by_no_input() -> None:
    motion = fs.reach(bar(), {(0.0, 0.015, 0.0): [0.02, 0.0, 0.0]})
    assert motion.status == "nearest" and "no input moves the points" in motion.text


@pytest.mark.skipif(not (DATA / "finger").is_dir(), reason="shared data")
def test_the_nearest_is_found_where_the_error_bends_downwards_on_the_way() -> None:
    """The least height of this node is at 1.4 N, the slope turns at 2 N."""
    robot = load_robot(str(DATA / "finger"))
    nodes = robot.body.mesh.nodes
    point = nodes[np.linalg.norm(nodes - [-0.0896, 0.0085, 0.015], axis=1).argmin()]
    tie = embed_points(robot.body.mesh, point[None])
    lowest = tie.positions(fs.solve_equilibrium(robot.body, tension={"cable": 1.4}).positions)[0, 2]
    for height in (-0.09, -0.005):
        motion = fs.reach(robot, {tuple(point.tolist()): [np.nan, np.nan, height]})
        assert motion.status == "nearest" and motion.error_m <= lowest - height + 2e-6
        assert not any("push" in limit for limit in motion.limits)
