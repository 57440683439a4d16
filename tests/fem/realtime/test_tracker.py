"""The tracker: near the full solver along a path, with an error estimate that holds, and the full solver where it must."""

from __future__ import annotations

import numpy as np
import pytest
from analytic import bar_body
from helpers import block_mesh

from femsense.core.errors import FemsenseError, InputError
from femsense.fem.assembly import internal
from femsense.fem.body import BodyModel
from femsense.fem.compliance import compliance
from femsense.fem.equilibrium import SolveOptions, solve_equilibrium
from femsense.fem.realtime.power_series import Expansion, combination
from femsense.fem.realtime.tracker import Tracker

MESH = block_mesh((6, 2, 2))
POINTS = np.array([[0.1, 0.015, 0.03], [0.07, 0.0, 0.01]])
DIRECTIONS = np.array([[0.0, 0, 1], [0, 1, 0]])


def body_of(quadratic: bool) -> BodyModel:
    return bar_body(MESH, quadratic=quadratic, gravity=(0, 0, -9.81))


def tensions(t: float) -> dict[str, float]:
    return {"top": max(0.0, 1.0 + 0.9 * np.sin(t)), "side": max(0.0, 0.6 * np.sin(1.3 * t))}  # slack now and then


@pytest.mark.parametrize("quadratic", [False, True])
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("speed", [0.1, 0.7])
def test_every_frame_is_near_the_full_solution_and_within_its_error(quadratic: bool, single: bool, speed: float) -> None:
    body, load = body_of(quadratic), np.zeros_like(MESH.nodes if not quadratic else body_of(True).mesh.nodes)
    tracker = Tracker(body, single=single)
    load[np.argmax(body.mesh.nodes[:, 0])] = [0.0, 0.02, 0.0]
    for k in range(10):
        force = load * np.sin(k * speed)
        frame = tracker.step(tension=tensions(k * speed), nodal_forces=force)
        full = solve_equilibrium(body, tension=tensions(k * speed), nodal_forces=force)
        error = np.abs(frame.positions - full.positions).max()
        assert error <= frame.error_m
        assert frame.error_m <= max(0.01 * frame.motion_m, 1e-7)
        assert frame.fell_back == (k == 0) or speed > 0.5


def test_the_compliance_is_that_of_the_full_solution() -> None:
    body = body_of(False)
    tracker = Tracker(body)
    for k in range(4):
        tracker.step(tension=tensions(0.1 * k))
    full = solve_equilibrium(body, tension=tensions(0.3))
    wanted = compliance(body, full, points=POINTS, directions=DIRECTIONS)
    for _ in range(2):  # the second time with what is kept of the points
        got = tracker.compliance(points=POINTS, directions=DIRECTIONS)
        np.testing.assert_allclose(got, wanted, atol=2e-3 * np.abs(wanted).max())


def test_a_leap_is_solved_within_its_error_or_falls_back_to_the_full_solver() -> None:
    body = body_of(False)
    full = solve_equilibrium(body, tension={"top": 6.0, "side": 4.0})
    for most in (5, 0):
        tracker = Tracker(body, most_factorisations=most)
        tracker.step(tension={"top": 0.1})
        frame = tracker.step(tension={"top": 6.0, "side": 4.0})
        assert frame.fell_back == (most == 0)
        assert np.abs(frame.positions - full.positions).max() <= frame.error_m
        assert not tracker.step(tension={"top": 6.0, "side": 4.01}).fell_back


def test_most_frames_of_a_smooth_path_take_no_factorisation() -> None:
    tracker = Tracker(body_of(True))
    counts = [tracker.step(tension=tensions(0.02 * k)).factorisations for k in range(12)]
    assert max(counts[1:]) <= 1 and sum(counts[1:]) <= 4


def test_errors_are_reported_honestly_where_inputs_jitter() -> None:
    body, rng, missed = body_of(True), np.random.default_rng(5), []
    tracker = Tracker(body)
    for k in range(12):
        inputs = {name: t + abs(rng.normal(0.0, 0.03)) for name, t in tensions(0.05 * k).items()}
        frame = tracker.step(tension=inputs)
        error = np.abs(frame.positions - solve_equilibrium(body, tension=inputs).positions).max()
        missed.append(error / frame.error_m)
    assert max(missed) <= 1.0


@pytest.mark.parametrize("quadratic", [False, True])
def test_each_term_of_a_series_raises_the_order_of_its_error(quadratic: bool) -> None:
    body = body_of(quadratic)
    before, more = np.array([1.0, 0.4]), np.array([0.8, 1.2])
    names, push = body.cable_names, np.zeros_like(body.mesh.nodes)
    push[np.argmax(body.mesh.nodes[:, 0])] = [0.0, 0.05, 0.02]
    start = Expansion(body, single=False)
    state = solve_equilibrium(body, tension=dict(zip(names, before)), options=SolveOptions(relative_tolerance=1e-12))
    assert start.move(state.positions, before)
    errors = []
    for share in (1.0, 0.5):
        there = solve_equilibrium(
            body,
            tension=dict(zip(names, before + share * more)),
            nodal_forces=share * push,
            options=SolveOptions(relative_tolerance=1e-12),
        )
        sums = state.positions + np.cumsum(list(start.terms(before + share * more, body.dead_load() + share * push)), axis=0)
        errors.append(np.abs(sums - there.positions).max(axis=(1, 2)))
    orders = np.log2(errors[0] / errors[1])
    np.testing.assert_allclose(orders, [2.0, 3.0, 4.0], atol=0.35)


def test_where_loads_stay_the_first_term_comes_from_what_is_known_of_the_start() -> None:
    body = body_of(True)
    start, loads = Expansion(body, single=False), body.dead_load()
    begin = solve_equilibrium(body, tension=tensions(0.4))
    assert start.move(begin.positions, np.array(list(begin.tension.values())))
    other, push = np.array([1.9, 0.1]), np.zeros_like(loads)
    push[-1, 1] = 0.03
    fresh = [np.array(term) for term in start.terms(other, loads)]  # loads not seen before: a solve
    list(start.terms(np.array([1.0, 1.0]), loads))  # seen: solves for each cable
    for tension, force, wanted in ((other, loads, fresh), (other, loads + push, None), (other, loads, fresh)):
        got = list(start.terms(tension, force))
        if wanted is not None:
            np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-12)
        else:
            assert np.abs(got[0] - fresh[0]).max() > 1e-5


def test_a_series_in_single_precision_loses_nothing() -> None:
    body, sums = body_of(True), []
    for single in (False, True):
        start = Expansion(body, single=single)
        assert start.move(np.array(body.mesh.nodes), np.zeros(2))
        sums.append(sum(start.terms(np.array([0.3, 0.1]), body.dead_load())))
    np.testing.assert_allclose(sums[1], sums[0], atol=1e-5 * np.abs(sums[0]).max())


def test_weights_carry_on_what_is_smooth_in_the_state_and_know_their_doubt() -> None:
    rng = np.random.default_rng(2)
    states = list(0.05 * rng.normal(size=(6, 7, 3)))
    x = states[2] + 0.7 * (states[2] - states[1]) - 0.2 * (states[0] - states[2])
    weights, near = combination(x, states[:3], 1.0)
    assert weights.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(sum(w * s for w, s in zip(weights, states)), x, atol=3e-3)
    np.testing.assert_allclose(combination(x, states[:1], 1.0)[0], [1.0])
    at = [combination(states[0], states[:3], 1.0)[1], near, combination(states[5], states[:3], 1.0)[1]]
    assert at[0] < 0.005 and at[0] < at[1] < at[2]
    assert combination(states[0] + 100.0, states[:3], 1.0)[1] > 0.9


def test_the_compliance_is_carried_on_where_inputs_jitter() -> None:
    body, rng = body_of(True), np.random.default_rng(4)
    tracker, factors = Tracker(body), 0
    for k in range(8):
        inputs = {name: t + abs(rng.normal(0.0, 0.03)) for name, t in tensions(0.05 * k).items()}
        frame = tracker.step(tension=inputs)
        got = tracker.compliance(points=POINTS, directions=DIRECTIONS)
        factors += frame.factorisations if k else 0
        wanted = compliance(body, solve_equilibrium(body, tension=inputs), points=POINTS, directions=DIRECTIONS)
        assert np.linalg.norm(got - wanted) <= 0.02 * np.linalg.norm(wanted)
    assert factors <= 4


def test_laws_without_a_series_are_tracked_too() -> None:
    body = bar_body(MESH, quadratic=False, gravity=(0, 0, -9.81), law="neo_hookean")
    tracker = Tracker(body)
    for k in range(5):
        frame = tracker.step(tension=tensions(0.1 * k))
        error = np.abs(frame.positions - solve_equilibrium(body, tension=tensions(0.1 * k)).positions).max()
        assert error <= frame.error_m
        assert frame.fell_back == (k == 0)


def test_what_a_tracker_does_not_know_is_said() -> None:
    with pytest.raises(InputError, match="cannot be tracked"):
        Tracker(bar_body(MESH, friction=0.2))
    tracker = Tracker(body_of(False))
    with pytest.raises(FemsenseError, match="call step first"):
        tracker.compliance()
    with pytest.raises(InputError, match="unknown cable"):
        tracker.step(tension={"bottom": 1.0})
    with pytest.raises(InputError, match="cannot push"):
        tracker.step(tension={"top": -1.0})
    tracker.step(tension={"top": 1.0})
    with pytest.raises(InputError, match="differ in shape"):
        tracker.compliance(points=POINTS, directions=DIRECTIONS[:1])


def test_a_stiffness_of_the_stretches_of_its_own_state_is_the_tangent_and_those_of_another_change_it() -> None:
    body = body_of(True)
    rest = np.array(body.mesh.nodes)
    x = rest + 2e-3 * np.sin(40.0 * rest[:, ::-1])
    stretch = np.zeros((len(body.mesh.tets), 4, 9))
    forces = internal(body, x, tangent=False, stretch=stretch).forces
    plain, same = internal(body, x), internal(body, x, stretch=stretch)
    assert plain.blocks is not None and same.blocks is not None
    scale = np.abs(plain.blocks[:-1]).max()
    np.testing.assert_allclose(same.blocks[:-1], plain.blocks[:-1], atol=1e-12 * scale)
    np.testing.assert_allclose(same.forces, forces, atol=1e-12 * np.abs(forces).max())
    turned = x @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    internal(body, turned, tangent=False, stretch=stretch)  # a turn stretches nothing
    again = internal(body, x, stretch=stretch).blocks
    assert again is not None
    np.testing.assert_allclose(again[:-1], plain.blocks[:-1], atol=1e-10 * scale)
    internal(body, rest, tangent=False, stretch=stretch)
    other = internal(body, x, stretch=stretch).blocks
    assert other is not None
    assert np.abs(other[:-1] - plain.blocks[:-1]).max() > 1e-3 * scale
