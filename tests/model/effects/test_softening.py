"""Softening: what an element has been through, first loadings, sensitivities on the way, and the rig's own integration of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from arm import arm
from helpers import write_block_robot

from femsense.fem.energy import energy_density
from femsense.io.robot_toml import load_robot, robot_document
from femsense.model.drive import DrivenRobot, body_in, drive_of
from femsense.model.effects import Entry, apply_effects, find_effect
from femsense.model.quasi_static_path import solve_path
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, Timeline
from femsense.model.robot import Robot
from femsense.model.softening import softened_share, with_softening
from femsense.rig.plan import plan_script
from femsense.rig.script import check_script
from femsense.rig.true_path import true_path

ENTRY: Entry = {"name": "softening", "share": 0.4, "energy_j_m3": 20.0}
LEVELS = [0.0, 1.0, 2.0, 1.0, 0.0, 1.0, 2.0, 3.0]


def pulled(levels: list[float]) -> Recording:
    inputs = np.outer(levels, [1.0, 0.0, 0.0, 0.0])
    return make_recording(Timeline(np.arange(len(levels))), drives=Drives(("up", "down", "left", "right"), inputs))


def tips(robot: Robot, levels: list[float]) -> np.ndarray:
    driven = with_softening(DrivenRobot(robot, drive_of(robot, pulled(levels))), len(levels) - 1)
    return np.array([seen[-4:].mean(axis=0)[2] for _, _, seen, _ in solve_path(driven, range(len(levels)), lambda r: r.markers)])


def test_the_energy_of_a_stretched_block_is_that_of_the_text_book() -> None:
    robot = arm((3, 1, 1), gravity=(0.0, 0.0, 0.0))
    body, x = robot.body, robot.body.mesh.nodes
    assert energy_density(body, x).max() < 1e-12
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    stretched = x * np.array([1.01, 1.0, 1.0])
    E, nu = 300e3, 0.45
    longitudinal = E * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    strain = 0.5 * (1.01**2 - 1.0)
    np.testing.assert_allclose(energy_density(body, stretched @ turn.T), 0.5 * longitudinal * strain**2, rtol=1e-9)


def test_a_first_loading_is_whole_and_what_comes_back_is_softer() -> None:
    shares = softened_share([(0.4, 20.0), (0.5, 1e3)], np.array([0.0, 50.0, 50.0]), np.array([0.0, 50.0, 30.0]))
    np.testing.assert_allclose(shares, [1.0, 1.0, (1 - 0.4 * (1 - np.exp(-1.0))) * (1 - 0.5 * (1 - np.exp(-0.02)))])


def test_the_same_pull_bends_further_once_more_has_been_pulled() -> None:
    robot = arm((4, 1, 1), gravity=(0.0, 0.0, 0.0))
    soft, plain = tips(apply_effects(robot, [ENTRY]), LEVELS), tips(robot, LEVELS)
    np.testing.assert_allclose(soft[[0, 1, 2, 7]], plain[[0, 1, 2, 7]], atol=1e-6)  # first loadings
    assert soft[3] > plain[3] + 5e-4
    np.testing.assert_allclose(soft[[3, 4, 6]], soft[[5, 0, 2]], atol=1e-6)  # no more memory than the largest


def test_variants_beside_a_softened_body_are_those_of_paths_solved_anew() -> None:
    robot = apply_effects(arm((4, 1, 1)), [ENTRY])
    stiff = find_effect("stiffness")

    def driven(scale: float, like: DrivenRobot | None = None) -> DrivenRobot:
        one = stiff.apply(robot, {"scale": scale})
        made = DrivenRobot(one, drive_of(one, pulled(LEVELS)))
        from dataclasses import replace

        return with_softening(made, 7) if like is None else replace(made, drive=replace(made.drive, softness=like.drive.softness))

    base = driven(1.0)
    assert np.ptp(body_in(base, 4).material.young_modulus) > 1e3
    h = 1e-5
    path = solve_path(base, range(8), lambda r: r.markers, [driven(1.0 + h, base)])
    slope = np.array([moved[0] - seen for _, _, seen, moved in path]) / h
    ends = [
        np.array([seen for _, _, seen, _ in solve_path(driven(1.0 + s * 1e-3, base), range(8), lambda r: r.markers)])
        for s in (1, -1)
    ]
    exact = (ends[0] - ends[1]) / 2e-3
    np.testing.assert_allclose(slope, exact, atol=2e-4 * np.abs(exact).max())


def test_the_rig_integrates_it_by_itself_and_agrees_where_little_is_lost() -> None:
    robot = apply_effects(arm((4, 1, 1)), [{**ENTRY, "share": 0.05}])
    script = check_script(
        {
            "format": "femsense-script-1",
            "sweeps": [{"label": "s", "cables": {"up": 2.0}, "levels": [0.0, 0.5, 1.0, 0.5, 0.0]}],
            "camera": {"eye_m": [0.05, 0.2, 0.1], "target_m": [0.05, 0.0, 0.0]},
        }
    )
    frames = true_path(robot, plan_script(script, robot), substeps=2)
    seen = np.array([robot.markers.positions(frame.state.positions)[-4:].mean(axis=0)[2] for frame in frames])
    lost = tips(robot, [0.0, 1.0, 2.0, 1.0, 0.0]) - tips(arm((4, 1, 1)), [0.0, 1.0, 2.0, 1.0, 0.0])
    own = seen - tips(arm((4, 1, 1)), [0.0, 1.0, 2.0, 1.0, 0.0])
    assert np.abs(lost).max() > 5e-5
    np.testing.assert_allclose(own, lost, atol=0.15 * np.abs(lost).max())


def test_robot_toml_round_trip(tmp_path: Path) -> None:
    robot = load_robot(write_block_robot(tmp_path, effects=[ENTRY]))
    assert robot_document(robot)["effects"] == [ENTRY] and robot.softening == ((0.4, 20.0),)


def test_its_energies_are_tried_in_shares_of_the_modulus() -> None:
    effect = find_effect("softening")
    assert [seed["energy_j_m3"] for seed in effect.seeds(arm((3, 1, 1)))] == pytest.approx([30.0, 300.0, 3000.0])
    (energy,) = effect.polish(arm((3, 1, 1)), "tension", {"energy_j_m3": 30.0})
    assert energy.value(energy.null) == pytest.approx(30.0)
