"""The quasi-static path along a recording: from recorded to true inputs, sharing of equal frames, history,
derivatives by variants."""

from __future__ import annotations

import contextlib
import gc
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
from analytic import bar_body
from driven import MARKERS, recording, robot
from helpers import block_mesh

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.work import counting
from femsense.fem.compliance import Tangent, tangent_at
from femsense.fem.equilibrium import Equilibrium, SolveOptions, solve_equilibrium
from femsense.fem.mesh import embed_points
from femsense.model.drive import DrivenRobot, drive_of, has_history
from femsense.model.effects import apply_effects
from femsense.model.frame_state import solve_frame
from femsense.model.linear_answers import AtPoints
from femsense.model.path_solver import PathSolver, look_at
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, LoadRows, Timeline
from femsense.model.robot import Robot
from femsense.model.variants import most_lent


def states_along(r: Robot, rec: Recording, frames: Sequence[int] | None = None, **options: Any) -> dict[int, np.ndarray]:
    frames = range(rec.frame_count) if frames is None else frames
    return {k: seen for k, _, seen, _ in solve_path(DrivenRobot(r, drive_of(r, rec)), frames, attrgetter("markers"), **options)}


class Watched:
    """A solver that lists the frames it is asked for, and the states it starts from."""

    def __init__(self) -> None:
        self.frames, self.starts = list[int](), dict[int, Equilibrium | None]()

    def equilibrium(self, driven: DrivenRobot, frame: int, **given: Any) -> Equilibrium:
        self.frames.append(frame)
        self.starts[frame] = given["start"]
        return solve_frame(driven, frame, **given)

    @property
    def solver(self) -> PathSolver:
        return PathSolver(equilibrium=self.equilibrium)


def equilibria_along(r: Robot, rec: Recording) -> list[Equilibrium]:
    starts: dict[int, Equilibrium] = {}
    deque(solve_path(DrivenRobot(r, drive_of(r, rec)), range(rec.frame_count), attrgetter("markers"), starts=starts), maxlen=0)
    return list(starts.values())


# What truly drives


def test_true_tension_is_gain_times_recorded_plus_offset_and_never_negative() -> None:
    r = robot([{"name": "cable_gain", "scale": {"top": 0.8}}, {"name": "cable_offset", "tension_n": {"top": 0.3, "side": -0.5}}])
    drive = drive_of(r, recording([[1.0, 2.0], [0.0, 0.1]]))
    np.testing.assert_allclose(drive.inputs, [[1.1, 1.5], [0.3, 0.0]])


def test_true_displacement_is_gain_times_recorded_plus_offset_less_slack() -> None:
    r = robot(
        [
            {"name": "cable_gain", "scale": 2.0},
            {"name": "cable_offset", "displacement_m": 0.001},
            {"name": "cable_slack", "displacement_m": {"side": 0.004}},
        ]
    )
    drive = drive_of(r, recording([[0.01, 0.02]], actuation="displacement"))
    np.testing.assert_allclose(drive.inputs, [[0.021, 0.037]])


def test_slack_lets_a_held_cable_do_nothing_until_it_is_taken_up() -> None:
    r = robot([{"name": "cable_slack", "displacement_m": {"top": 0.005}}], gravity=(0, 0, 0))
    seen = states_along(r, recording([[0.0, 0], [0.004, 0], [0.008, 0]], actuation="displacement"))
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-10)
    np.testing.assert_allclose(
        seen[2], states_along(robot(gravity=(0, 0, 0)), recording([[0.003, 0]], actuation="displacement"))[0], atol=1e-9
    )


def test_initial_inputs_are_added_before_gain() -> None:
    r = robot([{"name": "cable_gain", "scale": 0.5}])
    drive = drive_of(r, recording([[1.0, 2.0]], zero="unknown"), initial=np.array([0.2, 0.4]))
    np.testing.assert_allclose(drive.inputs, [[0.6, 1.2]])


def test_columns_are_taken_by_name() -> None:
    rec = make_recording(Timeline([0.0]), drives=Drives(("side", "top"), [[1.0, 2.0]]))
    np.testing.assert_array_equal(drive_of(robot(), rec).inputs, [[2.0, 1.0]])


# Work


def test_work_counts_as_soon_as_it_is_done_and_where_there_is_no_state() -> None:
    r, rec, done = robot(), recording([[0.0, 0.0], [1.0, 0.0], [1e6, 0.0]]), list[int]()

    def solved(driven: DrivenRobot, frame: int, **given: Any) -> Equilibrium:
        done.append(work.equilibria)
        return solve_frame(driven, frame, **given)

    with counting() as work, pytest.raises(DataError, match="frame 2"):
        states_along(r, rec, solver=PathSolver(equilibrium=solved))
    assert done == [0, 1, 2] and work.equilibria > 3


def test_a_state_that_is_only_looked_at_takes_few_steps() -> None:
    driven = DrivenRobot(robot(), drive_of(robot(), recording([[1.0, 0.0], [1e6, 0.0]])))
    near, blown_up = (look_at(driven, k, start=None, options=SolveOptions()) for k in (0, 1))
    assert near.converged and not blown_up.converged
    assert blown_up.iterations < solve_frame(driven, 1).iterations


# Creep


def crept(values: Sequence[float], times: Sequence[float], fraction: float, tau: float) -> np.ndarray:
    r = robot([{"name": "creep", "fraction": fraction, "time_s": tau}])
    rec = recording([[v, 0.0] for v in values], time_s=times)
    return np.asarray(drive_of(r, rec).inputs[:, 0])


def test_creep_of_a_steep_step_follows_its_compliance() -> None:
    t = np.array([0.0, 1e-9, 0.5, 1.0, 3.0, 20.0])
    found = crept([0, 1, 1, 1, 1, 1], t, 0.3, 2.0)
    np.testing.assert_allclose(found, np.concatenate([[0], 1 + 0.3 * (1 - np.exp(-t[1:] / 2.0))]), atol=1e-7)


def test_creep_of_a_ramp_is_the_integral_of_its_steps() -> None:
    t = np.array([0.0, 0.7, 1.0, 2.5, 4.0])
    f, tau = 0.4, 1.3
    np.testing.assert_allclose(crept(2 * t, t, f, tau), 2 * t + 2 * f * (t - tau * (1 - np.exp(-t / tau))), rtol=1e-10)


def test_creep_does_not_depend_on_how_finely_time_is_cut() -> None:
    coarse = crept([0, 2, 2, 1], [0, 1, 3, 4], 0.5, 0.8)
    t = np.linspace(0, 4, 81)
    fine = crept(np.interp(t, [0, 1, 3, 4], [0, 2, 2, 1]).tolist(), t.tolist(), 0.5, 0.8)
    np.testing.assert_allclose(fine[[0, 20, 60, 80]], coarse, rtol=1e-9)


def test_what_was_there_before_the_first_frame_has_crept_out() -> None:
    np.testing.assert_allclose(crept([2, 2, 2], [0, 1, 5], 0.25, 3.0), 2.5)


def test_creep_terms_add_up() -> None:
    r = robot([{"name": "creep", "fraction": [0.2, 0.1], "time_s": [1.0, 5.0]}])
    t = np.array([0.0, 1.0, 2.0, 6.0])
    found = drive_of(r, recording([[v, 0] for v in (0, 1, 1, 0)], time_s=t)).inputs[:, 0]
    one, two = crept([0, 1, 1, 0], t.tolist(), 0.2, 1.0), crept([0, 1, 1, 0], t.tolist(), 0.1, 5.0)
    np.testing.assert_allclose(found, np.maximum(one + two - [0, 1, 1, 0], 0))


def test_known_loads_creep_too_and_two_at_one_place_are_one() -> None:
    r = robot([{"name": "creep", "fraction": 0.5, "time_s": 1.0}])
    place, t = [0.1, 0.015, 0.015], [0.0, 1.0, 2.0, 3.0]
    once = recording([[0, 0]] * 4, time_s=t, loads=LoadRows([1, 2, 3], [place] * 3, [[0, 0, -1.0]] * 3))
    halves = recording([[0, 0]] * 4, time_s=t, loads=LoadRows([1, 1, 2, 2, 3, 3], [place] * 6, [[0, 0, -0.5]] * 6))
    drive = drive_of(r, once)
    ramp = 0.5 * (1 - (1 - np.exp(-1.0)))  # after the ramp over the first second
    flow = np.array([ramp, 0.5 - (0.5 - ramp) * np.exp(-1), 0.5 - (0.5 - ramp) * np.exp(-2)])
    np.testing.assert_allclose(-drive.load_forces[:, 2], 1 + flow, rtol=1e-9)
    other = drive_of(r, halves)
    for k in (1, 2, 3):
        np.testing.assert_allclose(other.load_forces[other.load_frame == k].sum(axis=0), drive.load_forces[k - 1], atol=1e-12)


# Along the path


def test_equal_frames_share_one_solve_and_come_out_the_same() -> None:
    rec = recording([[1.0, 0], [0.5, 0.2], [1.0, 0], [1.0, 0], [0.5, 0.2]])
    watched = Watched()
    seen = states_along(robot(), rec, solver=watched.solver)
    assert watched.frames == [0, 1]
    for k in range(5):
        alone = solve_frame(DrivenRobot(robot(), drive_of(robot(), rec)), k)
        np.testing.assert_allclose(seen[k], robot().markers.positions(alone.positions), atol=1e-9)


def test_frames_with_other_loads_or_gravity_are_not_the_same() -> None:
    rec = recording(
        [[1.0, 0]] * 4,
        loads=LoadRows([1, 2], [[0.1, 0.015, 0.03]] * 2, [[0, 0, -0.1], [0, 0, 0.1]]),
        gravity=[[0, 0, -9.81], [0, 0, -9.81], [0, 0, -9.81], [0, 9.81, 0]],
    )
    seen = states_along(robot(), rec)
    for a in range(4):
        for b in range(a):
            assert np.abs(seen[a] - seen[b]).max() > 1e-5


def test_a_known_load_acts_where_it_stands() -> None:
    rec = recording([[0, 0]], loads=LoadRows([0], [MARKERS[0]], [[0, 0.2, 0]]))
    body = robot().body
    forces = embed_points(body.mesh, MARKERS[:1]).spread(np.array([[0, 0.2, 0]]), len(body.mesh.nodes))
    np.testing.assert_allclose(
        states_along(robot(), rec)[0],
        robot().markers.positions(solve_equilibrium(body, nodal_forces=forces).positions),
        atol=1e-9,
    )


def test_gravity_of_a_frame_replaces_that_of_the_body() -> None:
    rec = recording([[0, 0]], gravity=[[0.0, 3.0, 1.0]])
    np.testing.assert_allclose(
        states_along(robot(), rec)[0], states_along(robot(gravity=(0.0, 3.0, 1.0)), recording([[0, 0]]))[0], atol=1e-12
    )


def test_with_friction_the_past_matters_and_unwanted_frames_are_solved_too() -> None:
    up_down = recording([[0.5, 0], [1.5, 0], [0.5, 0]])
    r = robot(friction=0.5)
    assert has_history(r) and not has_history(robot())
    seen = states_along(r, up_down)
    assert np.abs(seen[2] - seen[0]).max() > 1e-5
    np.testing.assert_allclose(states_along(r, up_down, [2])[2], seen[2], atol=1e-9)
    plain = states_along(robot(), up_down)
    np.testing.assert_array_equal(plain[2], plain[0])


def test_parts_of_a_path_with_a_past_join_to_the_path_in_order() -> None:
    levels = np.array([0.4, 1.0, 1.6, 1.6, 1.0, 0.5])
    rec = recording(np.vstack([np.outer(levels, mix) + 0.05 for mix in ([1, 0], [0, 1], [0.6, 0.6], [0.2, 0.8], [1, 0.3])]))
    starts: dict[int, Any] = {}
    states_along(robot(friction=0.4), rec, starts=starts)
    for friction in (0.4, 0.6):
        watched = Watched()
        joined = states_along(robot(friction=friction), rec, starts=dict(starts), solver=watched.solver)
        in_order = states_along(robot(friction=friction), rec)
        for k, seen in in_order.items():
            np.testing.assert_allclose(joined[k], seen, atol=1e-9)
    assert len(watched.frames) > len(
        set(watched.frames)
    )  # what was guessed of the past was not it, so that frames were solved again


def test_with_friction_a_hold_is_solved_once_and_a_return_is_not_the_same() -> None:
    watched = Watched()
    seen = states_along(robot(friction=0.5), recording([[0.5, 0], [1.5, 0], [1.5, 0], [0.5, 0]]), solver=watched.solver)
    assert watched.frames == [0, 1, 3]
    np.testing.assert_array_equal(seen[1], seen[2])
    assert np.abs(seen[3] - seen[0]).max() > 1e-5


def test_a_frame_starts_from_the_state_whose_inputs_are_most_like_its_own() -> None:
    rec = recording([[0.0, 0], [1.0, 0], [0.1, 0], [0.9, 0]])
    starts: dict[int, Any] = {}
    states_along(robot(), rec, [0, 1], starts=starts)
    watched = Watched()
    states_along(robot(), rec, [2, 3], starts=dict(starts), solver=watched.solver)
    assert watched.starts[2] is starts[0] and watched.starts[3] is starts[1]


def test_variants_give_the_derivative_of_frames_solved_anew() -> None:
    rec, h = recording([[1.0, 0.3], [1.5, 0.1]]), 1e-4
    base = robot()
    variants = [
        robot([{"name": "stiffness", "scale": 1 + h}]),
        robot([{"name": "poisson", "poisson_ratio": 0.4 + h}]),
        robot([{"name": "payload", "point_m": MARKERS[1].tolist(), "force_n": [0, 0, h]}]),
    ]
    behind = [
        robot([{"name": "stiffness", "scale": 1 - h}]),
        robot([{"name": "poisson", "poisson_ratio": 0.4 - h}]),
        robot([{"name": "payload", "point_m": MARKERS[1].tolist(), "force_n": [0, 0, -h]}]),
    ]
    for k, _, seen, others in solve_path(
        DrivenRobot(base, drive_of(base, rec)),
        [0, 1],
        attrgetter("markers"),
        [DrivenRobot(v, drive_of(v, rec)) for v in variants],
    ):
        for forward, ahead, back in zip(others, variants, behind):
            alone = [
                r.markers.positions(
                    solve_equilibrium(
                        r.body, tension=dict(zip(("top", "side"), rec.inputs[k])), options=SolveOptions(relative_tolerance=1e-12)
                    ).positions
                )
                for r in (ahead, back)
            ]
            central = (alone[0] - alone[1]) / (2 * h)
            assert np.abs((forward - seen) / h - central).max() < 1e-3 * np.abs(central).max()  # one-sided: h of curvature
            np.testing.assert_allclose(forward, alone[0], atol=1e-4 * h * np.abs(central).max() + 1e-11)


def test_another_modulus_of_some_elements_moves_a_frame_as_if_it_were_solved_anew() -> None:
    rec, h, base = recording([[1.0, 0.3]]), 1e-4, robot()
    for entry in (
        {"name": "stiffness"},
        {"name": "soft_region", "center_m": MARKERS[1].tolist(), "radius_m": 0.04},
    ):
        ahead, back = (apply_effects(base, [{**entry, "scale": 1 + s}]) for s in (h, -h))
        [(_, _, seen, others)] = solve_path(
            DrivenRobot(base, drive_of(base, rec)), [0], attrgetter("markers"), [DrivenRobot(ahead, drive_of(ahead, rec))]
        )
        alone = [
            r.markers.positions(
                solve_equilibrium(
                    r.body, tension={"top": 1.0, "side": 0.3}, options=SolveOptions(relative_tolerance=1e-12)
                ).positions
            )
            for r in (ahead, back)
        ]
        central = (alone[0] - alone[1]) / (2 * h)
        assert np.abs((others[0] - seen) / h - central).max() < 1e-3 * np.abs(central).max()  # one-sided: h of curvature


@pytest.mark.parametrize("control", ["tension", "displacement"])
def test_many_forces_are_answered_by_the_points_that_are_observed(control: str) -> None:
    rec = recording([[1.0, 0.3], [2.0, 0.1]] if control == "tension" else [[2e-3, 0.0], [1e-3, 5e-4]], actuation=control)
    base = apply_effects(robot(), [{"name": "cable_stretch", "stiffness_n_m": 2000.0}] if control == "displacement" else [])
    payloads = [
        {"name": "payload", "point_m": MARKERS[i % len(MARKERS)].tolist(), "force_n": f}
        for i, f in enumerate((1e-3 * np.random.default_rng(2).standard_normal((3 * len(MARKERS) + 1, 3))).tolist())
    ]
    entries = [
        *payloads,
        {"name": "stiffness", "scale": 1.001},
        {"name": "cable_gain", "scale": {"top": 1.001}},
        {"name": "geometry", "scale": 1.001},
        {"name": "base_compliance", "stiffness_n_m": 1e6},
    ]
    moved = {"name": "marker_offset", "offset_m": {"a": [1e-4, 0.0, 0.0]}}
    robots = [*(apply_effects(base, [entry]) for entry in entries), apply_effects(base, [payloads[0], moved])]
    paths = [DrivenRobot(r, drive_of(r, rec)) for r in robots]
    solved = list[int]()

    class Counting(Tangent):
        def respond(self, forces: FloatArray) -> FloatArray:
            solved.append(len(forces))
            return Tangent.respond(self, forces)

    def counted(*given: Any) -> Tangent:
        plain = tangent_at(*given)
        return Counting(*(getattr(plain, field.name) for field in fields(Tangent)))

    def seen(
        variants: Sequence[DrivenRobot], known: dict[int, AtPoints] | None = None, tangent: Callable[..., Tangent] = counted
    ) -> FloatArray:
        driven = DrivenRobot(base, drive_of(base, rec))
        path = solve_path(driven, [0, 1], attrgetter("markers"), variants, answers=known, solver=PathSolver(tangent=tangent))
        return np.array([others for *_, others in path])

    together = seen(paths)
    assert solved and max(solved) == 3 * len(MARKERS)  # one a point and axis, none a payload
    alone = np.concatenate([seen([driven]) for driven in paths], axis=1)
    still = next(iter(solve_path(DrivenRobot(base, drive_of(base, rec)), [0], attrgetter("markers"))))[2]
    np.testing.assert_allclose(together, alone, atol=1e-6 * np.abs(alone - still).max())
    known = dict[int, AtPoints]()
    np.testing.assert_allclose(seen(paths[:1], known), alone[:, :1], atol=1e-6 * np.abs(alone - still).max())
    solved.clear()
    kept = seen(paths[1 : len(payloads) + 2], known, lambda *given: pytest.fail("a tangent is made though the answers are known"))
    np.testing.assert_allclose(kept, alone[:, 1 : len(payloads) + 2], atol=1e-6 * np.abs(alone - still).max())
    assert known.keys() == {0, 1} and not solved


def test_a_variant_in_observation_alone_costs_no_solve() -> None:
    base = robot()
    moved = base.with_marker_points(MARKERS + 0.001)
    rec = recording([[1.0, 0.3]])
    watched, drive = Watched(), drive_of(base, rec)
    variants, solver = (
        [DrivenRobot(moved, drive)],
        replace(watched.solver, tangent=lambda *given: pytest.fail("it costs a solve")),
    )
    _, _, seen, others = next(iter(solve_path(DrivenRobot(base, drive), [0], attrgetter("markers"), variants, solver=solver)))
    assert watched.frames == [0] and 5e-4 < np.abs(others[0] - seen).max() < 2e-3


def test_variants_that_rub_are_answered_twice_with_one_factor_a_state(monkeypatch: pytest.MonkeyPatch) -> None:
    base, rec = robot(), recording([[0.5, 0.0], [1.0, 0.2], [0.5, 0.0], [1.0, 0.2]])
    rubs = [apply_effects(base, [{"name": "cable_friction", "coefficient": c}]) for c in (0.1, 0.2)]
    others = [apply_effects(base, [{"name": "stiffness", "scale": scale}]) for scale in (0.9, 1.1)]
    made, paths = list[Any](), [DrivenRobot(r, drive_of(r, rec)) for r in (*rubs, *others)]
    solver = PathSolver(tangent=lambda *given: (made.append(given), tangent_at(*given))[1])

    def seen() -> list[FloatArray]:
        path = solve_path(DrivenRobot(base, drive_of(base, rec)), range(4), attrgetter("markers"), paths, solver=solver)
        return [others for *_, others in path]

    kept = seen()
    assert len(made) == 2  # frames of two states
    monkeypatch.setenv("FEMSENSE_MEMORY_GB", "0")
    np.testing.assert_allclose(kept, seen(), atol=1e-12)
    assert len(made) == 6


def test_factors_of_a_path_with_friction_are_gone_with_it() -> None:
    base, rec = robot(), recording([[0.5, 0.0], [1.0, 0.2], [1.5, 0.4]])
    rubs = apply_effects(base, [{"name": "cable_friction", "coefficient": 0.2}])
    made = list[weakref.ref[Any]]()

    def watched(*given: Any) -> Tangent:
        tangent = tangent_at(*given)
        made.append(weakref.ref(tangent.factor))
        return tangent

    variants, solver = [DrivenRobot(rubs, drive_of(rubs, rec))], PathSolver(tangent=watched)
    gc.disable()  # a circle of references would keep gigabytes until its next round
    try:
        driven = DrivenRobot(base, drive_of(base, rec))
        deque(solve_path(driven, [0, 2], attrgetter("markers"), variants, solver=solver), maxlen=0)
        assert made and all(factor() is None for factor in made)
    finally:
        gc.enable()


def test_a_factor_takes_the_place_of_no_smaller_one() -> None:
    state = equilibria_along(robot(), recording([[0.5, 0.0]]))[0]
    bare = replace(state, factor=None)
    size = state.factor.bytes
    assert most_lent(bare, 1e9) == 1e9 and size < most_lent(state, 1e9) < 2 * size
    assert most_lent(state, 0.0) == 0.0


def test_a_variant_in_gravity_is_solved() -> None:
    base, rec = robot(), recording([[1.0, 0.3]])
    tilted = replace(base, body=base.body.with_gravity([1.0, 0, -9.81]))
    _, _, seen, others = next(
        iter(
            solve_path(
                DrivenRobot(base, drive_of(base, rec)), [0], attrgetter("markers"), [DrivenRobot(tilted, drive_of(tilted, rec))]
            )
        )
    )
    assert np.abs(others[0] - seen).max() > 1e-6


def test_earlier_states_are_starts_and_are_brought_up_to_date() -> None:
    base, starts = robot(), {}
    cold = states_along(base, recording([[1.0, 0.3], [2.0, 0.3]]), starts=starts)
    assert set(starts) == {0, 1}
    warm = states_along(base, recording([[1.001, 0.3], [2.0, 0.3]]), starts=starts)
    assert np.abs(warm[0] - cold[0]).max() > 1e-9
    np.testing.assert_allclose(warm[0], states_along(base, recording([[1.001, 0.3]]))[0], atol=1e-9)
    np.testing.assert_allclose(warm[1], cold[1], atol=1e-9)


def test_a_frame_without_equilibrium_names_itself() -> None:
    base = robot()
    loose = replace(base, body=bar_body(block_mesh((4, 1, 1)), clamped=False, gravity=(0, 0, -9.81)))
    with pytest.raises(DataError, match="no equilibrium in frame 0: singular: nothing holds the body"):
        states_along(loose, recording([[0.0, 0]]))


@pytest.mark.parametrize(
    "entry",
    [
        {"stiffness_n_m": 300.0},
        {"rotation_stiffness_nm_rad": 0.05},
        {"stiffness_n_m": 300.0, "rotation_stiffness_nm_rad": 0.3},
    ],
)
def test_a_clamp_that_gives_takes_the_body_along_first(entry: dict[str, float]) -> None:
    rec = recording([[1.0, 0.0], [2.0, 0.5]])
    rigid, starts, watched = robot(), {}, Watched()
    states_along(rigid, rec, starts=starts)
    soft = robot([{"name": "base_compliance", **entry}])
    alone = equilibria_along(soft, rec)
    there = states_along(soft, rec, starts=dict(starts), solver=watched.solver)
    for k, state in enumerate(alone):
        np.testing.assert_allclose(there[k], soft.markers.positions(state.positions), atol=1e-8)
        way = np.abs(state.positions - starts[k].positions).max()
        assert np.abs(watched.starts[k].positions - state.positions).max() < 0.5 * way


@pytest.mark.parametrize("entry", [{"stiffness_n_m": 1.0}, {"rotation_stiffness_nm_rad": 1e-3}])
def test_a_clamp_that_cannot_hold_the_body_is_solved_from_rest(entry: dict[str, float]) -> None:
    rec, starts, watched = recording([[1.0, 0.0]]), {}, Watched()
    states_along(robot(), rec, starts=starts)
    soft = robot([{"name": "base_compliance", **entry}])
    with contextlib.suppress(DataError):  # what holds so little may have no equilibrium at all
        states_along(soft, rec, starts=starts, solver=watched.solver)
    assert watched.starts == {0: None}


def test_where_a_body_that_was_taken_along_does_not_converge_it_is_solved_from_rest() -> None:
    rec, starts = recording([[1.0, 0.0], [2.0, 0.5]]), {}
    states_along(robot(), rec, starts=starts)
    soft = robot([{"name": "base_compliance", "stiffness_n_m": 300.0}])
    alone, failed = states_along(soft, rec), list[int]()

    def fails_from_a_start(driven: DrivenRobot, k: int, *, start: Equilibrium | None, options: SolveOptions) -> Equilibrium:
        state = solve_frame(driven, k, start=start, options=options)
        if not options.reuse_factor:
            return state
        failed.append(k)
        return replace(state, status="overload")

    there = states_along(soft, rec, starts=starts, solver=PathSolver(equilibrium=fails_from_a_start))
    assert failed
    for k, seen in alone.items():
        np.testing.assert_allclose(there[k], seen, atol=1e-9)
