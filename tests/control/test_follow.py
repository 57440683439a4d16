"""A target that moves: each answer is one equilibrium further on, and where the hand rests the end is that of `reach`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic import bar_body
from helpers import block_mesh

import femsense as fs
from femsense.control.follow import Follower
from femsense.control.search import ReachOptions
from femsense.core.errors import InputError
from femsense.fem.mesh import embed_points, to_quadratic
from femsense.model.robot import Observation, Robot, plain_actuation

TIP = np.array([[0.1, 0.015, 0.03], [0.1, 0.0, 0.015]])
HAND = ReachOptions(tolerance_m=1e-4)


def bar(**limits: float) -> Robot:
    """A bar with two cables, pulled up and aside, and two markers at its end."""
    body = bar_body(to_quadratic(block_mesh((4, 1, 1))))
    body = body.with_cables(tuple(replace(cable, **limits) for cable in body.cables))
    none = np.zeros(0, np.int64)
    return Robot("bar", body, ("tip", "side"), TIP, embed_points(body.mesh, TIP), none, None, plain_actuation(2), Observation())


def path(robot: Robot, steps: int) -> list[np.ndarray]:
    """Where growing tensions bring the tip [m]."""
    pulls = np.linspace(0.0, 1.0, steps + 1)[1:, None] * [1.2, 0.5]
    states = [fs.solve_equilibrium(robot.body, tension=dict(zip(robot.body.cable_names, pull))) for pull in pulls]
    return [robot.markers.positions(state.positions)[0] for state in states]


def rested(follower: Follower, target: dict[str, np.ndarray], most: int = 100) -> fs.Motion:
    """The answer after which nothing changes."""
    for _ in range(most):
        motion = follower.step(target, stays=True)
        if follower.resting:
            return motion
    raise AssertionError("never rests")


def test_a_hand_is_followed_by_an_equilibrium_an_answer() -> None:
    robot = bar()
    wanted = path(robot, 16)
    follower, counts, behind = Follower(robot, options=HAND), [], []
    for place in wanted:
        before = follower.step({"tip": place}).iterations
        motion = follower.step({"tip": place})
        counts.append(motion.iterations - before)
        behind.append(motion.error_m)
        assert motion.equilibrium.converged
    away = np.linalg.norm(wanted[-1] - TIP[0])
    assert max(counts) <= 1 and max(behind) < 0.1 * away  # two answers for each wish, of which there are 16
    assert rested(follower, {"tip": wanted[-1]}).status == "reached"


def test_where_the_hand_rests_the_end_is_that_of_reach() -> None:
    robot = bar(max_tension=0.8)
    for target in (path(robot, 1)[0], TIP[0] + [0.0, 0.0, 0.05], TIP[0] + [0.02, 0.03, -0.01]):
        expected = fs.reach(robot, {"tip": target})
        found = rested(Follower(robot, options=HAND), {"tip": target})
        assert found.status == expected.status and found.error_m <= expected.error_m + 2e-4
        assert found.certificate.equilibrium_n < 1e-6 and found.certificate.violation == 0.0
        assert all(0.0 <= value <= 0.8 for value in found.inputs.values())


def test_the_first_answer_says_that_it_converges_and_moves_no_node_far() -> None:
    robot = bar()
    follower, target = Follower(robot, options=HAND), {"tip": path(robot, 1)[0]}
    rest = follower.step({"tip": TIP[0]}).positions
    motion = follower.step(target)
    moved = np.linalg.norm(motion.positions - rest, axis=1).max()
    assert motion.status == "converging" and motion.text.startswith("converging: ") and "mm from the target" in motion.text
    assert 0.0 < moved < 0.045 * robot.body.reach  # by both inputs
    assert rested(follower, target).status == "reached"


def test_with_time_an_answer_takes_more_equilibria() -> None:
    robot = bar()
    target = {"tip": path(robot, 1)[0]}
    follower = Follower(robot, options=HAND)
    assert follower.step(target, seconds=60.0).status == "reached" and follower.ended and follower.resting


def test_it_begins_where_inputs_have_brought_the_robot() -> None:
    robot, target = bar(), {"tip": path(bar(), 1)[0]}
    inputs = dict(zip(robot.body.cable_names, (1.2, 0.5)))
    follower = Follower(robot, options=HAND)
    follower.begin(inputs)
    motion = follower.step(target)
    assert motion.error_m < 1e-6 and motion.inputs == pytest.approx(inputs, abs=1e-6)


def test_from_a_place_that_leads_nowhere_the_end_from_rest_is_taken() -> None:
    robot = bar()
    target, follower = {"tip": TIP[0] + [0.0567, 0.0468, 0.0387]}, Follower(robot, options=HAND)
    follower.begin(dict(zip(robot.body.cable_names, (5.74, 0.6))))  # wound up
    while not follower.ended:
        here = follower.step(target)
    best = fs.reach(robot, target).error_m
    assert not follower.resting and here.error_m > best + 1e-3
    assert rested(follower, target, 300).error_m <= best + 2e-4


def test_what_cannot_be_followed_is_refused() -> None:
    with pytest.raises(InputError, match="unknown control"):
        Follower(bar(), control="pull")
    with pytest.raises(InputError, match="unknown marker"):
        Follower(bar()).step({"nose": TIP[0]})
