"""The robots that come with the project, beside four-leg: sound, sensible, and as their scripts make them."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import meshio
import numpy as np
import pytest
from triangles import distances

from femsense.app import cli
from femsense.fem.equilibrium import Equilibrium, solve_equilibrium
from femsense.fem.mesh import element_volumes, surface_triangles, to_linear
from femsense.fem.mesh_checks import check_mesh
from femsense.io.mesh_files import radius_ratio
from femsense.io.robot_toml import load_robot, robot_names
from femsense.model.robot import Robot

ROBOTS = sorted(name for name in robot_names() if name != "four-leg")
LENGTH = {"arm": 0.180, "finger": 0.092, "gripper": 0.092, "pneu-finger": 0.0745}
"""From the clamp to the far end [m]."""


@pytest.fixture(scope="module", params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def rest(robot: Robot) -> Equilibrium:
    return solve_equilibrium(robot.body)


def script_of(name: str) -> ModuleType:
    """Return the build script of a robot as a module."""
    spec = importlib.util.spec_from_file_location(f"{name.replace('-', '_')}_build", robot_names()[name] / "build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_there_are_robots() -> None:
    assert set(LENGTH) == set(ROBOTS)


def test_the_mesh_is_sound_and_small(robot: Robot) -> None:
    mesh = to_linear(robot.body.mesh)
    check_mesh(mesh, robot.name)
    quality, volumes = radius_ratio(mesh), element_volumes(mesh)
    assert 800 <= len(mesh.tets) <= 2500 and robot.body.mesh.is_quadratic
    assert quality.min() > 0.25 and np.median(quality) > 0.5 and volumes.min() > 0.1 * np.median(volumes)


def test_markers_sit_on_the_body_and_cables_in_it(robot: Robot) -> None:
    assert 8 <= len(robot.marker_names) <= 20 and len(robot.features) == 51
    skin = robot.body.mesh.nodes[surface_triangles(robot.body.mesh)]
    assert distances(robot.marker_points, skin).max() < 1e-3 * LENGTH[robot.name]
    for cable in robot.body.cables:
        assert cable.path.outside.max() == 0.0 and cable.exit_direction is not None and np.isfinite(cable.max_tension)
    outward = robot.marker_points - robot.body.mesh.nodes.mean(axis=0)
    assert np.linalg.matrix_rank(outward, tol=5e-3) == 3  # on several sides


def test_its_weight_bends_it_a_little(robot: Robot, rest: Equilibrium) -> None:
    assert rest.converged and robot.body.gravity.any()
    assert 1e-3 < largest_move(rest.positions, robot.body.mesh.nodes) / LENGTH[robot.name] < 0.12


def test_each_cable_and_chamber_moves_it_from_a_cold_start(robot: Robot, rest: Equilibrium) -> None:
    inputs = [("tension", cable.name, cable.max_tension) for cable in robot.body.cables]
    inputs += [("pressure", chamber.name, chamber.max_pressure) for chamber in robot.body.chambers]
    assert inputs
    for kind, name, largest in inputs:
        moved = solve_equilibrium(robot.body, **{kind: {name: largest}})
        assert moved.converged, name
        assert 0.1 < largest_move(moved.positions, rest.positions) / LENGTH[robot.name] < 0.42
        assert kind == "pressure" or moved.shortening[name] > 0


def largest_move(after: np.ndarray, before: np.ndarray) -> float:
    return float(np.linalg.norm(after - before, axis=1).max())


@pytest.mark.parametrize("name", ROBOTS)
def test_the_script_makes_what_is_there(name: str) -> None:
    script, robot = script_of(name), load_robot(name)
    assert script.robot_document() == robot.document
    made, kept = script.body_mesh(), meshio.read(robot_names()[name] / robot.document["mesh"]["file"])
    np.testing.assert_allclose(made.nodes, kept.points, atol=1e-12)
    np.testing.assert_array_equal(made.tets, kept.cells_dict["tetra"])


@pytest.mark.parametrize("name", [*ROBOTS, "four-leg"])
def test_it_has_a_picture(name: str) -> None:
    from PIL import Image

    with Image.open(robot_names()[name] / f"{name.replace('-', '_')}.png") as image:
        assert min(image.size) > 250
        colors = np.asarray(image.convert("RGB"), dtype=float) / 255.0
    hue = np.array(load_robot(name).color_rgb)
    near = np.linalg.norm(colors - colors.max(axis=2, keepdims=True) * hue / hue.max(), axis=2) < 0.12
    assert (near & (colors.min(axis=2) < 0.8)).mean() > 0.03  # the body is seen in its colour


@pytest.mark.parametrize("name", ROBOTS)
def test_inspect_finds_nothing_wrong(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["inspect", name, "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert report["kind"] == "robot" and report["problems"] == [] and report["warnings"] == []


def test_a_name_serves_as_a_robot_in_the_chain(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "script.toml"
    script.write_text(
        'format = "femsense-script-1"\nseed = 1\n[truth]\nrefinements = 0\nsubsteps = 1\n[markers]\nstd_m = 1e-4\n'
        '[camera]\neye_m = [0.05, -0.25, 0.25]\ntarget_m = [0.05, 0.0, 0.01]\n[[sweeps]]\nlabel = "up"\ncables = { '
        "flexor = 0.8 }\nrest = 1\nup = 1\ndown = 0\n",
        encoding="utf-8",
    )
    recording, calibration, run = (str(tmp_path / name) for name in ("recording", "calibration.json", "run"))
    assert cli.run(["simulate", "finger", str(script), "-o", recording]) == 0, capfd.readouterr().err
    assert cli.run(["calibrate", "finger", recording, "-o", calibration]) == 0, capfd.readouterr().err
    assert cli.run(["estimate", "finger", recording, "-c", calibration, "-o", run, "--at", "0.09,0,0.007"]) == 0, (
        capfd.readouterr().err
    )
