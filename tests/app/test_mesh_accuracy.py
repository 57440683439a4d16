"""Discretisation error: the estimate against a converged solution, its signs, its limits, its words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import write_block_robot

from femsense.app import cli
from femsense.app.accuracy.assess import SPACES, assess_accuracy, observed_points
from femsense.app.accuracy.errors import Answer, errors_of, reference_of
from femsense.app.accuracy.loads import contact_patches, felt_features, sized_loads
from femsense.app.accuracy.report import AccuracyOptions, accuracy_text, advice_on
from femsense.core.errors import DataError
from femsense.fem.body import BodyModel
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import embed_points
from femsense.io.robot_toml import load_robot
from femsense.model.remeshing import body_on_mesh, finer_mesh
from femsense.model.robot import Robot

SIDE = [{"name": "side", "path_m": [[0.1, 0.03, 0.015]], "pull_point_m": [0.0, 0.04, 0.015]}]


def block(folder: Path, element: str = "tet10", **options: Any) -> Robot:
    return load_robot(write_block_robot(folder, cells=options.pop("cells", (3, 1, 1)), mesh__element=element, **options))


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Robot, dict[str, Any]]]:
    robots = {element: block(tmp_path_factory.mktemp(element), element, cables=SIDE) for element in ("tet4", "tet10")}
    return {element: (robot, assess_accuracy(robot)) for element, robot in robots.items()}


def moved(body: BodyModel, robot: Robot, **drive: Any) -> np.ndarray:
    """Positions of features and markers under a load."""
    state = solve_equilibrium(body, **drive)
    assert state.converged
    points = np.vstack([robot.body.mesh.nodes[robot.features], robot.markers.positions(robot.body.mesh.nodes)])
    return embed_points(body.mesh, points).positions(state.positions)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_the_estimate_is_near_the_error_against_a_converged_solution(reports: Any, element: str) -> None:
    """The truth has 64 times as many elements; the estimate only saw 8 times as many."""
    robot, report = reports[element]
    fine = body_on_mesh(robot.body, finer_mesh(robot.body.mesh, "tet10", 2))
    rest, true_rest = moved(robot.body, robot), moved(fine, robot)
    free = moved(robot.body.with_gravity([0, 0, 0]), robot)
    pull = {"tension": {"side": report["loads"][1]["size"]}}
    cases = [(rest - free, true_rest - free), (moved(robot.body, robot, **pull) - rest, moved(fine, robot, **pull) - true_rest)]
    for row, (own, true) in zip(report["loads"], cases):
        error = 1e3 * np.linalg.norm(own - true, axis=1).max()
        assert error / 1.3 < row["error_mm"] < 1.3 * error
        assert row["motion_mm"] == pytest.approx(1e3 * np.linalg.norm(true, axis=1).max(), rel=0.05)
        share = np.sqrt(((own - true) ** 2).sum() / (true**2).sum())
        assert 100 * share / 1.3 < row["error_percent"] < 130 * share


def test_linear_elements_are_far_worse_and_a_finer_mesh_is_better(reports: Any) -> None:
    for element, (_, report) in reports.items():
        shares = {(s["element"], s["refinements"]): s["motion_percent"] for s in report["spaces"]}
        assert shares["tet4", 0] > shares["tet4", 1] > shares["tet10", 0] > shares["tet10", 1]
        assert [s["declared"] for s in report["spaces"]] == [
            s["element"] == element and not s["refinements"] for s in report["spaces"]
        ]
        unknowns = [s["unknowns"] for s in report["spaces"]]
        assert unknowns == sorted(unknowns) and all(s["step_ms"] > 0 for s in report["spaces"])
    worst = [abs(report["forces"]["worst_percent"]) for _, report in reports.values()]
    assert worst[0] > 3 * worst[1] and min(reports["tet4"][1]["forces"]["error_percent"]) > 0  # too stiff: forces too large
    assert (
        'element = "tet10"' in reports["tet4"][1]["advice"]
        and "a mesh of about 140 tetrahedra (femsense mesh --max-tets 140)" in reports["tet10"][1]["advice"]
    )


def test_a_model_that_moves_half_as_far_senses_twice_the_force() -> None:
    def answer(scale: float) -> Answer:
        moves = scale * np.arange(12.0).reshape(1, 4, 3)
        return Answer("tet10", 0 if scale < 1 else 1, 1, 1, 1.0, moves, moves)

    reference = reference_of([answer(0.5), answer(1.25)])
    np.testing.assert_allclose(reference.motions, 1.5 * np.arange(12.0).reshape(1, 4, 3))  # 1.25 + (1.25 − 0.5) / 3
    error = errors_of(answer(0.75), reference)
    np.testing.assert_allclose(error.force, 1.0)
    np.testing.assert_allclose(error.share, 0.5)
    np.testing.assert_allclose(error.doubt, np.linalg.norm([9, 10, 11]) / 4)


def test_contact_forces_are_one_newton_into_the_body_on_every_mesh(tmp_path: Path) -> None:
    robot = block(tmp_path, cells=(4, 2, 2))
    patches = contact_patches(robot, finer_mesh(robot.body.mesh, "tet10", 1), robot.features[:6])
    total = patches.forces.sum(axis=1)
    np.testing.assert_allclose(np.linalg.norm(total, axis=1), 1.0)
    inward = robot.body.mesh.nodes.mean(axis=0) - robot.body.mesh.nodes[robot.features[: len(total)]]
    assert (np.einsum("kc,kc->k", total, inward) > 0).all()
    for element, refinements in SPACES[:3]:
        mesh = finer_mesh(robot.body.mesh, element, refinements)
        carried = embed_points(mesh, patches.places)
        assert carried.outside.max() < 1e-9
        nodal = carried.spread(patches.forces[0], len(mesh.nodes))
        np.testing.assert_allclose(
            np.cross(mesh.nodes, nodal).sum(axis=0), np.cross(patches.places, patches.forces[0]).sum(axis=0), atol=1e-12
        )


def test_contact_forces_are_tried_where_they_are_felt(tmp_path: Path) -> None:
    robot = block(tmp_path, cells=(8, 2, 2))
    chosen = felt_features(robot, solve_equilibrium(robot.body), observed_points(robot))
    x = robot.body.mesh.nodes[:, 0]
    assert len(chosen) == 6 and x[robot.features].min() < 0.01 and x[chosen].min() > 0.02  # nothing is felt next to the clamp
    assert list(chosen) == [node for node in robot.features if node in chosen]


def test_a_robot_without_loads_is_judged_by_forces(tmp_path: Path) -> None:
    report = assess_accuracy(block(tmp_path, "tet4", cables=None, gravity=None))
    assert report["loads"] == [] and all(space["motion_percent"] is None for space in report["spaces"])
    assert report["spaces"][0]["force_percent"] > 100 and report["advice"].startswith('better: element = "tet10"')
    text = accuracy_text(report)
    assert "none: the robot has neither weight nor cables nor chambers" in text and "mm/N" in text


def test_what_is_too_large_is_left_out_and_said(tmp_path: Path) -> None:
    robot = block(tmp_path, "tet4", cables=SIDE)
    report = assess_accuracy(robot, options=AccuracyOptions(most_unknowns=300))
    assert report["reference"]["extrapolated"] is False and report["reference"]["spaces_left_out"] == 1
    assert "its own error is not known" in accuracy_text(report)
    assert [s["motion_percent"] is None for s in report["spaces"]] == [False, True, False] and not np.isfinite(
        report["loads"][0]["doubt_mm"]
    )
    assert report["advice"].startswith('no space that was tried is known to be fine enough; the nearest is element = "tet10": ')
    alone = assess_accuracy(robot, options=AccuracyOptions(most_unknowns=1))
    assert "nothing to compare it with" in alone["advice"] and alone["loads"][0]["error_mm"] is None
    assert "?" in accuracy_text(alone)


def test_what_would_take_too_long_is_left_out_and_said(tmp_path: Path) -> None:
    robot, told = block(tmp_path, "tet10"), list[str]()
    report = assess_accuracy(robot, options=AccuracyOptions(most_seconds=0.0), progress=told.append)
    assert [(s["element"], s["refinements"]) for s in report["spaces"]] == [("tet4", 0), ("tet10", 0)]
    split = finer_mesh(robot.body.mesh, "tet10", 1)
    assert report["reference"]["left_out"][-1].startswith(f"tet10, split into eight ({3 * len(split.nodes)} unknowns, about ")
    assert "left out: tet4, split into eight (" in accuracy_text(report)
    assert told == [
        "the declared mesh",
        *(f"{s['element']}: {3 * len(finer_mesh(robot.body.mesh, s['element'], 0).nodes)} unknowns" for s in report["spaces"]),
    ]


def test_the_advice_takes_the_cheapest_that_serves(reports: Any) -> None:
    _, report = reports["tet4"]
    worst = {(s["element"], s["refinements"]): max(s["motion_percent"], s["force_percent"]) / 100 for s in report["spaces"]}
    for limit, text in (
        (worst["tet10", 0], 'element = "tet10": '),
        (
            worst["tet10", 1],
            'element = "tet10" and a mesh of about 160 tetrahedra (femsense mesh --max-tets 160): about 1400 unknowns',
        ),  # 18 · 8 · 1.1
        (10.0, "fine enough"),
    ):
        spaces = [dict(space) for space in report["spaces"]]
        options = AccuracyOptions(good_motion=1.001 * limit, good_force=1.001 * limit)
        assert text in advice_on(report | {"spaces": spaces}, options)


def test_inputs_move_the_body_neither_too_far_nor_beyond_their_limit(tmp_path: Path) -> None:
    loads = sized_loads(block(tmp_path, cells=(4, 2, 2)).body)
    assert [load.name for load in loads] == ["own weight", "top", "side"] and loads[1].size <= 2.5 and np.isfinite(loads[2].size)
    small = sized_loads(block(tmp_path / "b", cables__0__max_tension_n=0.02).body)
    assert small[1].size == 0.01


def test_a_body_without_an_equilibrium_is_said(tmp_path: Path) -> None:
    robot = block(tmp_path, gravity__vector_m_s2=[0.0, 0.0, -98.1], material__young_modulus_pa=20.0)
    with pytest.raises(DataError, match="no equilibrium under its own weight"):
        assess_accuracy(robot)


def test_the_command(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    robot = write_block_robot(tmp_path / "robot", cells=(2, 1, 1), cables=None)
    assert cli.run(["inspect", str(robot), "--accuracy", "--json"]) == 0
    document = json.loads(capfd.readouterr().out)
    assert document["kind"] == "robot" and document["accuracy"]["loads"][0]["name"] == "own weight"
    assert cli.run(["inspect", str(robot), "--accuracy"]) == 0
    said = capfd.readouterr().out
    assert "the limit of tet10 meshes" in said and "own weight" in said and "* declared" in said
    assert cli.run(["inspect", str(robot / "block.vtu"), "--accuracy"]) == 2
    assert "--accuracy is about robots" in capfd.readouterr().err
    (robot / "block.vtu").write_text("nothing")
    assert cli.run(["inspect", str(robot), "--accuracy"]) == 2 and "not readable" in capfd.readouterr().out
